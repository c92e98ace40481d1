"""The speed benchmarks run in their quick form, and what they compare agrees."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def _quick(name: str, folder: Path) -> list[dict]:
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    file = folder / f"{name}.json"
    command = [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--json", str(file)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-3000:]
    return json.loads(file.read_text())


@pytest.mark.slow
def test_peers_simulate_and_differentiate_the_same_loop(tmp_path):
    """Different programs of the same steps agree to rounding, an adaptive solver to its own."""
    rows = _quick("peers", tmp_path)
    for row in rows:
        if row["task"] == "whole fit" or row["differs"] is None or "MuJoCo" in row["who"]:
            continue
        assert row["differs"] < (1e-2 if "SciPy" in row["who"] else 1e-9), row
    assert {"simulation", "Jacobian", "whole fit"} == {row["task"] for row in rows}


@pytest.mark.slow
def test_ways_to_a_gradient_agree_as_far_as_each_can(tmp_path):
    found = _quick("gradients", tmp_path)
    rows = {row["way"]: row for row in found if row["task"] in ("Jacobian", "gradient")}
    steps = rows["forward mode through the steps"]["error"]
    # Four steps in 10 ms, with a sign as sharp as 100 s/rad.
    assert steps < 2e-3
    # The same numbers by another road: what differs is rounding.
    assert abs(rows["sensitivity equations, augmented"]["error"] - steps) < 1e-8
    assert rows["reverse mode, checkpoints"]["error"] < 1e-3
    assert rows["three-point differences"]["error"] < 1e-3


@pytest.mark.slow
def test_scaling_covers_recordings_lengths_parameters_and_hypotheses(tmp_path):
    rows = _quick("scaling", tmp_path)
    assert {row["grows"] for row in rows} == {"recordings", "length", "parameters", "hypotheses"}
    assert all(row["us_per_step"] > 0 for row in rows)
