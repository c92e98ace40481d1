"""Many robots: processes, another executor, a broken one among them, and a run that continues."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import jaxid
from jaxid.cli import app
from jaxid.discovery import fleet
from jaxid.errors import ModelError

MASS, DRAG, DRY = 5.0, 4.0, 3.0
ROBOT = """
import jaxid
from jaxid.control import Tracking
from jaxid.effects import Coulomb, TorqueOffset, Viscous

effects = Viscous(1, 1.0), Coulomb(1, 1.0), TorqueOffset(1)
loop = jaxid.ClosedLoop(jaxid.arms.Axis(M=5.0), Tracking(cutoff=20.0), effects, name="axis")
"""


def recorded(seed, spring=0.0):
    """An axis with friction, and a spring where it is worn; torque written out."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 8.0, 0.005)
    rates = 2 * np.pi * np.array([0.23, 0.61, 1.3])
    sizes, phases = np.array([0.08, 0.03, 0.01]), rng.uniform(0, 6, 3)

    def motion(order):
        turned = time[:, None] * rates + phases + order * np.pi / 2
        return (sizes * rates**order * np.sin(turned)).sum(axis=1)

    q, v, a = map(motion, range(3))
    tau = MASS * a + DRAG * v + DRY * 2 / np.pi * np.arctan(v / 0.01) + spring * q
    tau = tau + 0.02 * rng.standard_normal(len(time))
    return jaxid.Recording.from_arrays(time, q, tau, name=f"run_{seed}")


class Story:
    """What a discovery gives, without one."""

    interrupted = False

    def __init__(self, loop, recordings):
        self.found = {
            "verdict": "adequate",
            "added": [],
            "error_percent": {k: {"fit": [2.0]} for k in ("before", "after")},
            "sentence": f"nothing in {recordings.names[0]}",
        }

    def to_dict(self):
        return self.found


def test_any_executor_works_and_one_that_fails_stops_no_other(monkeypatch, tmp_path):
    asked = []

    def discover(loop, recordings, validate, **settings):
        asked.append((recordings.names[0], settings))
        if recordings.names[0] == "run_2":
            raise ModelError("of a test: mend it")
        return Story(loop, recordings)

    monkeypatch.setattr(fleet, "discover", discover)
    problems = {
        f"robot {k}": jaxid.FleetRobot(jaxid.emps(), [recorded(k)], settings={"most": k})
        for k in (1, 2, 3)
    }
    with ThreadPoolExecutor(2) as executor:
        found = jaxid.discover_all(
            problems, executor, resume=tmp_path / "steps", worth=1.0, progress=False
        )
    assert sorted(found.stories) == ["robot 1", "robot 3"]
    assert found.failed == {"robot 2": "ModelError: of a test: mend it"}
    table = found.table()
    assert table.verdict.tolist() == ["adequate", "failed", "adequate"]
    assert "robot 2" in repr(found)
    json.dumps(found.to_dict())
    assert sorted(a[0] for a in asked) == ["run_1", "run_2", "run_3"]
    assert all(a[1]["worth"] == 1.0 and a[1]["most"] == int(a[0][-1]) for a in asked)
    # What was done is not done again.
    again = jaxid.discover_all(
        problems, resume=tmp_path / "steps", worth=1.0, jobs=1, progress=False
    )
    assert again.to_dict() == found.to_dict()
    assert len(asked) == 3
    with pytest.raises(ModelError, match="no robot"):
        jaxid.discover_all({})


@pytest.mark.slow
def test_a_fleets_worn_joint_stands_out(tmp_path):
    """The command in processes of its own: a sound robot, a worn one, a broken one."""
    (tmp_path / "robot.py").write_text(ROBOT)
    lines = ["name,robot,fit,validate"]
    for name, seeds, spring in (("sound", (1, 2, 3), 0.0), ("worn", (4, 5, 6), 8.0)):
        for k in seeds:
            recorded(k, spring).to_dataframe().to_csv(tmp_path / f"{name}_{k}.csv", index=False)
        a, b, c = (f"{name}_{k}.csv" for k in seeds)
        lines.append(f"{name},robot.py:loop,{a} {b},{c}")
    lines.append("broken,robot.py:loop,absent.csv,")
    table, out = tmp_path / "fleet.csv", tmp_path / "found.json"
    table.write_text("\n".join(lines) + "\n")
    command = ["discover-all", str(table), "--json", str(out), "--jobs", "2"]
    ran = CliRunner().invoke(app, [*command, "--csv", str(tmp_path / "found.csv")])
    assert ran.exit_code == 1
    assert "broken: " in ran.stderr
    assert "there is no such file" in ran.stderr
    found = json.loads(out.read_text())["robots"]
    assert found["sound"]["verdict"] == "adequate"
    assert found["worn"]["verdict"] == "explained"
    (added,) = found["worn"]["added"]
    assert (added["effect"], added["joint"]) == ("spring", 1)
    stiffness = next(iter(added["parameters"].values()))
    assert stiffness["value"] == pytest.approx(8.0, rel=0.05)
    assert Path(tmp_path / "found.csv").read_text().count("\n") == 4


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name,robot\na,scara\n", "no column 'fit'"),
        ("name,robot,fits\na,scara,x.csv\n", "an unknown column 'fits'"),
        ("name,robot,fit\na,scara,x.csv\na,scara,y.csv\n", "'a' twice"),
    ],
)
def test_a_table_that_says_something_else_is_refused(text, says, tmp_path):
    (tmp_path / "fleet.csv").write_text(text)
    ran = CliRunner().invoke(app, ["discover-all", str(tmp_path / "fleet.csv")])
    assert ran.exit_code == 2
    assert says in ran.stderr
    assert len(ran.stderr.splitlines()) == 1
