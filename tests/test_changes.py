"""Values that differ between recordings or change during them are told from noise.

Torque is that of inverse dynamics written out here, along motions in closed form.
"""

import numpy as np
import pytest
from loops import sines

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.changes import change_of, changed_values
from jaxid.effects import Coulomb, Stribeck, TorqueOffset, Viscous
from jaxid.noise import ARFilter

MASS, DRAG, DRY, WORTH = 5.0, 4.0, 3.0, 0.05
# Noise that changes within a second.
SLOW = ARFilter(np.array([-0.99]), 2e-3)


def axis():
    effects = Viscous(1, 1.0), Coulomb(1, 1.0, smoothing=0.02), TorqueOffset(1)
    arm, law = jaxid.arms.Axis(M=MASS), Tracking(cutoff=10.0)
    return jaxid.ClosedLoop(arm, law, effects, name="axis")


def recorded(seed, offset=0.0, dry=1.0, gain=1.0, brake=0.0, slow=False):
    """An axis for 20 s at 100 Hz, with white or slow noise.

    **Arguments:**

    - `offset`: of the torque, N. `dry`: factor of the friction. `gain`: of the logged torque.
    - `brake`: time until which the friction is half as large again, s.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 20.0, 0.01)
    frequencies = (0.21, 0.53, 1.1)
    q, v, a = sines(time, (0.2, 0.07, 0.02), frequencies, rng.uniform(0, 6, 3))
    held = dry + 0.5 * (time < brake)
    tau = gain * (MASS * a + DRAG * v + held * DRY * np.tanh(v / 0.02) + offset)
    tau += SLOW.simulate((len(time),), rng) if slow else 0.1 * rng.standard_normal(len(time))
    return jaxid.Recording.from_arrays(time, q, tau, name=f"run_{seed}")


def diagnosed(*runs):
    fit = jaxid.fit(axis(), runs, jaxid.OEM(progress=False))
    return jaxid.diagnose(fit, catalogue=[Stribeck])


@pytest.mark.parametrize(
    ("first", "second", "name", "values"),
    [
        ({"offset": 1.0}, {"offset": -0.5}, "offset1", (1.0, -0.5)),
        ({"dry": 1.3}, {"dry": 0.9}, "Fc1", (1.3 * DRY, 0.9 * DRY)),
        ({"gain": 1.1}, {"gain": 0.9}, "measured and modelled torque of joint 1", (1.1, 0.9)),
    ],
)
def test_a_value_that_differs_between_recordings_is_named(first, second, name, values):
    diagnosis = diagnosed(recorded(1, **first), recorded(2, **second))
    said, share = changed_values(diagnosis, WORTH)
    assert share > 0.8
    assert f"{name} differs between the recordings: " in said
    assert "find what changed, or fit the recordings separately" in said
    told = said.split("recordings: ")[1].split(";")[0]
    numbers = [float(part.split()[0]) for part in told.split(" and ")]
    # The estimated smoothing of the sign changes both levels of friction by the same amount.
    assert numbers[0] - numbers[1] == pytest.approx(values[0] - values[1], rel=0.1)
    assert numbers == pytest.approx(values, rel=0.2)


def test_friction_that_changes_during_recordings_is_named():
    diagnosis = diagnosed(recorded(1, brake=8.0), recorded(2, brake=5.0))
    said, share = changed_values(diagnosis, WORTH)
    assert share > 0.7
    assert said.startswith("Fc1 changes during the recordings: +")
    change = change_of(diagnosis, 0)
    assert change is not None
    # Twelfths of the recordings.
    assert change.part == (5, 3)


def test_a_model_with_other_errors_is_compared_with_a_change():
    diagnosis = diagnosed(recorded(1, offset=1.0), recorded(2, offset=-0.5))
    error = diagnosis.fit.error_percent.to_numpy().mean(axis=0)
    change = change_of(diagnosis, 0)
    assert change is not None
    left = error * np.sqrt(1 - change.share)
    assert changed_values(diagnosis, WORTH, 1.5 * left)[1] == pytest.approx(
        1 - 1 / 1.5**2, abs=0.01
    )
    # Effects that explain as much.
    assert changed_values(diagnosis, WORTH, 1.05 * left) == ("", 0.0)


def test_slow_noise_is_no_change():
    """The tests of five pairs of recordings; a p-value is below 0.005 if a change is found."""
    for seed in range(5):
        pair = diagnosed(recorded(10 + seed, slow=True), recorded(20 + seed, slow=True))
        assert changed_values(pair, WORTH) == ("", 0.0)


def test_a_missing_effect_in_a_short_slow_motion_is_no_change():
    """A missing weight resembles an offset that changes once, if it swings once."""
    time = np.arange(0.0, 10.0, 0.01)
    q, v, a = sines(time, (0.6, 0.05, 0.02), (0.1, 0.53, 1.1), np.array([0.3, 1.0, 2.0]))
    tau = MASS * a + DRAG * v + DRY * np.tanh(v / 0.02) + 2.0 * np.sin(2 * q)
    tau += 0.05 * np.random.default_rng(0).standard_normal(len(time))
    diagnosis = diagnosed(jaxid.Recording.from_arrays(time, q, tau, name="slow"))
    assert diagnosis.fit.error_percent.to_numpy().min() > 20
    assert change_of(diagnosis, 0) is None


@pytest.mark.slow
def test_a_discovery_tells_what_differs():
    runs = recorded(1, offset=1.0), recorded(2, offset=-0.5)
    found = jaxid.discover(axis(), runs, recorded(3), catalogue=[Stribeck], progress=False)
    assert found.verdict == "undetermined"
    assert "offset1 differs between the recordings" in found.reason
