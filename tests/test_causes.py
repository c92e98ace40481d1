"""Mistakes in the data are named: made on purpose in recordings of the independent simulator."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import jaxid
from jaxid.discovery.causes import likely_cause

CLEAN = Path(jaxid.__file__).parent / "demo" / "clean"


@pytest.fixture(scope="module")
def clean():
    """Two recordings of a SCARA as they are."""
    return jaxid.read(CLEAN / "fit_1.csv", CLEAN / "fit_2.csv")


def spoilt(recordings, change):
    """Every recording with a mistake."""
    made = [dataclasses.replace(r, **change(r)) for r in recordings]
    return jaxid.Recordings.of(made)


MISTAKES = {
    "sign of joint 2": (
        lambda r: {"tau": r.tau * [1, -1]},
        "torque of joint 2 seems to have the wrong sign",
    ),
    "all signs": (lambda r: {"tau": -r.tau}, "torque of all joints seems to have the wrong sign"),
    "swapped": (lambda r: {"tau": r.tau[:, ::-1]}, "torques of joints 1 and 2"),
    "degrees": (
        lambda r: {"q": np.rad2deg(r.q)},
        "position of all joints seems to be in degrees, not",
    ),
    "noise alone": (
        lambda r: {"q": r.q * [1, 0] + 1e-4 * np.random.default_rng(1).normal(size=r.q.shape)},
        "joint 2 moves by",
    ),
    "still": (lambda r: {"q": r.q * [1, 0]}, "joint 2 moves by 0 only"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(clean, name):
    change, said = MISTAKES[name]
    assert re.search(said, likely_cause(jaxid.scara(), spoilt(clean, change)))


def test_recordings_without_a_mistake_are_not_blamed(clean):
    assert likely_cause(jaxid.scara(), clean) == ""


def test_what_is_no_mistake_is_not_named_as_one(clean):
    """Torque that has nothing to do with the motion."""
    rng = np.random.default_rng(0)
    noise = spoilt(clean, lambda r: {"tau": rng.normal(size=r.tau.shape)})
    assert likely_cause(jaxid.scara(), noise) == ""
