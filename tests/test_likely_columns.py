"""Guesses of the columns of a logger, which an error message offers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import jaxid
from jaxid.cli import app
from jaxid.errors import RecordingError
from jaxid.recording._likely import likely_columns

LOGGERS = {
    "ros": (
        ["timestamp", "joint_position_0", "joint_position_1", "joint_effort_0", "joint_effort_1"],
        {"time": [0], "q": [1, 2], "tau": [3, 4]},
    ),
    "units in brackets": (
        ["Time [ms]", "J2 Position (deg)", "J10 Position (deg)", "J2 Torque (Nm)", "J2 Pos Error"],
        {"time": [0], "q": [1, 2], "tau": [3]},
    ),
    "reference beside": (
        ["t", "target_q_1", "actual_q_1", "actual_qd_1", "actual_torque_1", "joint_temp_1"],
        {"time": [0], "q": [2], "q_ref": [1], "v": [3], "tau": [4]},
    ),
    "camel case": (
        ["Time", "jointPosition1", "jointVelocity1", "jointTorque1"],
        {"time": [0], "q": [1], "v": [2], "tau": [3]},
    ),
    "positions on both sides of a gear": (
        ["Time", "motorPos1", "linkPos1", "torque1"],
        {"time": [0], "tau": [3]},
    ),
    "two clocks": (["t1", "t2", "pos_1"], {"q": [2]}),
    "nothing": (["a", "b"], {}),
}


@pytest.mark.parametrize("logger", LOGGERS)
def test_columns_of_loggers_are_guessed(logger):
    names, expected = LOGGERS[logger]
    assert likely_columns(names) == {s: [names[k] for k in at] for s, at in expected.items()}


def test_joints_are_sorted_by_number():
    assert likely_columns(["pos_10", "pos_9", "pos_1"]) == {"q": ["pos_1", "pos_9", "pos_10"]}


def test_the_offered_options_read_the_file(tmp_path: Path):
    time = np.arange(0, 2, 0.01)
    columns = {"stamp": time}
    for k in (0, 1):
        columns[f"Joint {k} position"] = np.sin((k + 1) * time)
        columns[f"Joint {k} effort"] = np.cos((k + 3) * time)
    file = tmp_path / "log.csv"
    pd.DataFrame(columns).to_csv(file, index=False)
    with pytest.raises(RecordingError, match="'q_1' is missing"):
        jaxid.read(file)
    refused = CliRunner().invoke(app, ["inspect", str(file)])
    assert refused.exit_code == 2
    said = " ".join(refused.output.split())
    for option in (
        "--column time=stamp",
        "--column 'q=Joint 0 position,Joint 1 position'",
        "--column 'tau=Joint 0 effort,Joint 1 effort'",
    ):
        assert option in said
    chosen = {"time": "stamp", "q": "Joint 0 position,Joint 1 position"}
    chosen["tau"] = chosen["q"].replace("position", "effort")
    options = [x for of, those in chosen.items() for x in ("--column", f"{of}={those}")]
    assert CliRunner().invoke(app, ["inspect", str(file), *options]).exit_code == 0
