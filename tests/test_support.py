"""Effects must explain stretches of the recordings from which they were not estimated."""

import numpy as np
import pytest
from test_noise_floor import DURATION, axis

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.support import _errors
from jaxid.effects import ThermalDrift

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


def warming(until: float) -> jaxid.Recording:
    """The slide with friction that fades, and is over at some time, s."""
    record, _ = axis(1)
    v = np.gradient(record.q[:, 0], record.period)
    friction = 2.0 * np.tanh(v / 0.005) + 1.0 * v
    fading = friction * np.exp(-3 * record.time / DURATION) * (record.time < until)
    tau = record.tau + fading[:, None]
    return jaxid.Recording.from_arrays(record.time, record.q, tau, name="warming")


@pytest.mark.slow
def test_what_one_stretch_shows_is_not_believed():
    loop = jaxid.robots.emps(Tracking())
    stories = [
        jaxid.discover(loop, warming(until), catalogue=(ThermalDrift,), progress=False)
        for until in (DURATION, DURATION / 7)
    ]
    added = [[s.added.effect_name() for s in story.steps if s.added] for story in stories]
    assert added == [["thermal_drift"], []]
    assert any("thermal drift on joint 1: explains only" in n for n in stories[1].notes)
