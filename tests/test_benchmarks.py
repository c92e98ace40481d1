"""The speed benchmarks run in their quick form, and what they compare agrees."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


def _quick(name: str, folder: Path) -> Any:
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
def test_minimisers_and_gradients_agree_as_far_as_each_can(tmp_path):
    rows = _quick("gradients", tmp_path)
    fits = {row["minimiser"]: row for row in rows if row["task"] == "fit"}
    assert {who.split(".")[0].split(",")[0] for who in fits} == {"jaxid", "optimistix", "SciPy"}
    ours, exact = fits["jaxid"], fits["SciPy, jaxid's Jacobian"]
    differences = fits["SciPy, differences"]
    for row in (ours, exact, differences):
        assert row["status"] == "converged"
        # What five more steps may gain where jaxid stops.
        assert row["loss_above"] < 1e-4, row
    # A linearisation holds its own simulation; SciPy asks for either, or for one a parameter.
    assert (ours["simulations"], ours["Jacobians"]) == (0, ours["steps"])
    assert exact["simulations"] == exact["steps"] >= exact["Jacobians"] > 0
    assert differences["Jacobians"] == 0
    assert (differences["simulations"] - differences["steps"]) % 8 == 0
    assert differences["simulations"] > differences["steps"]

    errors = {row["way"]: row["error"] for row in rows if row["task"] == "gradient"}
    # The same derivative of the same steps: the reference is good to 1e-11, its rounding.
    for way in ("jaxid", "ForwardMode"):
        assert errors[f"forward mode, {way}"] < 1e-9
    assert errors["reverse mode, DirectAdjoint"] < 1e-9
    # Five per cent beside the minimum a step of 1e-7 is 3e-4 of the way there for the smallest
    # parameter, and so is the error of first order; the other is of second order.
    assert errors["two-point differences"] < 3e-4
    assert errors["three-point differences"] < 1e-6


@pytest.mark.slow
def test_scaling_covers_recordings_lengths_parameters_and_hypotheses(tmp_path):
    rows = _quick("scaling", tmp_path)
    assert {row["grows"] for row in rows} == {"recordings", "length", "parameters", "hypotheses"}
    assert all(row["us_per_step"] > 0 for row in rows)


@pytest.mark.slow
def test_own_effects_are_timed_against_the_loop_without_them(tmp_path):
    rows = {row["effect"]: row for row in _quick("own_effects", tmp_path)}
    assert rows.keys() == {"none", "solve 6", "network 16", "eigh"}
    assert all(row["Jacobian_ms"] > 0 for row in rows.values())
    assert rows["none"]["simulation_times"] == 1


@pytest.mark.slow
def test_memory_is_measured_by_length(tmp_path):
    rows = _quick("memory", tmp_path)
    assert all(row["succeeded"] and row["peak_MiB"] > 0 for row in rows)
    assert len(rows) > 1


@pytest.mark.slow
def test_settings_of_the_process_are_each_taken_away(tmp_path):
    rows = {(row["task"], row["setting"]): row for row in _quick("process", tmp_path)}
    assert {task for task, _ in rows} == {"simulation", "Jacobian", "whole fit"}
    assert len(rows) == 12
    assert rows["Jacobian", "as jaxid sets them"]["run"] == 1


@pytest.mark.slow
def test_worlds_are_simulated_by_mujoco_and_judged(tmp_path):
    pytest.importorskip("mujoco")
    found = _quick("worlds", tmp_path)
    assert len(found["cases"]) == 2
    for case in found["cases"]:
        assert "error" not in case, case["error"]
        assert case["marks"]["verdict"] in (
            "adequate",
            "explained",
            "outside_catalogue",
            "undetermined",
        )
        assert case["marks"]["ratio"] > 0.5
        # What was hidden is larger than the noise that hides it.
        assert all(size > noise for size, noise in case["strength"])
    assert found["scores"]["unknown"]["errors"] == []
