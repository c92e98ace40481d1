"""`jaxid discover` and `jaxid demo` on the bundled recordings, and what users get wrong."""

import dataclasses
import functools
import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pytest
from typer.testing import CliRunner

import jaxid
import jaxid.discovery
from jaxid.cli import app
from jaxid.cli.discovering import spread
from jaxid.cli.models import load_effect

# What one worker has fitted serves all of them.
pytestmark = pytest.mark.xdist_group("demo")


DEMO = Path(jaxid.__file__).parent / "demo"
HIDDEN = [str(DEMO / "hidden" / f"{name}.csv") for name in ("fit_1", "fit_2", "held_out")]
SCARA = ("--robot", "scara")


HOSE = """
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxid


class Hose(jaxid.effects.AbstractEffect):
    joint: int = eqx.field(static=True)
    pull: jax.Array = jaxid.parameter(0.0, symbol="hose", unit="N·m", scale=0.1)

    def torque(self, motion):
        angle = motion.q[self.joint - 1]
        return jaxid.effects.on_joint(self.joint, self.pull * jnp.sin(2 * angle), motion)
"""


class Told(NamedTuple):
    """One run of the command: what it printed and wrote, and the story itself."""

    output: str
    exit_code: int
    json: dict[str, Any]
    page: Path
    journal: Path
    saved: Path
    story: jaxid.Discovery


@functools.cache
def told() -> Told:
    """The hidden set through the command, once for all tests of a process; tests/test_report too.

    A fixture would be run once for each file that asks for it.
    """
    stories = []
    real = jaxid.discovery.discover

    def kept(*args, **settings):
        stories.append(real(*args, **settings))
        return stories[-1]

    folder = Path(tempfile.mkdtemp(prefix="jaxid-story-"))
    out = [folder / name for name in ("story.json", "story.html", "steps", "story.jaxid")]
    named = zip(("--json", "--report", "--resume", "--save"), map(str, out), strict=True)
    options = [word for pair in named for word in pair]
    with mock.patch.object(jaxid.discovery, "discover", kept):
        # Two files after one --validate: the second is held out as well.
        twin = folder / "other_day.csv"
        twin.write_bytes(Path(HIDDEN[2]).read_bytes())
        command = ["discover", *HIDDEN[:2], "--validate", HIDDEN[2], str(twin), *SCARA, *options]
        result = CliRunner().invoke(app, command, catch_exceptions=False)
    return Told(
        result.output,
        result.exit_code,
        json.loads(out[0].read_text(encoding="utf-8")),
        out[1],
        out[2],
        out[3],
        stories[0],
    )


def test_it_finds_the_hidden_effect_and_ends_well() -> None:
    run = told()
    assert run.exit_code == 0
    assert run.output.startswith(f"{run.json['verdict']}: ")
    first = run.json["added"][0]
    assert (first["effect"], first["joint"]) == ("stribeck", 2)
    # What tests/independent/demo.py hid: 0.08 N·m, gone at 0.4 rad/s.
    assert first["parameters"]["level"]["value"] == pytest.approx(0.08, rel=0.1)
    assert first["parameters"]["velocity"]["value"] == pytest.approx(0.4, rel=0.1)


def test_the_error_on_unseen_recordings_falls_to_the_noise() -> None:
    errors = told().json["error_percent"]
    before, after = errors["before"]["validate"], errors["after"]["validate"]
    assert after[1] < before[1] / 3
    floor = told().json["noise_floor_percent"]
    assert all(x < 1.2 * f for x, f in zip(after, floor, strict=True))


def test_the_json_has_the_fields_of_its_page() -> None:
    found = told().json
    assert found["robot"] == "scara"
    assert found["verdict"] in ("adequate", "explained", "outside_catalogue", "undetermined")
    assert bool(found["reason"]) == (found["verdict"] == "undetermined")
    assert found["added"][0]["probability"] > 0.99
    best = found["models"][0]
    assert best["effects"] == [{"effect": "stribeck", "joint": 2}]
    assert best["weight"] > 0.99
    assert best["status"] == "converged"
    assert len(best["fit_percent"]) == len(best["validate_percent"]) == 2
    assert {"effect", "joint", "p_value", "predicted_error_percent"} <= set(found["ranking"][0])
    assert len(found["ranking"][0]["predicted_error_percent"]) == 2
    assert {"effect", "joint", "parameters", "indistinguishable"} <= set(found["added"][0])
    assert set(found["added"][0]["parameters"]["level"]) == {"value", "std", "unit"}
    assert all({"coordinate", "joint", "p_value"} <= set(d) for d in found["depends_on"])
    assert bool(found["depends_on"]) == (found["verdict"] == "outside_catalogue")
    for when in ("before", "after"):
        assert [len(found["error_percent"][when][kind]) for kind in ("fit", "validate")] == [2, 2]
    assert len(found["noise_floor_percent"]) == 2


def test_an_effect_of_the_users_is_asked_beside_the_known_ones(tmp_path: Path) -> None:
    asked: list[Any] = []
    # Before the command is patched, which tells the story.
    story = told().story

    def listening(*args: Any, catalogue: Any, **settings: Any) -> jaxid.Discovery:
        asked.extend(catalogue)
        return story

    (tmp_path / "own.py").write_text(HOSE, encoding="utf-8")
    own = ["--catalogue", str(tmp_path / "own.py") + ":Hose"]
    with mock.patch.object(jaxid.discovery, "discover", listening):
        run = CliRunner().invoke(
            app, ["discover", *HIDDEN[:2], *SCARA, *own], catch_exceptions=False
        )
    assert run.exit_code == 0
    assert tuple(asked[:-1]) == jaxid.catalogue
    assert asked[-1].effect_name() == "hose"


def test_what_is_asked_and_the_exit_code_follow_the_options() -> None:
    asked: dict[str, Any] = {}
    story = dataclasses.replace(told().story, verdict="undetermined", reason="of a test")

    def listening(*args: Any, **settings: Any) -> jaxid.Discovery:
        asked.update(settings)
        return story

    options = ["--exclude", "stribeck", "--worth", "2"]
    with mock.patch.object(jaxid.discovery, "discover", listening):
        run = CliRunner().invoke(
            app, ["discover", *HIDDEN[:2], *SCARA, *options], catch_exceptions=False
        )
    assert run.exit_code == 3
    assert "of a test" in " ".join(run.stdout.split())
    assert asked["worth"] == 2
    left = {entry.effect_name() for entry in asked["catalogue"]}
    assert left == {entry.effect_name() for entry in jaxid.catalogue} - {"stribeck"}
    run = CliRunner().invoke(app, ["discover", *HIDDEN[:2], *SCARA, "--exclude", "stribec"])
    assert run.exit_code == 2
    assert "no effect 'stribec'" in run.stderr


def test_the_saved_model_can_be_held_against_recordings(tmp_path: Path) -> None:
    run = told()
    command = ["compare", HIDDEN[2], "--fit", str(run.saved), "--json", str(tmp_path / "e.json")]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert run.story.steps[-1].held_out is not None
    expected = run.story.steps[-1].held_out.error_percent.iloc[0].tolist()
    written = json.loads((tmp_path / "e.json").read_text(encoding="utf-8"))
    assert next(iter(written["error_percent"].values())) == pytest.approx(expected)


def test_a_saved_effect_of_the_users_is_found_in_its_file(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(HOSE, encoding="utf-8")
    given = str(tmp_path / "own.py") + ":Hose"
    fit = told().story.fit
    hose = load_effect(given)(joint=1)
    path = dataclasses.replace(fit, loop=fit.loop.add(hose)).save(tmp_path / "fit.jaxid")
    command = ["compare", HIDDEN[2], "--fit", str(path)]
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    assert "Hose" in refused.stderr
    result = CliRunner().invoke(app, [*command, "--catalogue", given], catch_exceptions=False)
    assert result.exit_code == 0


def test_several_held_out_files_follow_one_option() -> None:
    assert told().story.steps[0].held_out.recordings.names == ("held_out", "other_day")


def test_report_and_journal_are_written() -> None:
    assert told().page.stat().st_size > 2**20
    assert (told().journal / "plan.json").exists()
    assert len(list(told().journal.glob("*.piece"))) == len(told().story.steps) + 1


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("a --validate b c", "a --validate b --validate c"),
        ("a b --validate c d --robot emps", "a b --validate c --validate d --robot emps"),
        ("a --robot emps b --validate c d", "a --robot emps b --validate c --validate d"),
        ("a --validate=b c --quiet", "a --validate=b --validate c --quiet"),
        ("--validate b a", "--validate b a"),
        ("--robot emps --validate b a", "--robot emps --validate b a"),
        ("a --validate b -- c", "a --validate b -- c"),
        ("a --validate", "a --validate"),
    ],
)
def test_one_option_takes_several_files(given: str, meant: str) -> None:
    valued = {"--validate", "--robot"}
    assert spread(given.split(), "--validate", valued) == meant.split()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["absent.csv", *SCARA], "there is no such file"),
        ([HIDDEN[0]], "no robot is given"),
        ([HIDDEN[0], *SCARA, "--validate", HIDDEN[0]], "both fitted and held out"),
        ([HIDDEN[0], "--robot", "kuka"], "there is no robot 'kuka'"),
        ([HIDDEN[0], "--robot", "absent.py:loop"], "there is no file absent.py"),
        ([HIDDEN[0], *SCARA, "--catalogue", "absent.py:Hose"], "there is no file absent.py"),
        ([HIDDEN[0], *SCARA, "--catalogue", "stribeck"], "give FILE.py:NAME of its class"),
        ([HIDDEN[0], *SCARA, "--catalogue", f"{__file__}:Hose"], "has no effect called 'Hose'"),
        ([HIDDEN[0], "--robot", "emps"], "has 2 joints, but the robot emps has 1"),
        ([HIDDEN[0], *SCARA, "--json", "absent/story.json"], "there is no folder absent"),
        ([HIDDEN[0], *SCARA, "--report", "absent/story.html"], "there is no folder absent"),
        ([HIDDEN[0], *SCARA, "--column", "q"], "has no '='"),
        ([HIDDEN[0], *SCARA, "--unit", "q=parsec"], "is not a unit known for q"),
        ([HIDDEN[0], *SCARA, "--controller", "fuzzy"], "there is no controller 'fuzzy'"),
    ],
)
def test_a_users_error_is_one_sentence(
    options: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["discover", *options])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert says in result.stderr
    assert result.stderr.startswith("jaxid: ")
    assert len(result.stderr.splitlines()) == 1


def test_without_recordings_it_says_what_is_missing() -> None:
    result = CliRunner().invoke(app, ["discover"])
    assert result.exit_code == 2
    assert "Missing argument" in result.stderr


def _interrupted(monkeypatch: pytest.MonkeyPatch, after: int, *options: str) -> Any:
    """The command's end, interrupted when so many steps are saved."""

    def stop(*args, resume, **settings):
        if after:
            resume.mkdir()
        for k in range(after):
            (resume / f"turn_{k}.piece").write_text("kept", encoding="utf-8")
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxid.discovery, "discover", stop)
    result = CliRunner().invoke(app, ["discover", HIDDEN[0], *SCARA, *options])
    assert result.exit_code == 130
    assert "Traceback" not in result.stderr
    return result


def test_an_interrupt_keeps_the_steps_and_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    steps = tmp_path / "steps"
    said = _interrupted(monkeypatch, 2, "--resume", str(steps)).stderr
    assert "interrupted with 2 steps done" in said
    assert f"to continue, repeat the command with --resume {steps}" in said
    # Without --resume the steps are kept too, beside what is there already.
    for name in ("jaxid-steps", "jaxid-steps-2"):
        said = _interrupted(monkeypatch, 1).stderr
        assert f"repeat the command with --resume {name}" in said
        assert [kept.read_text() for kept in (tmp_path / name).iterdir()] == ["kept"]
    assert "nothing is saved" in _interrupted(monkeypatch, 0).stderr
    left = sorted(p.name for p in tmp_path.iterdir())
    assert left == ["jaxid-steps", "jaxid-steps-2", "steps"]


def test_help_shows_examples() -> None:
    result = CliRunner().invoke(app, ["discover", "--help"])
    assert result.exit_code == 0
    assert "jaxid discover fit_1.csv fit_2.csv --validate held_out.csv --robot" in result.stdout
