"""The closed loop: how it is put together, effects of one's own, batches and integration."""

import dataclasses
import math
from functools import cache

import diffrax
import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import effects as fx

import jaxid
from jaxid.control import PD, Reading, Reference, Sampled
from jaxid.effects import (
    AbstractEffect,
    AbstractTransmission,
    ActuatorLag,
    Backlash,
    Coulomb,
    EndStop,
    Gravity,
    JointElasticity,
    LoadDependentFriction,
    Motion,
    Payload,
    RotorInertia,
    Spring,
    TimeDelay,
    TorqueOffset,
    TorqueRipple,
    Viscous,
    on_joint,
)
from jaxid.errors import ModelError
from jaxid.parameters import Scalar, parameter
from jaxid.simulation.loop import Outside, instant, inverse, rest
from jaxid.simulation.runs import fastest_rate, with_substeps
from jaxid.simulation.stepping import RK4

LINES = sim.MultiSine(
    (((0.5, 2.0, 0.3), (0.2, 5.0, 1.0)), ((0.6, 3.0, 2.0), (0.2, 6.0, 0.5))), rise=1.0
)
MOVES = sim.Trapezoid(((0.05, 0.05, 0.2, 3.0), (0.5, -0.03, 0.25, 4.0)))
SCARA_VALUES = {
    "ZZ1r": 3.44,
    "ZZ2": 0.06,
    "MX2": 0.24,
    "MY2": 0.01,
    "Fv1": 0.07,
    "Fc1": 0.23,
    "Fv2": 0.003,
    "Fc2": 0.05,
}
TWO_LINK_VALUES = {
    "p1": 0.108,
    "p2": 0.0443,
    "p3": 0.0333,
    "p4": 0.349,
    "p5": 0.111,
    "Fv1": 0.005,
    "Fc1": 0.08,
    "Fv2": 0.003,
    "Fc2": 0.05,
}
TWO_LINK_GAINS = {"Kp": (60.0, 120.0), "Kv": (10.0, 15.0), "Kg": (0.15, 0.045)}
EMPS_VALUES = {"M": 95.1, "Fv1": 203.5, "Fc1": 20.4, "offset1": -3.16, "gamma1": 1e4}
FINE = jaxid.Stepping(substeps=8)
# A tenth of a millimetre's worth of torque: the spline through the reference errs by 2e-6 rad
# where the fading's third derivative jumps, 60 rad/s³ · (10 ms)³ / 24; gains are up to 22 N·m/rad.
SPLINE = {"rtol": 0, "atol": 5e-5}


def scara(*effects, stepping=FINE):
    """The SCARA of the independent plant, with more effects."""
    loop = jaxid.scara().with_values(**SCARA_VALUES).add(*effects)
    return dataclasses.replace(loop, stepping=stepping)


def recorded(run):
    """A run of the independent simulator as a recording."""
    return jaxid.Recording(run.time, run.q, run.tau, q_ref=run.q_ref)


@cache
def plain():
    """The independent SCARA without any effect, 1.5 s."""
    return sim.simulate(sim.Scara(), LINES, sim.PD(), duration=1.5)


def simulated(loop, record=None):
    """jaxid's run of one recording."""
    return jaxid.simulate(loop, recorded(plain()) if record is None else record)[0]


@pytest.fixture(scope="module")
def rigid():
    """jaxid's run without any effect."""
    return simulated(scara())


def independent_torque(*effects):
    """The independent simulator's torque with effects."""
    return sim.simulate(sim.Scara(), LINES, sim.PD(), effects, duration=1.5).tau


def relative(ours, theirs):
    """Difference in norm, relative, joint by joint."""
    return np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)


# --- effects of one's own ---------------------------------------------------------------------


class QuadraticDrag(AbstractEffect):
    """Drag v|v|."""

    joint: int = eqx.field(static=True)
    drag: Scalar = parameter(0.0, symbol="drag", unit="N·m·s²/rad²", scale=0.01)

    def torque(self, motion: Motion):
        """On its joint."""
        v = motion.v[self.joint - 1]
        return on_joint(self.joint, self.drag * v * jnp.abs(v), motion)


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


# --- putting together -------------------------------------------------------------------------


def test_add_and_without():
    loop = jaxid.scara()
    more = loop.add(TorqueOffset(joint=2), QuadraticDrag(joint=1))
    names = [e.effect_name() for e in more.effects]
    assert names[-2:] == ["torque_offset", "quadratic_drag"]
    assert len(loop.effects) == 4
    assert [e.effect_name() for e in more.without("torque_offset").effects] == [
        *names[:4],
        "quadratic_drag",
    ]
    assert len(more.without("coulomb").effects) == 4
    kept = more.without("coulomb", joint=1).effects
    assert [e.joint for e in kept if e.effect_name() == "coulomb"] == [2]


def test_without_what_is_not_there_says_what_is():
    loop = jaxid.scara()
    with pytest.raises(ModelError, match="no effect 'spring' to take away: .* coulomb, viscous"):
        loop.without("spring")
    with pytest.raises(ModelError, match="no effect 'coulomb' on joint 3"):
        loop.without("coulomb", joint=3)


@pytest.mark.parametrize("joint", [-1, 0, 3])
def test_joint_out_of_range_says_which_there_are(joint):
    with pytest.raises(ModelError) as raised:
        jaxid.scara().add(QuadraticDrag(joint=joint))
    message = str(raised.value)
    for part in (f"quadratic_drag is on joint {joint}", "scara has joints 1 to 2", "from 1"):
        assert part in message


def test_a_joint_has_one_transmission():
    loop = jaxid.scara().add(JointElasticity(joint=2, compliance=0.01))
    loop.add(Backlash(joint=1, gap=0.01))
    with pytest.raises(ModelError, match="two transmissions on joint 2"):
        loop.add(Backlash(joint=2))


def test_what_is_held_stays_so_under_another_name():
    ripples = TorqueRipple(joint=1, harmonic=3.0), TorqueRipple(joint=1, harmonic=7.0)
    loop = jaxid.scara().add(*ripples).hold("n1_2", "ZZ2").free("n1", "gamma2")
    less = loop.with_effects(e for e in loop.effects if e is not ripples[0])
    assert less.held == {"n1", "ZZ2"}
    assert less.freed == {"gamma2"}
    assert loop.without("torque_ripple").held == {"ZZ2"}


class Jerky(AbstractEffect):
    """A torque by acceleration that does not say so."""

    joint: int = eqx.field(static=True)
    size: Scalar = parameter(0.0, symbol="J", unit="kg·m²")

    def torque(self, motion):
        return on_joint(self.joint, self.size * motion.a[self.joint - 1], motion)


def test_acceleration_that_is_not_asked_for_is_refused():
    loop = jaxid.scara().add(Jerky(joint=2))
    q = np.zeros((20, 2))
    record = jaxid.Recording(np.arange(20) * 0.01, q, q, q_ref=q)
    with pytest.raises(ModelError, match="jerky uses motion.a.*`inertial = True`"):
        jaxid.fit(loop, record)


def test_simulation_and_inverse_agree_on_the_load():
    """Beside a rotor, whose acceleration is solved for."""
    loop = jaxid.scara().add(
        RotorInertia(joint=2, inertia=0.02), LoadDependentFriction(joint=2, ratio=0.3)
    )
    q, v, tau = jnp.array([0.2, 0.4]), jnp.array([1.0, -2.0]), jnp.array([3.0, 2.0])
    driven = dataclasses.replace(loop, controller=jaxid.control.OpenLoop())
    none = jnp.zeros(2)
    state = dataclasses.replace(rest(driven, q, none), v=v)
    now = instant(
        driven,
        jnp.zeros(()),
        state,
        Reference(none, none, none, tau),
        Outside(none, none, Reading(none, none)),
        jnp.asarray(0),
    )
    motion = Motion(jnp.zeros(()), q, v, now.a, tau, jnp.zeros(0), jnp.asarray(0))
    np.testing.assert_allclose(inverse(driven, motion, state.effects), now.tau, rtol=1e-12)


def test_hold_and_free():
    loop = jaxid.scara()
    held = loop.hold("ZZ2", MX2=0.3)
    assert "ZZ2" not in held.names
    assert "MX2" not in held.names
    assert float(held.arm.MX2) == 0.3
    assert float(held.arm.ZZ2) == float(loop.arm.ZZ2)
    assert len(held.theta) == 6
    np.testing.assert_array_equal(held.with_theta(held.theta + 1).arm.MX2, 0.3)
    assert held.free("MX2", "ZZ2").names == loop.names
    # What is not free by declaration can be freed, and held again.
    freed = loop.free("gamma2")
    assert freed.names == (*loop.names, "gamma2")
    assert freed.hold("gamma2").names == loop.names
    assert loop.hold(gamma1=50.0).names == loop.names
    for wrong in (lambda: loop.hold("ZZ3"), lambda: loop.hold(ZZ3=1.0), lambda: loop.free("ZZ3")):
        with pytest.raises(ModelError, match="no parameter 'ZZ3' in this model: it has ZZ1r, ZZ2"):
            wrong()


def test_with_values_and_repr():
    loop = jaxid.scara().with_values(ZZ1r=3.25, gamma2=70.0)
    assert float(loop.arm.ZZ1r) == 3.25
    assert float(loop.effects[3].gamma) == 70.0
    with pytest.raises(ModelError, match="no parameter 'mass' in this model: it has ZZ1r"):
        loop.with_values(mass=1.0)
    text = repr(loop)
    for part in ("scara", "SCARA", "viscous(1)", "coulomb(2)", "PD", "ZZ1r 3.25"):
        assert part in text


# --- batches ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lengths():
    """Two recordings, the second shorter and with uneven samples."""
    even, rng = plain(), np.random.default_rng(3)
    keep = np.unique(np.r_[0, rng.permutation(110)[:80], 110])
    cut = [getattr(even, signal)[keep] for signal in ("time", "q", "tau", "q_ref")]
    uneven = jaxid.Recording(*cut[:3], q_ref=cut[3], name="uneven")
    assert len(np.unique(np.diff(uneven.time).round(9))) > 2
    return recorded(even), uneven


@pytest.mark.parametrize("every", [None, 13e-3])
def test_recordings_in_a_batch_are_as_alone(lengths, every):
    law = PD(Kp=[6.25, 156.25], Kv=[2.0, 25.0], Kg=[3.5, 0.06])
    loop = scara(stepping=jaxid.Stepping(substeps=4))
    loop = dataclasses.replace(loop, controller=law if every is None else Sampled(law, every))
    together = jaxid.simulate(loop, lengths)
    for record, run in zip(lengths, together, strict=True):
        (alone,) = jaxid.simulate(loop, record)
        assert run.tau.shape == record.tau.shape
        np.testing.assert_array_equal(run.time, record.time)
        for signal in ("tau", "q", "v", "a", "delivered", "states"):
            # Programs of different size may round the last digit differently.
            here, there = getattr(run, signal), getattr(alone, signal)
            np.testing.assert_allclose(here, there, rtol=0, atol=1e-10)
    if every is not None:
        # Commands change at ticks alone, whenever the samples are.
        time, tau = lengths[1].time, together[1].tau
        same = np.diff(np.floor(time / every + 1e-9)) == 0
        assert same.any()
        np.testing.assert_array_equal(tau[1:][same], tau[:-1][same])
        np.testing.assert_allclose(together[1].tau[-1], together[0].tau[110], atol=1e-4)


def test_recording_of_a_few_samples():
    few = recorded(plain()).slice(0.0, 0.055)
    assert few.samples == 6
    assert simulated(scara(stepping=jaxid.Stepping(substeps=4)), few).tau.shape == (6, 2)


def test_uneven_samples_see_the_same_motion(lengths):
    even, uneven = jaxid.simulate(scara(stepping=jaxid.Stepping(substeps=8)), lengths)
    at = np.searchsorted(lengths[0].time, lengths[1].time - 1e-9)
    # The spline of the reference has gaps of up to 60 ms: its error, 1e-5 rad and less at
    # these rates, (60 ms)^4/384 · 6^4 · 0.2, times a gain of 22.
    np.testing.assert_allclose(uneven.tau, even.tau[at], atol=1e-3)


# --- integration ------------------------------------------------------------------------------


def test_adaptive_steps_agree_with_fixed_ones(rigid):
    stepping = jaxid.Stepping(
        solver=diffrax.Tsit5(), control=diffrax.PIDController(rtol=1e-9, atol=1e-11)
    )
    short = jaxid.Recording(*(getattr(recorded(plain()), s)[:61] for s in ("time", "q", "tau")))
    short = dataclasses.replace(short, q_ref=plain().q_ref[:61])
    run = simulated(scara(stepping=stepping), short)
    # Fixed steps of 1.25 ms; the two references are splines of different length.
    np.testing.assert_allclose(run.tau[:55], rigid.tau[:55], atol=1e-5)
    np.testing.assert_allclose(run.q[:55], rigid.q[:55], atol=1e-6)


def test_stages_in_a_loop_are_the_same_method():
    few = recorded(plain()).slice(0.0, 0.5)
    written, rolled = (
        simulated(scara(stepping=jaxid.Stepping(solver=RK4(rolled=way), substeps=4)), few)
        for way in (False, True)
    )
    np.testing.assert_allclose(rolled.tau, written.tau, rtol=1e-11)
    np.testing.assert_allclose(rolled.states, written.states, rtol=1e-11, atol=1e-14)


def default_error(loop, run):
    """What the default stepping leaves of the torque, relative, joint by joint."""
    assert loop.stepping.substeps is None
    return relative(simulated(loop, recorded(run)).tau, run.tau)


def test_default_steps_are_fine_enough_for_the_scara():
    assert np.all(default_error(scara(stepping=jaxid.Stepping()), plain()) < 1e-4)


def test_default_steps_are_fine_enough_for_the_two_link_arm():
    law = PD(**TWO_LINK_GAINS)
    loop = jaxid.two_link(law).with_values(**TWO_LINK_VALUES)
    run = sim.simulate(sim.TwoLink(), LINES, sim.PD(**TWO_LINK_GAINS), duration=1.5)
    assert np.all(default_error(loop, run) < 1e-4)


def emps_error(stepping):
    """What an axis of the EMPS's kind, under its cascade, leaves of the force, relative."""
    loop = dataclasses.replace(jaxid.emps().with_values(**EMPS_VALUES), stepping=stepping)
    law = sim.EmpsCascade(resolution=0.0)
    run = sim.simulate(sim.Axis(), MOVES, law, duration=0.9, sample=1e-3, step=2.5e-5)
    return relative(simulated(loop, recorded(run)).tau, run.tau)


def test_fine_steps_are_fine_enough_for_the_emps():
    assert np.all(emps_error(FINE) < 1e-4)


def test_default_steps_are_fine_enough_for_the_emps():
    assert np.all(emps_error(jaxid.Stepping()) < 1e-4)


def test_more_steps_where_the_loop_is_quicker(lengths):
    slow, recordings = jaxid.scara().with_values(**SCARA_VALUES), jaxid.Recordings.of(lengths)
    quick = slow.with_values(gamma2=5000.0)
    # Coulomb friction at standstill: Fc 2/pi gamma over the inertia that joint 2 has on its own.
    lowest = 0.05 * 2 / math.pi * 5000 / 0.06
    assert lowest < fastest_rate(quick, recordings) < 2 * lowest
    assert with_substeps(slow, recordings).stepping.substeps == 4
    substeps = with_substeps(quick, recordings).stepping.substeps
    # A quarter of a time constant at most, in each 10 ms, and never more than 64 steps.
    assert min(64, 0.01 * lowest / 0.25) <= substeps <= min(64, 2 * 0.01 * lowest / 0.25 + 1)
    chosen = dataclasses.replace(slow, stepping=jaxid.Stepping(substeps=3))
    assert with_substeps(chosen, recordings).stepping.substeps == 3


def test_long_intervals_are_filled_up():
    time = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 3.0, 0.01)])

    def at(time):
        q = np.stack([0.6 * np.sin(2 * time), 0.4 * np.sin(3 * time)], axis=1)
        return jaxid.Recording.from_arrays(time, q, np.cos(q), q_ref=q, gaps="allow")

    loop = jaxid.scara().with_values(**SCARA_VALUES)
    whole, gapped = at(np.arange(0, 3.0, 0.01)), at(time)
    expected, found = jaxid.simulate(loop, whole)[0], jaxid.simulate(loop, gapped)[0]
    assert len(found.time) == gapped.samples
    kept = np.searchsorted(whole.time, gapped.time - 1e-6)
    # A spline of the reference over half a second is not the reference itself.
    after = np.isin(gapped.time, gapped.time[gapped.time > 1.8])
    assert relative(found.tau[after], expected.tau[kept][after]).max() < 0.02
    fine = jaxid.simulate(dataclasses.replace(loop, stepping=jaxid.Stepping(substeps=32)), gapped)
    assert relative(found.tau, fine[0].tau).max() < 1e-3


def test_a_bristle_at_speed_asks_for_smaller_steps(lengths):
    recordings = jaxid.Recordings.of(lengths)
    stiff = jaxid.scara().add(jaxid.effects.Hysteresis(joint=2, level=0.1, slide=6e-4))
    speed = max(np.abs(np.diff(r.q[:, 1]) / np.diff(r.time)).max() for r in recordings)
    substeps = with_substeps(stiff, recordings).stepping.substeps
    # Runge and Kutta's fourth order runs away at 2.8 over the rate, which is speed over slide.
    assert 0.01 * speed / 6e-4 / substeps < 2.8
    # What was settled for a loop without it counts no longer; what a user has set does.
    before = with_substeps(jaxid.scara(), recordings)
    effect = stiff.effects[-1]
    assert with_substeps(before.add(effect), recordings).stepping.substeps > 4
    assert with_substeps(before, recordings).stepping == before.stepping
    set_by_user = dataclasses.replace(stiff, stepping=jaxid.Stepping(substeps=5))
    assert with_substeps(set_by_user, recordings).stepping.substeps == 5
    assert all(np.isfinite(run.tau).all() for run in jaxid.simulate(stiff, recordings))
