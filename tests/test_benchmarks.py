"""The speed benchmarks run in their quick form, and what they compare agrees."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
# The benchmarks are not part of the package; a checkout has them beside the tests.
sys.path.insert(0, str(ROOT))


def _quick(name: str, folder: Path, *more: str) -> Any:
    if not (ROOT / "benchmarks").is_dir():
        pytest.skip("no benchmarks beside the tests: they are part of a checkout alone")
    file = folder / f"{name}.json"
    command = [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--json", str(file), *more]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-3000:]
    return json.loads(file.read_text())


def test_peers_simulate_and_differentiate_the_same_loop(tmp_path):
    """Different programs of the same steps agree to rounding, an adaptive solver to its own."""
    rows = _quick("peers", tmp_path)
    for row in rows:
        if row["task"] == "whole fit" or row["differs"] is None or "MuJoCo" in row["who"]:
            continue
        assert row["differs"] < (1e-2 if "SciPy" in row["who"] else 1e-9), row
    assert {"simulation", "Jacobian", "whole fit"} == {row["task"] for row in rows}


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
    # A linearisation includes its simulation; SciPy calls either, or one per parameter.
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


def test_scaling_covers_recordings_lengths_parameters_and_hypotheses(tmp_path):
    rows = _quick("scaling", tmp_path)
    assert {row["grows"] for row in rows} == {"recordings", "length", "parameters", "hypotheses"}
    assert all(row["us_per_step"] > 0 for row in rows)


def test_own_effects_are_timed_against_the_loop_without_them(tmp_path):
    rows = {row["effect"]: row for row in _quick("own_effects", tmp_path)}
    assert rows.keys() == {"none", "solve 6", "network 16", "eigh"}
    assert all(row["Jacobian_ms"] > 0 for row in rows.values())
    assert rows["none"]["simulation_times"] == 1


def test_memory_is_measured_by_length(tmp_path):
    rows = _quick("memory", tmp_path)
    assert all(row["succeeded"] and row["peak_MiB"] > 0 for row in rows)
    assert len(rows) > 1


def test_time_and_memory_are_measured_by_joints(tmp_path):
    rows = {row["task"]: row for row in _quick("joints", tmp_path)}
    assert list(rows) == ["simulation", "Jacobian"]
    for row in rows.values():
        assert row["joints"] == 2
        assert row["peak_MiB"] >= row["before_MiB"] > 0
        assert row["first_s"] > row["again_s"] > 0


def test_a_mistake_in_recordings_is_named_and_gives_no_sure_verdict(tmp_path):
    rows = _quick("mistakes", tmp_path)
    assert [(row["verdict"], row["named"]) for row in rows] == [("undetermined", True)] * 2


def test_settings_of_the_process_are_each_taken_away(tmp_path):
    rows = {(row["task"], row["setting"]): row for row in _quick("process", tmp_path)}
    assert {task for task, _ in rows} == {"simulation", "Jacobian", "whole fit"}
    assert len(rows) == 12
    assert rows["Jacobian", "as jaxid sets them"]["run"] == 1


def test_a_body_at_the_tip_of_six_joints_is_found(tmp_path):
    pytest.importorskip("mujoco")
    pytest.importorskip("example_robot_data")
    case = _quick("six_joints", tmp_path)["cases"][0]
    assert "error" not in case, case["error"]
    assert case["marks"]["right"], case["marks"]
    found = case["story"]["added"][0]["parameters"]["mass"]["value"]
    assert found == pytest.approx(case["numbers"]["mass"], rel=0.03)


def test_worlds_are_simulated_by_mujoco_and_judged(tmp_path):
    pytest.importorskip("mujoco")
    lines = tmp_path / "lines.jsonl"
    found = _quick("worlds", tmp_path, "--results", str(lines))
    assert len(found["cases"]) == 2
    assert found["seed"] == 1
    assert {json.loads(x)["number"] for x in lines.read_text().splitlines()} == {0, 1}
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


def _story(weights: dict[str, float]) -> dict[str, Any]:
    models = [
        {
            "effects": [{"effect": n, "joint": 1} for n in names.split()],
            "weight": w,
            "difference": -2 * np.log(w),
            "curve": None,
        }
        for names, w in weights.items()
    ]
    # A curve shares the weight, but contradicts no effect.
    models.append({**models[-1], "effects": [], "curve": "curve"})
    return {"verdict": "explained", "added": [], "cpu": 1.0, "models": models, "ranking": [1]}


def test_result_file_says_where_its_cases_come_from(tmp_path):
    from benchmarks import _world_results as results

    record = {
        "run": results.origin(7),
        "number": 0,
        "story": _story({"a": 0.6, "a b": 0.3, "": 0.1}),
    }
    assert record["run"]["seed"] == 7
    path = tmp_path / "r.jsonl"
    with path.open("w") as file:
        results.append(file, results.line_of(record))
        results.append(file, results.line_of({"run": results.origin(7), "number": 1, "error": "x"}))
    first, second = results.read_lines([path])
    assert first["tool"] == second["tool"] == "jaxid"
    # a is in both models, b in the second alone.
    assert [p["probability"] for p in first["story"]["probabilities"]] == pytest.approx([0.9, 0.3])
    assert "models" not in first["story"]
    path.write_text('{"number": 3}\n')
    with pytest.raises(ValueError, match="line 1"):
        results.read_lines([path])


def _line(tool: str, seed: int, kind: str = "single", **more: Any) -> dict[str, Any]:
    """A line of a result file: a spring on joint 1 where the case has an effect."""
    hidden = kind == "single"
    return {
        "tool": tool,
        "run": {"seed": 9, "date": "2026-01-02", "commit": "abc"},
        "number": seed,
        "seed": seed,
        "kind": kind,
        "effects": ["spring"] * hidden,
        "truth": [{"effect": "spring", "joint": 1}] * hidden,
        "robot": "axis",
        "world": "plain",
        "friction": "tanh",
        "noise": "white",
        "law": "unknown",
        **more,
    }


def _answer(right: bool, probability: float | None = None) -> dict[str, Any]:
    added = {"effect": "spring" if right else "end_stop", "joint": 1, "probability": probability}
    marks = {"right": right, "first": right, "named": [right], "extra": int(not right)}
    verdict = {"ratio": 1.1, "sure": True, "verdict": "explained", "wrong_and_sure": int(not right)}
    # The wrong answers share the weight with the right one.
    likely = [{"effect": "spring", "joint": 1, "probability": 0.3}]
    story = {"added": [{**added, "indistinguishable": []}], "cpu": 2.0, "probabilities": likely}
    return {"story": story, "marks": {**marks, **verdict}}


def _few_results() -> list[dict[str, Any]]:
    clean = {"story": {"added": [], "cpu": 1.0}}
    alone = {"right": True, "alarm": False, "ratio": 1.0, "sure": True, "verdict": "adequate"}
    lines = [_line("jaxid", 1, **_answer(True, 0.95)), _line("jaxid", 2, **_answer(False, 0.6))]
    lines += [_line("jaxid", 3, "clean", **clean, marks=alone)]
    lines += [_line("jaxid", 4, error="it broke", noise="bursts")]
    lines += [
        _line("stepwise", k, visible=[size], **_answer(k == 1)) for k, size in ((1, 5.0), (2, 3.0))
    ]
    lines += [_line("stepwise", 3, "clean", visible=[], **clean, marks={**alone, "right": False})]
    return lines


def test_evidence_counts_what_result_files_say():
    from benchmarks import evidence

    lines = _few_results()
    made = evidence.sections(lines)
    # Two of jaxid's three effects are not named: one is wrong, one ended in an error.
    assert "| one effect: named | 1 of 3 (6 to 79 %) |" in made["worlds"]
    assert "probability above 0.05 | 2 of 2 (34 to 100 %) |" in made["worlds"]
    assert "| errors | 1 |" in made["worlds"]
    assert "4 cases; seed 9; date 2026-01-02; commit abc." in made["worlds"]
    # The fourth case was not given to stepwise: it is in no comparison.
    assert made["baselines"].startswith("3 cases")
    assert "| clean: left alone | 1 of 1 (21 to 100 %) | 0 of 1 (0 to 79 %) |" in made["baselines"]
    assert "| 0.5 to 0.7 | 0.600 | 0 of 1" in made["calibration"]
    assert "| 0.9 to 0.99 | 0.950 | 1 of 1" in made["calibration"]
    assert "| 2 to 4 | 0 of 1 (0 to 79 %) | 0 of 1 (0 to 79 %) |" in made["power"]
    assert "| 4 to 8 | 1 of 1 (21 to 100 %) | 1 of 1 (21 to 100 %) |" in made["power"]


@pytest.mark.usefixtures("chromium")
def test_evidence_leaves_hand_written_text_and_draws_the_curves(tmp_path):
    pytest.importorskip("kaleido")
    from benchmarks import _world_results as results
    from benchmarks import evidence

    page, other, file = tmp_path / "page.md", tmp_path / "other.md", tmp_path / "r.jsonl"
    names = ("worlds", "calibration", "baselines", "power")
    marks = [f"<!-- made: {n} -->\nold\n<!-- end: {n} -->\n" for n in names]
    page.write_text("# Title\n" + "by hand\n".join(marks) + "the end\n")
    other.write_text("<!-- made: by world -->\nold\n<!-- end: by world -->\n")
    pages = ["--pages", str(page), str(other)]
    with file.open("w") as lines:
        for line in _few_results():
            results.append(lines, line)
    evidence.main([str(file), *pages])
    once = page.read_text()
    assert "By noise" in other.read_text()
    assert "By law" not in other.read_text()
    assert "| errors | 0 | 1 |" in other.read_text()
    assert "old" not in other.read_text()
    assert once.startswith("# Title\n")
    assert once.endswith("the end\n")
    assert once.count("by hand") == 3
    assert "old" not in once
    assert (tmp_path / "img" / "power.png").stat().st_size > 5000
    evidence.main([str(file), *pages, "--no-figure"])
    assert page.read_text() == once
    page.write_text("no marks")
    with pytest.raises(ValueError, match="no place for worlds"):
        evidence.main([str(file), *pages])


def test_baselines_answer_on_the_recordings_of_the_worlds(tmp_path):
    for module in ("mujoco", "pinocchio", "pysindy", "gplearn", "sklearn"):
        pytest.importorskip(module)
    lines = _quick("baselines", tmp_path)["lines"]
    from benchmarks._baseline_tools import TOOLS
    from benchmarks._world_cases import draw_wanted

    wanted = {w.number: w for w in draw_wanted(1, 2, ("unknown",), "axis")}
    assert {(x["tool"], x["number"]) for x in lines} == {(t, n) for t in TOOLS for n in (0, 1)}
    for line in lines:
        assert "error" not in line, line["error"]
        assert line["seed"] == wanted[line["number"]].seed
        # No tool explains the noise of a recording that it has not seen.
        assert line["marks"]["ratio"] > 0.9
        assert line["story"]["cpu"] > 0
    first = {x["tool"]: x for x in lines if x["number"] == 0}
    # Friction that grows with time is in the library.
    for tool in ("stepwise, validated", "pysindy"):
        assert first[tool]["marks"]["first"]
        assert first[tool]["marks"]["ratio"] < first["rigid"]["marks"]["ratio"]


def test_load_is_what_moves_the_link_and_library_names_what_it_is_given():
    """One pendulum in closed form: the regression finds its numbers, and a spring is a spring."""
    pytest.importorskip("pinocchio")
    import jaxid
    from benchmarks._baseline_rows import Motion, table_of
    from benchmarks._baseline_tools import stepwise_validated
    from benchmarks._world_physics import Link, Robot

    link = Link(False, (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 2.0, (0.0, 0.0, -0.3), 0.05, 0.0, 1.0)
    urdf = Robot("pendulum", (link,)).urdf()
    t = np.arange(0.0, 12.0, 0.005)
    waves = [(0.5, 1.7, 0.2), (0.4, 4.1, 1.0), (0.3, 7.3, 2.0)]
    q = sum(a * np.sin(w * t + p) for a, w, p in waves)
    v = sum(a * w * np.cos(w * t + p) for a, w, p in waves)
    acceleration = -sum(a * w**2 * np.sin(w * t + p) for a, w, p in waves)
    inertia, moment = 0.05 + 2.0 * 0.3**2, 2.0 * 0.3 * 9.81
    moving = inertia * acceleration + moment * np.sin(q)
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(t))
    friction = 0.3 * v + 0.5 * np.tanh(v / 0.05)

    def table(extra: np.ndarray):
        tau = (moving + friction + extra + noise)[:, None]
        return table_of(urdf, [jaxid.Recording.from_arrays(t, q[:, None], tau, name="r")])

    plain = table(np.zeros(len(t)))
    off = plain.load(plain.motions[0])[:, 0] - moving
    assert np.sqrt(np.mean(off[100:-100] ** 2)) < 0.01 * np.std(moving)
    found = stepwise_validated(plain, (False,), 0)
    assert found.named == (), found.named
    drag = stepwise_validated(table(0.05 * v * np.abs(v)), (False,), 0)
    assert drag.named[0] == ("quadratic_drag", 1)
    seen = Motion.of(urdf, jaxid.Recording.from_arrays(t, q[:, None], moving[:, None], name="r"))
    expected = moving + friction + 0.05 * v * np.abs(v)
    error = drag.predict(seen)[:, 0] - expected
    assert np.sqrt(np.mean(error[100:-100] ** 2)) < 0.02 * np.std(expected)


def test_a_fleet_has_one_table_however_it_is_run(tmp_path):
    """In processes, by Dask where it is installed, and killed and resumed; one robot is broken."""
    rows = _quick("fleet", tmp_path)
    robots = {row["robot"]: row for row in rows if row["about"] == "robots"}
    verdicts = {name: row["verdict"] for name, row in robots.items()}
    assert verdicts["robot 00"] == verdicts["robot 03"] == "adequate"
    assert (verdicts["robot 01"], verdicts["robot 02"]) == ("failed", "explained")
    assert robots["robot 02"]["effects"] == "spring(1)"
    ways = [row for row in rows if row["about"] == "ways"]
    assert len(ways) == 3
    for row in ways:
        if row["note"] == "distributed is not installed":
            continue
        assert row["same"], row
        # Where the search ends depends on rounding by as much as a fit's tolerance of 1e-2
        # deviations, which changes the error it leaves by the square of that.
        assert row["numbers_apart"] < 1e-4, row


@pytest.mark.shared
def test_a_measured_servo_is_simulated_from_its_first_sample(tmp_path, shared_data):
    """The errors that the recordings' own README gives, fitted on that same error, in mrad."""
    assert (shared_data / "xl330").is_dir()
    rows = {row["model"]: row for row in _quick("xl330", tmp_path) if row["about"] == "models"}
    assert rows.keys() == {"M1", "M3"}
    # Restarts differ by up to 2 mrad there, and a quick run polishes little.
    for row in rows.values():
        assert row["mean absolute"] < row["README"] + 5
        assert row["mean absolute"] <= row["least squares"]
    assert rows["M3"]["mean absolute"] < 0.85 * rows["M1"]["mean absolute"]
