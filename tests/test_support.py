"""Effects must explain stretches of the recordings from which they were not estimated."""

import numpy as np
import pytest
from test_noise_floor import axis

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.support import _errors
from jaxid.effects import PeriodicDisturbance

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


def humming(stretch: int | None) -> jaxid.Recording:
    """The slide with a slow hum, 0.57 Hz, throughout or in one stretch."""
    record, _ = axis(1)
    there = True if stretch is None else np.arange(record.samples) * 6 // record.samples == stretch
    hum = 1.5 * np.sin(2 * np.pi * 0.57 * record.time) * there
    tau = record.tau + hum[:, None]
    return jaxid.Recording.from_arrays(record.time, record.q, tau, name="humming")


@pytest.mark.slow
def test_what_one_stretch_shows_is_not_believed():
    loop = jaxid.robots.emps(Tracking())
    stories = [
        jaxid.discover(loop, humming(k), catalogue=(PeriodicDisturbance,), progress=False)
        for k in (None, 2)
    ]
    added = [[s.added.effect_name() for s in story.steps if s.added] for story in stories]
    assert added == [["periodic_disturbance"], []]
    said = "periodic disturbance on joint 1: explains only"
    assert any(said in note for note in stories[1].notes)
