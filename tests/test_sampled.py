"""A law as a drive computes it, against the exact motion of one mass between ticks."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from test_servo import WEIGHT, Pendulum

import jaxid
from jaxid.control import PD, PID, Sampled, Tracking
from jaxid.effects import ActuatorLag
from jaxid.errors import ModelError

MASS, DRAG, EVERY = 2.0, 3.0, 0.005
GAINS = {"Kp": 400.0, "Ki": 900.0, "Kd": 40.0}
TIMES = np.arange(0.0, 1.5 + 1e-9, EVERY)
REFERENCE = 0.2 * (1 - np.cos(4 * TIMES))


def drive(delay=0, resolution=0.0, window=0, cutoff=None, limit=np.inf):
    """The same drive in plain Python; between ticks the mass moves by its matrix exponential."""
    system = np.array([[0.0, 1.0, 0.0], [0.0, -DRAG / MASS, 1 / MASS], [0.0, 0.0, 0.0]])
    step = scipy.linalg.expm(system * EVERY)
    slope = scipy.interpolate.CubicSpline(TIMES, REFERENCE)(TIMES, 1)
    x, integral, waiting, past, slow = np.zeros(2), 0.0, [], [0.0] * window, 0.0
    q, tau = [], []
    for ref, rate in zip(REFERENCE, slope, strict=True):
        read = resolution * np.round(x[0] / resolution) if resolution else x[0]
        v = x[1]
        if window:
            v = (read - past[0]) / (window * EVERY)
            past = [*past[1:], read]
        if cutoff is not None:
            slow += (1 - np.exp(-2 * np.pi * cutoff * EVERY)) * (v - slow)
            v = slow

        def law(integral, read=read, v=v, ref=ref, rate=rate):
            part = GAINS["Kp"] * (ref - read) + GAINS["Ki"] * integral
            return part + GAINS["Kd"] * (rate - v)

        more = integral + EVERY * (ref - read)
        integral = integral if abs(law(more)) > limit else more
        command = float(np.clip(law(integral), -limit, limit))
        # The drive has run before: the commands that wait are the first one.
        waiting = [*(waiting or [command] * delay), command]
        q.append(x[0])
        tau.append(command)
        x = (step @ [*x, waiting.pop(0)])[:2]
    return np.array(q), np.array(tau)


def simulated(**options):
    window = options.pop("window", 0)
    if window:
        options |= {"velocity": "difference", "window": window}
    loop = jaxid.ClosedLoop(
        arm=jaxid.arms.Axis(M=jnp.asarray(MASS)),
        controller=Sampled(PID(**GAINS), every=EVERY, **options),
        effects=[jaxid.effects.Viscous(joint=1, coefficient=jnp.asarray(DRAG))],
        name="mass",
        stepping=jaxid.Stepping(substeps=4),
    )
    wanted = REFERENCE[:, None]
    record = jaxid.Recording(TIMES, wanted, 0 * wanted, q_ref=wanted, v=0 * wanted)
    (run,) = jaxid.simulate(loop, record)
    return np.asarray(run.q)[:, 0], np.asarray(run.tau)[:, 0]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"delay": 1},
        {"delay": 2, "window": 1},
        {"window": 3, "cutoff": 30.0},
        {"limit": 6.0},
        {"resolution": 1e-3, "window": 2, "cutoff": 20.0, "delay": 1, "limit": 8.0},
    ],
    ids=lambda o: "+".join(o) or "plain",
)
def test_a_drive_is_simulated_as_it_computes(options):
    q, tau = drive(**options)
    ours_q, ours_tau = simulated(**options)
    size = np.abs(tau).max()
    # RK4 at a quarter of a period leaves less than this of a mass that a constant torque moves.
    assert np.allclose(ours_q, q, atol=1e-9)
    assert np.allclose(ours_tau, tau, atol=1e-6 * size)
    if "limit" in options:
        assert size == pytest.approx(options["limit"])


def test_what_is_late_or_limited_matters():
    plain = drive()[1]
    for options in ({"delay": 1}, {"window": 3, "cutoff": 30.0}, {"limit": 6.0}):
        assert np.abs(drive(**options)[1] - plain).max() > 0.01


@pytest.mark.parametrize("law", [Tracking(), Sampled(PD(Kp=1.0, Kv=1.0), every=0.01)])
def test_a_law_that_no_drive_computes_is_refused(law):
    with pytest.raises(ModelError, match="cannot be the law of Sampled"):
        Sampled(law, every=0.002)


def test_a_drive_without_a_period_is_refused():
    with pytest.raises(ModelError, match="give a period above zero"):
        Sampled(PD(Kp=1.0, Kv=1.0), every=0.0)


def test_fits_do_not_round_readings():
    fine = jaxid.control.Sampled(
        jaxid.control.PD(Kp=[30.0], Kv=[2.0]), every=1e-3, resolution=[1e-3]
    )
    assert fine.rounds
    fitted = fine.settled([])
    assert not fitted.rounds
    reading = jaxid.control.Reading(jnp.array([0.01234]), jnp.array([0.0]))
    asked = jaxid.control.Reference(*jnp.zeros((4, 1)), {})
    state = fine.initial_state(reading)
    rounded, exact = (
        law.command(reading, asked, law.tick(reading, asked, state), jnp.eye(1))
        for law in (fine, fitted)
    )
    np.testing.assert_allclose(rounded, -30.0 * 0.012, rtol=1e-12)
    np.testing.assert_allclose(exact, -30.0 * 0.01234, rtol=1e-12)


@pytest.mark.parametrize("effects", [(), (ActuatorLag(1, time_constant=5e-3),)])
def test_a_law_has_run_before_the_first_sample(effects):
    """An arm whose weight the law carries stays where it is, in spite of delay and lag."""
    loop = jaxid.ClosedLoop(
        arm=Pendulum(),
        controller=Sampled(PD(Kp=2.0, Kv=0.05), every=2e-3, delay=3, velocity="difference"),
        effects=effects,
        name="pendulum",
        stepping=jaxid.Stepping(substeps=8),
    )
    time = 0.01 * np.arange(100)
    angle = np.full((100, 1), 0.4)
    torque = WEIGHT * np.sin(0.4)
    record = jaxid.Recording(time, angle, 0 * angle, q_ref=angle + torque / 2.0, v=0 * angle)
    (run,) = jaxid.simulate(loop, record)
    assert np.asarray(run.q) == pytest.approx(angle, abs=1e-9)
    assert np.asarray(run.tau) == pytest.approx(np.full((100, 1), torque), abs=1e-8)
