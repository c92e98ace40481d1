"""`jaxid fit`, `jaxid compare` and `jaxid demo`; `jaxid discover` has a file of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import jaxid
import jaxid.discovery
from jaxid.cli import app, application
from jaxid.cli.models import load_robot, saved_model
from jaxid.errors import ModelError

DEMO = Path(jaxid.__file__).parent / "demo" / "clean"
FIT_1, FIT_2, HELD_OUT = (str(DEMO / f"{name}.csv") for name in ("fit_1", "fit_2", "held_out"))

OWN_ROBOT = """
import jaxid

loop = jaxid.scara().hold("MY2")


def make():
    return loop


wrong = 3
"""


SCARA = ("--robot", "scara")


def run(*arguments):
    """The command's result; an exception that it does not turn into a sentence is raised."""
    return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A fit by the command: what it printed, and the file that it wrote."""
    path = tmp_path_factory.mktemp("cli") / "fit.json"
    return run("fit", FIT_1, FIT_2, *SCARA, "--json", path), path


def test_fit_prints_a_table_and_writes_the_same_as_json(fitted):
    result, path = fitted
    assert result.exit_code == 0
    assert "OEM() of scara to fit_1, fit_2: converged" in result.stdout
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["status"] == "converged"
    assert content["parameters"]["ZZ1r"]["unit"] == "kg·m²"
    shown = float(next(x for x in result.stdout.splitlines() if x.startswith("ZZ1r")).split()[1])
    # Four digits are shown.
    assert shown == pytest.approx(content["parameters"]["ZZ1r"]["value"], rel=5e-4)
    # The demo's noise is 1.5 % of the torque.
    assert all(1.4 < x < 1.6 for row in content["error_percent"].values() for x in row)


def test_compare_takes_what_fit_wrote(fitted, tmp_path):
    _, path = fitted
    out, figure = tmp_path / "compare.json", tmp_path / "compare.html"
    result = run("compare", HELD_OUT, *SCARA, "--fit", path, "--json", out, "--plot", figure)
    assert result.exit_code == 0
    errors = json.loads(out.read_text(encoding="utf-8"))["error_percent"]["held_out"]
    assert all(1.4 < x < 1.7 for x in errors)
    assert f"{errors[0]:.4g}" in result.stdout
    assert "plotly" in figure.read_text(encoding="utf-8")
    # The CAD start is far off, so the fitted values were used.
    start = run("compare", HELD_OUT, *SCARA)
    assert start.exit_code == 0
    assert f"{errors[0]:.4g}" not in start.stdout


@pytest.mark.parametrize("method", ["idim", "didim", "idim-iv"])
def test_other_methods_by_name(method, tmp_path):
    path = tmp_path / "fit.json"
    assert run("fit", FIT_1, *SCARA, "--method", method, "--json", path).exit_code == 0
    name = {"idim": "IDIM(", "didim": "DIDIM(", "idim-iv": "IDIMIV("}[method]
    assert json.loads(path.read_text(encoding="utf-8"))["method"].startswith(name)


def test_a_robot_of_ones_own(tmp_path):
    file = tmp_path / "my_robot.py"
    file.write_text(OWN_ROBOT)
    for name in ("loop", "make"):
        assert "MY2" in load_robot(f"{file}:{name}").held_names
    result = run("fit", FIT_1, "--robot", f"{file}:loop", "--method", "idim")
    assert result.exit_code == 0
    assert "MX2" in result.stdout
    assert "MY2" not in result.stdout


def test_columns_and_units_by_name(tmp_path):
    frame = pd.read_csv(FIT_1)
    for name in ("q_1", "q_2", "q_ref_1", "q_ref_2"):
        frame[name] *= 57.29577951308232
    frame = frame.rename(columns={"q_1": "angle_a", "q_2": "angle_b"})
    frame.to_csv(tmp_path / "degrees.csv", index=False)
    one, other = tmp_path / "one.json", tmp_path / "other.json"
    columns = ("--column", "time=time", "--column", "q=angle_a,angle_b")
    columns += ("--column", "q_ref=q_ref_1,q_ref_2", "--column", "tau=tau_1,tau_2")
    units = ("--unit", "q=deg", "--unit", "q_ref=deg")
    here = run(
        "fit", tmp_path / "degrees.csv", *SCARA, *columns, *units, "--method", "idim", "--json", one
    )
    assert here.exit_code == 0, here.stderr
    run("fit", FIT_1, *SCARA, "--method", "idim", "--json", other)
    values = [json.loads(p.read_text(encoding="utf-8"))["parameters"] for p in (one, other)]
    for name, entry in values[0].items():
        assert entry["value"] == pytest.approx(values[1][name]["value"], rel=1e-6, abs=1e-9)


def test_a_fit_that_failed_ends_with_one(monkeypatch, tmp_path):
    file = tmp_path / "slow.py"
    file.write_text("import jaxid\nloop = jaxid.scara().with_values(MX2=9.0)\n")
    monkeypatch.setattr(
        jaxid.estimate, "OEM", lambda **settings: jaxid.OEM(**settings, start="given")
    )
    result = run("fit", FIT_1, "--robot", f"{file}:loop", "--json", tmp_path / "fit.json")
    assert result.exit_code == 1
    assert "no parameter values were found" in result.stdout
    assert json.loads((tmp_path / "fit.json").read_text())["status"] == "diverged"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["fit", "absent.csv", *SCARA], "absent.csv"),
        (["fit", FIT_1], "no robot is given"),
        (["compare", FIT_1], "no robot is given"),
        (["fit", FIT_1, *SCARA, "--log", "absent.toml"], "jaxid inspect --write creates one"),
        (["fit", FIT_1, *SCARA, "--log", FIT_1], "is not valid TOML"),
        (["fit", FIT_1, *SCARA, "--unit", "q=deg,deg,deg"], "3 units for q of 2 joints"),
        (["fit", FIT_1, "--robot", "delta"], "there is no robot 'delta': choose scara"),
        (["fit", FIT_1, "--robot", "absent.py:loop"], "there is no file absent.py"),
        (["fit", FIT_1, "--robot", "emps"], "choose another robot"),
        (["fit", FIT_1, *SCARA, "--method", "guess"], "there is no method 'guess': choose oem"),
        (["fit", FIT_1, *SCARA, "--controller", "fuzzy"], "there is no controller 'fuzzy'"),
        (["fit", FIT_1, *SCARA, "--column", "q"], "has no '='"),
        (["fit", FIT_1, *SCARA, "--unit", "q=parsec"], "is not a unit known for q"),
        (["fit", FIT_1, *SCARA, "--window", "0.01"], "make it longer"),
        (["compare", FIT_1, *SCARA, "--fit", FIT_1], "contains no fitted parameters"),
        (["compare", FIT_1, *SCARA, "--fit", "absent.json"], "there is no file absent.json"),
        (["fit", FIT_1, FIT_1, *SCARA], "name each recording once"),
    ],
)
def test_a_users_error_is_one_sentence(arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert says in result.stderr
    assert result.stderr.startswith("jaxid: ")
    assert len(result.stderr.splitlines()) == 1


def test_values_of_another_robot_are_refused(tmp_path):
    file = tmp_path / "fit.json"
    file.write_text(json.dumps({"parameters": {"stiffness": {"value": 1.0}}}))
    result = run("compare", FIT_1, *SCARA, "--fit", file)
    assert result.exit_code == 2
    assert "has stiffness, which" in result.stderr
    assert "it is of another robot" in result.stderr


def test_what_is_wrong_with_ones_own_robot_is_said(tmp_path):
    file = tmp_path / "my_robot.py"
    file.write_text(OWN_ROBOT)
    for name in ("wrong", "absent"):
        with pytest.raises(ModelError, match="has no ClosedLoop called"):
            load_robot(f"{file}:{name}")
    with pytest.raises(ModelError, match=f"without its loop: give --robot {file}:loop"):
        load_robot(str(file))
    broken = tmp_path / "broken.py"
    for text, says in (
        ("import jaxid\nimport nothing_of_that_name\n", "line 2: ModuleNotFoundError: No module"),
        ("loop = (\n", "line 1: '.' was never closed"),
    ):
        broken.write_text(text)
        with pytest.raises(ModelError, match=rf"fails when it is imported \({says}"):
            load_robot(f"{broken}:loop")
    file.write_text(OWN_ROBOT + "\n\ndef asks(more):\n    return loop\n")
    with pytest.raises(ModelError, match=r"asks\(\) in .* give a function without arguments"):
        load_robot(f"{file}:asks")


def test_annotations_of_ones_own_robot_may_be_strings(tmp_path):
    file = tmp_path / "robot_of_strings.py"
    own = "\n\nclass Mine(jaxid.effects.AbstractEffect):\n    joint: int = 1\n"
    file.write_text("from __future__ import annotations\n" + OWN_ROBOT + own)
    assert "MX2" in load_robot(f"{file}:loop").names


def test_the_bodies_of_a_urdf_are_estimated_if_asked(tmp_path):
    file = tmp_path / "slide.urdf"
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    file.write_text(
        f'<robot name="one"><link name="a"/><link name="b"><inertial><mass value="2"/>{inertia}'
        '</inertial></link><joint name="j" type="prismatic"><parent link="a"/><child link="b"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="9" velocity="1"/></joint></robot>'
    )
    drawn, near, free = (load_robot(f"{file}{end}") for end in ("", ":near", ":free"))
    assert not any(p.declaration.symbol == "base" for p in drawn.free_parameters)
    for loop in (near, free):
        assert any(p.declaration.symbol == "base" for p in loop.free_parameters)
    assert near.arm.covariance is not None
    assert free.arm.covariance is None
    assert "density1" in [n for p in load_robot(f"{file}:physical").parameters for n in p.names]
    with pytest.raises(
        ModelError, match="bodies is 'far': give 'drawn', 'near', 'physical' or 'free'"
    ):
        load_robot(f"{file}:far")


def test_windows_are_refused_where_nothing_is_simulated():
    result = run("fit", FIT_1, *SCARA, "--method", "idim", "--window", "1")
    assert result.exit_code == 2
    assert "leave out --window" in result.stderr


def test_vectors_come_back_from_a_file_of_fitted_parameters(tmp_path):
    own = tmp_path / "curved.py"
    curve = 'jaxid.Curve(joint=1, coordinate="q", of=1, low=-1.0, high=1.0)'
    own.write_text(f"import jaxid\nloop = jaxid.scara().add({curve})\n")
    loop = load_robot(f"{own}:loop")
    several = [name for name in loop.names if name.endswith("[2]")]
    assert several
    path = tmp_path / "fit.json"
    values = {name: 0.01 * k for k, name in enumerate(loop.names, start=1)}
    found = {"parameters": {name: {"value": value} for name, value in values.items()}}
    path.write_text(json.dumps(found))
    assert np.allclose(saved_model(f"{own}:loop", path).theta, list(values.values()))


def test_demo_tells_both_stories_on_files_that_are_shipped(monkeypatch):
    class Story:
        verdict, sentence = "adequate", "a story of two lines"

        def __repr__(self):
            return "adequate: a story\nof two lines"

        def table(self):
            return pd.DataFrame({"held out, joint 1": [4.0, 2.0]}, index=["start", "with it"])

    asked = []

    def discover(loop, used, validate, progress):
        asked.append((loop.name, used.names, validate.names, used[0].q[:3].tolist()))
        return Story()

    monkeypatch.setattr(jaxid.discovery, "discover", discover)
    result = run("demo")
    assert result.exit_code == 0
    assert [a[:3] for a in asked] == [("scara", ("fit_1", "fit_2"), ("held_out",))] * 2
    assert result.stdout.count("of two lines") == 2
    # Each error as a bar, the start's twice as long as what is left.
    bars = [line.count("█") for line in result.stdout.splitlines() if "█" in line]
    assert bars == [30, 15, 30, 15]
    # What the words of the tables mean is said, once.
    assert result.stdout.count("noise floor:") == 1
    brief = run("demo", "--quiet").stdout.splitlines()
    assert brief.count("adequate: a story of two lines") == 2
    assert not any("█" in line for line in brief)


def test_quiet_is_one_line(fitted):
    _, path = fitted
    result = run("compare", HELD_OUT, *SCARA, "--fit", path, "--quiet")
    assert result.exit_code == 0
    assert len(result.stdout.splitlines()) == 1
    assert result.stdout.startswith("scara: joint 1 1.5")
    brief = run("fit", FIT_1, *SCARA, "--method", "idim", "-q").stdout.splitlines()
    assert len(brief) == 1
    assert brief[0].startswith("IDIM(")


@pytest.mark.parametrize("command", [[], ["fit"], ["compare"], ["discover"], ["demo"]])
def test_help_has_examples_and_exit_codes(command):
    said = run(*command, "--help").stdout
    assert f"jaxid {' '.join(command)}".strip() in said
    assert "Example" in said
    assert "xit code" in said or command == ["demo"]
    # Nothing was run together: an example is a line of its own.
    assert any(line.strip().startswith("jaxid ") for line in said.splitlines())


def test_colours_are_for_terminals_that_want_them(fitted):
    result, _ = fitted
    assert "\x1b" not in result.stdout + result.stderr


@pytest.mark.parametrize("chosen", ["", "cpu,cuda"])
def test_the_command_computes_on_the_cpu_unless_a_backend_is_chosen(chosen, monkeypatch):
    before = jax.config.jax_platforms
    monkeypatch.setenv("JAX_PLATFORMS", chosen)
    try:
        application._use_processor()
        assert os.environ["JAX_PLATFORMS"] == (chosen or "cpu")
        assert jax.config.jax_platforms == (before if chosen else "cpu")
    finally:
        jax.config.update("jax_platforms", before)


def test_the_package_is_the_command_too():
    ran = subprocess.run([sys.executable, "-m", "jaxid", "--help"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert "discover" in ran.stdout
