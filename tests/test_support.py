"""Effects must explain stretches of the recordings from which they were not estimated."""

import dataclasses

import numpy as np
import pytest
from test_noise_floor import DURATION, RATE, axis
from test_release import arctan, recorded
from test_release import axis as drive

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.data import Data
from jaxid.discovery.support import _errors, _stretches
from jaxid.discovery.table import SignatureTable
from jaxid.effects import EndStop, Spring, ThermalDrift
from jaxid.estimate.minimise import Prior

STRETCH = np.repeat(np.arange(6), 200)


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_stretch_that_is_left_out_is_predicted_from_the_others(everywhere):
    rng = np.random.default_rng(3)
    base = rng.standard_normal((1200, 3))
    column = rng.standard_normal(1200) * (everywhere | (STRETCH == 2))
    noise = rng.standard_normal(1200)
    target = base @ [1.0, -2.0, 0.5] + 4 * column + noise
    fitted, apart = _errors(target, np.column_stack([base, column]), STRETCH)
    without, apart_without = _errors(target, base, STRETCH)
    assert fitted == pytest.approx(noise @ noise, rel=0.02)
    gain = (apart_without - apart) / (without - fitted)
    # An amplitude that 1000 rows tell is predicted as well as it is fitted.
    assert gain == pytest.approx(1.0, abs=0.02) if everywhere else abs(gain) < 0.05


def test_each_recording_is_cut_by_its_own_length():
    """A short recording is padded, and an effect may act in it alone."""
    mask = np.arange(600) < np.array([600, 90])[:, None]
    shape = (2, 600, 2)
    known = Prior(np.eye(1, 3), np.zeros(3))
    table = SignatureTable.of(np.ones((*shape, 0)))
    data = Data(np.ones(shape), np.ones((*shape, 3)), table, mask, known=known)
    *rows, last = _stretches(data)
    assert last == -1
    number = np.reshape(rows, shape)[..., 0]
    sizes = [
        np.unique(n[m], return_counts=True)[1].tolist() for n, m in zip(number, mask, strict=True)
    ]
    assert sizes == [[200] * 3, [30] * 3]
    assert not set(number[0][mask[0]]) & set(number[1][mask[1]])


def test_a_prior_belongs_to_every_estimate():
    """Without rows that are left out, knowledge of a value changes what is fitted and predicted."""
    rng = np.random.default_rng(4)
    column, noise = rng.standard_normal((2, 1200))
    target, columns = np.append(column + noise, 0.0), np.append(column, 1e9)[:, None]
    fitted, apart = _errors(target, columns, np.append(STRETCH, -1))
    assert [fitted, apart] == pytest.approx([np.sum((column + noise) ** 2)] * 2, rel=1e-3)


def warming(there: np.ndarray | float = 1.0) -> jaxid.Recording:
    """The slide with friction that fades, throughout or where `there` says."""
    record, _ = axis(1)
    v = np.gradient(record.q[:, 0], record.period)
    fading = (2.0 * np.tanh(v / 0.005) + 1.0 * v) * np.exp(-3 * record.time / DURATION)
    tau = record.tau + (fading * there)[:, None]
    return jaxid.Recording.from_arrays(record.time, record.q, tau, name="warming")


@pytest.mark.slow
def test_what_one_stretch_shows_is_not_believed():
    loop = jaxid.robots.emps(Tracking())
    last = np.arange(int(DURATION * RATE)) * 6 // int(DURATION * RATE) == 5
    added = []
    for record in (warming(), warming(20.0 * last)):
        story = jaxid.discover(loop, record, catalogue=(ThermalDrift,), progress=False)
        added.append([s.added.effect_name() for s in story.steps if s.added])
    assert added == [["thermal_drift"], []]


def test_a_stop_may_be_touched_once():
    """Without its only contact its stiffness is unknown, but a stop is no error of one stretch."""
    stiffness, angle = 400.0, 0.095
    records = []
    for seed in (3, 2):
        record = recorded(seed, arctan, noise=0.1)
        tau = record.tau + stiffness * np.maximum(record.q - angle, 0.0)
        records.append(dataclasses.replace(record, tau=tau))
    touched = np.flatnonzero(records[0].q[:, 0] > angle)
    assert np.unique(touched * 6 // len(records[0].q)).size == 1
    story = jaxid.discover(
        drive(), records[0], validate=records[1], catalogue=(EndStop, Spring), progress=False
    )
    (added,) = story.to_dict()["added"]
    assert added["effect"] == EndStop.effect_name()
    assert added["parameters"]["stiffness"]["value"] == pytest.approx(stiffness, rel=0.1)
    assert story.verdict == "explained"
