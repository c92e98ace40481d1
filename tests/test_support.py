"""Effects must explain stretches of the recordings from which they were not estimated."""

import numpy as np
import pytest
from test_noise_floor import DURATION, RATE, axis

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
