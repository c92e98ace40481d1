"""Integrals of a law that are loaded before the recording begins, against SciPy's integrator."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from test_servo import Pendulum

import jaxid
from jaxid.control import PD, PID, AbstractController, ComputedTorque, Sampled
from jaxid.effects import Viscous
from jaxid.simulation.batch import prepare
from jaxid.simulation.integrals import integral_states

INERTIA, WEIGHT, DRAG = 0.5, 8.0, 0.6
GAINS = {"Kp": 60.0, "Ki": 90.0, "Kd": 9.0}
TRUE = {"J": INERTIA, "G": WEIGHT, "Fv1": DRAG}
# Positions of the encoder, and torque.
NOISE = 2e-5, 0.02


def reference(t):
    return 0.9 + 0.5 * np.sin(2.1 * t) * np.sin(0.9 * t)


def recorded(begin, end, every=None, seed=1, rate=250.0):
    """The pendulum under its law from time zero, recorded from `begin` to `end`."""
    time = np.arange(begin, end, 1 / rate)
    slope = lambda t: (reference(t + 1e-5) - reference(t - 1e-5)) / 2e-5  # noqa: E731

    def law(t, q, v, integral):
        error = reference(t) - q
        return GAINS["Kp"] * error + GAINS["Ki"] * integral + GAINS["Kd"] * (slope(t) - v)

    def rates(t, x, torque=None):
        q, v, _ = x
        torque = law(t, *x) if torque is None else torque
        a = (torque - DRAG * v - WEIGHT * np.sin(q)) / INERTIA
        return [v, a, reference(t) - q]

    x, precise = [reference(0.0), 0.0, 0.0], {"method": "DOP853", "rtol": 1e-9, "atol": 1e-11}
    if every is None:
        run = scipy.integrate.solve_ivp(rates, (0, end), x, t_eval=time, **precise)
        q, tau = run.y[0], law(time, *run.y)
    else:
        q, tau, integral = [], [], 0.0
        for k in range(round(end / every)):
            t = k * every
            integral += every * (reference(t) - x[0])
            torque = law(t, x[0], x[1], integral)
            q.append(x[0])
            tau.append(torque)
            run = scipy.integrate.solve_ivp(
                lambda t, x, u=torque: rates(t, x, u), (t, t + every), x, **precise
            )
            x = run.y[:, -1]
        rows = np.round(time / every).astype(int)
        q, tau = np.array(q)[rows], np.array(tau)[rows]
    rng = np.random.default_rng(seed)
    q = q + NOISE[0] * rng.standard_normal(len(time))
    tau = tau + NOISE[1] * rng.standard_normal(len(time))
    wanted = reference(time)
    return jaxid.Recording.from_arrays(time, q, tau, q_ref=wanted, name=f"from {begin} s")


def pendulum(law):
    arm = Pendulum(J=jnp.asarray(0.3), G=jnp.asarray(5.0))
    drag = Viscous(joint=1, coefficient=jnp.asarray(0.1))
    loop = jaxid.ClosedLoop(arm=arm, controller=law, effects=[drag], name="pendulum")
    return loop.free("J", "G")


@pytest.mark.parametrize("every", [None, 2e-3])
def test_a_recording_may_begin_with_a_loaded_integral(every):
    law = PID(**GAINS) if every is None else Sampled(PID(**GAINS), every=every)
    recordings = jaxid.Recordings.of([recorded(3.0, 9.0, every), recorded(0.0, 6.0, every)])
    fit = jaxid.fit(pendulum(law), recordings)
    noise = 100 * NOISE[1] / np.sqrt(np.mean(recordings[0].tau ** 2))
    assert fit.error_percent.to_numpy().max() < 1.3 * noise
    off = (fit.theta - [TRUE[name] for name in fit.names]) / fit.std
    assert np.abs(off).max() < 4
    assert any("from 3.0 s" in note and "integral" in note for note in fit.notes)
    assert not any("from 0.0 s" in note for note in fit.notes)


def test_the_integral_is_what_the_recorded_torque_shows():
    loop = pendulum(PID(**GAINS))
    held = held_at_start(loop, recorded(3.0, 9.0))
    run = scipy.integrate.solve_ivp(
        lambda t, x: [
            x[1],
            (
                GAINS["Kp"] * (reference(t) - x[0])
                + GAINS["Ki"] * x[2]
                + GAINS["Kd"] * ((reference(t + 1e-5) - reference(t - 1e-5)) / 2e-5 - x[1])
                - DRAG * x[1]
                - WEIGHT * np.sin(x[0])
            )
            / INERTIA,
            reference(t) - x[0],
        ],
        (0, 3.0),
        [reference(0.0), 0.0, 0.0],
        rtol=1e-9,
        atol=1e-11,
    )
    assert held == pytest.approx(run.y[2, -1:], abs=3 * NOISE[1] / GAINS["Ki"] / np.sqrt(1000))
    assert np.abs(held * GAINS["Ki"]) > 1.0


def test_a_law_that_is_switched_on_has_no_integral():
    loop = pendulum(PID(**GAINS))
    assert [held_at_start(loop, recorded(0.0, 6.0, seed=s))[0] for s in range(5)] == [0.0] * 5


def test_torque_that_the_law_does_not_give_tells_nothing_of_its_integral():
    record = recorded(3.0, 9.0)
    loop = pendulum(PID(**GAINS))
    for tau in (0 * record.tau, record.q, record.tau + 30 * np.sin(7 * record.time)[:, None]):
        assert held_at_start(loop, dataclasses.replace(record, tau=tau)) == 0.0
    wrong = pendulum(PID(Kp=6000.0, Ki=90.0, Kd=9.0))
    assert held_at_start(wrong, record) == 0.0


def held_at_start(loop, record):
    found = prepare(loop, jaxid.Recordings.of(record)).intervals.integrals
    assert found is not None
    assert np.ptp(np.asarray(found), axis=1).max() == 0
    return np.asarray(found)[0, 0]


class Filtered(AbstractController):
    """An integral in front of a low-pass, whose state is none."""

    def initial_state(self, reading):
        return jnp.concatenate([0 * reading.q, reading.v])

    def derivative(self, reading, reference, state):
        return jnp.concatenate([reference.q - reading.q, 50.0 * (reading.v - state[1:])])

    def command(self, reading, reference, state, mass):
        error, rate = reference.q - reading.q, reference.v - state[1:]
        return 60.0 * error + 90.0 * state[:1] + 9.0 * rate


@pytest.mark.parametrize(
    ("law", "which"),
    [
        (PID(**GAINS), [True]),
        (PD(Kp=60.0, Kv=9.0), []),
        (Filtered(), [True, False]),
        (ComputedTorque(Pendulum(), **GAINS), [True]),
        # Integral, torque, last reading.
        (ComputedTorque(Pendulum(), **GAINS, every=1e-3), [True, False, False]),
        # Integral, torque now and later, two readings, velocity.
        (
            Sampled(
                PID(**GAINS),
                every=1e-3,
                delay=1,
                velocity="difference",
                window=2,
                cutoff=50.0,
                limit=9.0,
            ),
            [True] + [False] * 5,
        ),
        (Sampled(PD(Kp=60.0, Kv=9.0), every=1e-3), [False]),
    ],
)
def test_integrals_are_the_states_whose_rate_depends_on_no_state(law, which):
    assert integral_states(pendulum(law)).tolist() == which


def test_states_that_are_no_integrals_are_told_if_the_arm_moves():
    fit = jaxid.fit(pendulum(Filtered()), recorded(3.0, 9.0))
    assert any("Filtered has states that are no integrals" in note for note in fit.notes)
    assert any("the integral of Filtered is not zero" in note for note in fit.notes)


def test_windows_begin_with_the_integrals_of_the_recording():
    law = Sampled(PID(**GAINS), every=4e-3)
    recording = recorded(3.0, 9.0, 4e-3)
    fit = jaxid.fit(pendulum(law), recording, jaxid.OEM(window=1.5))
    assert not any("start at rest" in note for note in fit.notes)
    assert np.abs((fit.theta - [TRUE[name] for name in fit.names]) / fit.std).max() < 4
