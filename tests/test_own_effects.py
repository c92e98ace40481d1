"""Effects of one's own in a loop, against the independent simulator; effects without amplitude."""

import math

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import effects as fx
from loops import (
    LINES,
    SPLINE,
    TWO_LINK_GAINS,
    TWO_LINK_VALUES,
    QuadraticDrag,
    independent_torque,
    plain,
    relative,
    scara,
    simulated,
)

import jaxid
from jaxid.control import PD
from jaxid.effects import (
    AbstractEffect,
    AbstractTransmission,
    ActuatorLag,
    Backlash,
    Coulomb,
    EndStop,
    Gravity,
    JointElasticity,
    Motion,
    Payload,
    Spring,
    TimeDelay,
    TorqueOffset,
    Viscous,
    on_joint,
)
from jaxid.parameters import Scalar, parameter


@pytest.fixture(scope="module")
def rigid():
    """jaxid's run without any effect."""
    return simulated(scara())


class Gain(AbstractEffect):
    """The drive delivers more than commanded."""

    joint: int = eqx.field(static=True)
    gain: Scalar = parameter(0.0, symbol="gain", unit="1", scale=0.1)

    def command(self, motion: Motion):
        """(1 + gain) of what arrives."""
        return motion.tau.at[self.joint - 1].multiply(1 + self.gain)


class Lag(AbstractEffect):
    """The drive's torque follows with a first-order lag."""

    joint: int = eqx.field(static=True)
    time_constant: Scalar = parameter(0.01, symbol="T", unit="s", lower=0.0, linear=False)

    def initial_state(self):
        """No torque."""
        return jnp.zeros(1)

    def derivative(self, motion: Motion):
        """Towards what arrives."""
        return (motion.tau[self.joint - 1] - motion.state) / self.time_constant

    def command(self, motion: Motion):
        """The state."""
        return motion.tau.at[self.joint - 1].set(motion.state[0])


class Eccentricity(AbstractEffect):
    """The encoder's disc is off its axis."""

    joint: int = eqx.field(static=True)
    amplitude: Scalar = parameter(0.0, symbol="ecc", unit="rad", linear=False)

    def read(self, q):
        """A little more or less, over a turn."""
        j = self.joint - 1
        return q.at[j].add(self.amplitude * jnp.sin(q[j] + 0.7))


class Rotor(AbstractEffect):
    """Inertia that turns with its own joint alone."""

    inertial = True
    joint: int = eqx.field(static=True)
    inertia: Scalar = parameter(0.0, symbol="J", unit="kg·m²", lower=0.0, scale=0.1)

    def torque(self, motion: Motion):
        """J a."""
        return on_joint(self.joint, self.inertia * motion.a[self.joint - 1], motion)


class Shaft(AbstractTransmission):
    """A shaft with a spring and a damper of a millisecond."""

    joint: int = eqx.field(static=True)
    rotor: Scalar = parameter(0.02, symbol="Jm", unit="kg·m²", lower=0.0)
    stiffness: Scalar = parameter(100.0, symbol="k", unit="N·m/rad", lower=0.0)

    def through(self, twist, rate):
        """What the twist, link minus drive, pulls with."""
        return -self.stiffness * (twist + 1e-3 * rate)


def test_own_effect_works_like_the_independent_one():
    ours = simulated(scara(QuadraticDrag(joint=2, drag=0.05)))
    theirs = independent_torque(fx.QuadraticDrag(2, 0.05))
    np.testing.assert_allclose(ours.tau, theirs, **SPLINE)
    assert np.abs(theirs - plain().tau).max() > 1e-2


def test_own_effect_is_named_and_estimated():
    loop = scara(QuadraticDrag(joint=2))
    assert QuadraticDrag.effect_name() == "quadratic_drag"
    assert loop.names[-1] == "drag2"
    assert "quadratic_drag(2)" in repr(loop)


def test_gain_and_lag_act_on_the_command_one_after_the_other():
    ours = simulated(scara(Gain(joint=2, gain=0.3), Lag(joint=2, time_constant=0.02)))
    theirs = independent_torque(fx.DriveGain(2, 0.3), fx.ActuatorLag(2, 0.02))
    np.testing.assert_allclose(ours.tau, theirs, **SPLINE)
    assert np.abs(theirs - plain().tau).max() > 1e-2
    # `tau` is what was commanded, `delivered` what the lag passed on, its state.
    np.testing.assert_array_equal(ours.delivered[:, 1], ours.states[:, 4])
    np.testing.assert_array_equal(ours.delivered[:, 0], ours.tau[:, 0])


def test_lags_in_a_row_compose():
    """A lag after a lag sees what the first one passes on: both states settle one by one."""
    run = simulated(scara(Lag(joint=2, time_constant=0.02), Lag(joint=2, time_constant=0.03)))
    first, second = run.states[:, 4], run.states[:, 5]
    np.testing.assert_array_equal(run.delivered[:, 1], second)
    # Central differences over 20 ms err by (10 ms)²/6 times the torque's third derivative, which
    # is that of lines up to 6 rad/s and of what friction leaves of its jumps after two lags.
    for state, arriving, constant in ((first, run.tau[:, 1], 0.02), (second, first, 0.03)):
        rate = (state[2:] - state[:-2]) / 0.02
        expected = ((arriving - state) / constant)[1:-1]
        assert np.linalg.norm(rate - expected) < 0.05 * np.linalg.norm(expected)


def test_sensor_effect_is_what_the_controller_sees():
    theirs = sim.simulate(
        sim.Scara(), LINES, sim.PD(), [fx.EncoderEccentricity(2, 0.05, 0.7)], duration=1.5
    )
    # Of what was recorded a simulation takes the start only: at rest, at what the encoder says.
    still = np.tile(theirs.q[0], (len(theirs.time), 1))
    record = jaxid.Recording(theirs.time, still, theirs.tau, q_ref=theirs.q_ref)
    ours = simulated(scara(Eccentricity(joint=2, amplitude=0.05)), record)
    # The arm starts at zero, and that is not what its encoder has recorded.
    np.testing.assert_allclose(theirs.q[0], [0.0, 0.05 * math.sin(0.7)])
    np.testing.assert_allclose(ours.q[0], theirs.q[0], atol=1e-9)
    np.testing.assert_allclose(ours.states[0, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(ours.tau, theirs.tau, **SPLINE)
    np.testing.assert_allclose(ours.v, theirs.v, atol=5e-5)
    angle = ours.states[:, 1]
    np.testing.assert_allclose(ours.q[:, 1], angle + 0.05 * np.sin(angle + 0.7), atol=1e-14)


def test_inertial_effect_is_inertia(rigid):
    """On the first joint a rotor is a larger ZZ1r; on the second it is another arm."""
    less = scara(Rotor(joint=1, inertia=0.44)).with_values(ZZ1r=3.0)
    # Two programs for the same sums: rounding, times what 150 samples of the loop make of it.
    np.testing.assert_allclose(simulated(less).tau, rigid.tau, rtol=0, atol=1e-10)
    ours = simulated(scara(Rotor(joint=2, inertia=0.02)))
    theirs = independent_torque(fx.RotorInertia(2, 0.02))
    np.testing.assert_allclose(ours.tau, theirs, **SPLINE)
    assert np.abs(theirs - plain().tau).max() > 1e-2


def test_stiff_transmission_approaches_the_rigid_loop():
    # Drive and link swing at sqrt(3200/0.013) = 490/s: 0.6 ms are a third of a radian.
    stepping = jaxid.Stepping(substeps=16)
    whole = simulated(scara(stepping=stepping)).tau

    def distance(stiffness):
        shaft = Shaft(joint=2, stiffness=stiffness)
        return np.linalg.norm(simulated(scara(shaft, stepping=stepping)).tau - whole, axis=0)

    soft, stiff, stiffer = distance(200.0), distance(800.0), distance(3200.0)
    # Compliance is a small parameter: the difference is of first order in it.
    np.testing.assert_allclose(stiff / soft, 0.25, atol=0.06)
    np.testing.assert_allclose(stiffer / stiff, 0.25, atol=0.04)


def test_transmission_agrees_with_the_independent_one():
    run = simulated(scara(Shaft(joint=2, stiffness=100.0), stepping=jaxid.Stepping(substeps=16)))
    theirs = independent_torque(fx.JointElasticity(2, 0.01, 0.02, damping=1e-3))
    np.testing.assert_allclose(run.tau, theirs, **SPLINE)
    assert np.abs(theirs - plain().tau).max() > 1e-2


BASE = fx.Gravity(0.75, 0.0, 4.0)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (Spring(1, 2.0, 0.6), fx.Spring(1, 2.0, 0.3)),
        (EndStop(1, 40.0, 0.2), fx.EndStop(1, 40.0, 0.2)),
        (Gravity((0.0, 0.75 * 0.01), (3.0, 0.75 * 0.24)), BASE),
        (Payload(0.5, 0.3), fx.Payload(0.5, 0.3)),
    ],
    ids=["spring", "end_stop", "gravity", "payload"],
)
def test_what_pulls_at_a_link_pulls_behind_its_transmission(ours, theirs):
    """In the gap of a backlash the link is left to its load, and the drive feels none of it."""
    gap, model = fx.Backlash(1, 0.01, 1.0, 4000.0), Backlash(1, 0.01, 1.0, 4000.0)
    run = simulated(scara(model, ours, stepping=jaxid.Stepping(substeps=16)))
    assert relative(run.tau, independent_torque(gap, theirs)).max() < 1e-3


def test_absent_transmission_does_not_mind_another():
    stepping = jaxid.Stepping(substeps=16)
    shaft = JointElasticity(joint=2, compliance=0.01, rotor=0.02)
    alone = simulated(scara(shaft, stepping=stepping))
    none = JointElasticity(joint=1, compliance=0.0, rotor=0.5)
    both = simulated(scara(none, shaft, stepping=stepping))
    np.testing.assert_allclose(both.tau, alone.tau, rtol=0, atol=1e-10)


@pytest.mark.parametrize("effect", [ActuatorLag(1, 0.02), TimeDelay(1, 0.02)])
def test_slow_drive_starts_settled(effect):
    """An arm that a constant reference holds against gravity stays where it is."""
    law = PD(**TWO_LINK_GAINS)
    loop = jaxid.two_link(law).with_values(**TWO_LINK_VALUES).add(effect)
    time, q = np.arange(0.0, 0.5, 0.01), np.full((50, 2), (0.8, 0.3))
    needed = np.asarray(loop.arm.bias(jnp.asarray(q[0]), jnp.zeros(2)))
    q_ref = q + needed / np.multiply(TWO_LINK_GAINS["Kp"], TWO_LINK_GAINS["Kg"])
    run = simulated(loop, jaxid.Recording(time, q, 0 * q, q_ref=q_ref, v=0 * q))
    np.testing.assert_allclose(run.q, q, atol=1e-9)
    np.testing.assert_allclose(run.delivered[0], needed, rtol=1e-9)


def test_delay_is_late_by_its_delay_at_all_frequencies_of_motion():
    """The transfer function of its linear equations beside that of a pure dead time."""
    delay = 0.03
    effect = TimeDelay(joint=1, delay=delay)

    def motion(state, tau):
        zero = jnp.zeros(1)
        return Motion(jnp.zeros(()), zero, zero, zero, tau[None], state, jnp.asarray(0))

    def rate(state, tau):
        return effect.derivative(motion(state, tau))

    def out(state, tau):
        return effect.command(motion(state, tau))[0]

    at = (effect.initial_state(), jnp.zeros(()))
    a, b = (np.asarray(jax.jacobian(rate, k)(*at)) for k in (0, 1))
    c, d = (np.asarray(jax.jacobian(out, k)(*at)) for k in (0, 1))
    assert d == 0
    for angle in (0.1, 0.5, 1.0, 2.0, 4.0):
        s = 1j * angle / delay
        response = c @ np.linalg.solve(s * np.eye(len(b)) - a, b)
        assert abs(response - np.exp(-1j * angle)) < 2.2e-9 * angle**10 + 1e-12


# --- nothing is nothing -----------------------------------------------------------------------


@pytest.mark.parametrize("joint", [1, 2])
def test_effects_without_amplitude_are_exactly_absent(rigid, joint):
    none = (Viscous(joint), Coulomb(joint), TorqueOffset(joint), QuadraticDrag(joint), Gain(joint))
    run = simulated(scara(*none))
    for signal in ("tau", "q", "v", "a", "delivered", "states"):
        np.testing.assert_array_equal(getattr(run, signal), getattr(rigid, signal))
