"""Signatures: the linear response against a difference of two whole simulations."""

import dataclasses

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.discovery import responses
from jaxid.discovery.finite import differences
from jaxid.discovery.forces import force_and_slopes
from jaxid.discovery.hypotheses import amplitudes, survey
from jaxid.discovery.linear import linearise
from jaxid.discovery.signatures import signatures
from jaxid.effects import (
    AbstractEffect,
    ActuatorLag,
    Backlash,
    EncoderEccentricity,
    GearFriction,
    Gravity,
    JointElasticity,
    LoadDependentFriction,
    Motion,
    PositionDependentFriction,
    Spring,
    Stribeck,
    TimeDelay,
    TorqueOffset,
    TorqueSaturation,
    on_joint,
)
from jaxid.effects.placed import Placed
from jaxid.simulation.batch import prepare
from jaxid.simulation.runs import simulate_batch
from jaxid.simulation.steps import set_substeps

LINES = sim.MultiSine(
    (((0.5, 2.0, 0.3), (0.2, 5.0, 1.0)), ((0.6, 3.0, 2.0), (0.2, 6.0, 0.5))), rise=1.0
)
SHAFT = JointElasticity(joint=1, compliance=2e-3, rotor=1.0)
WORN = LoadDependentFriction(joint=1, ratio=0.3)
SMALL = 1e-5
# Each at no amplitude, and with a small one.
PAIRS = {
    "offset": (TorqueOffset(1), TorqueOffset(1, SMALL)),
    "stribeck": (Stribeck(2, 0.0, 0.3), Stribeck(2, SMALL, 0.3)),
    "spring": (Spring(1), Spring(1, 0.0, SMALL)),
    "gravity": (Gravity(), Gravity((SMALL, 0.0))),
    "eccentricity": (EncoderEccentricity(2), EncoderEccentricity(2, SMALL)),
}


@pytest.fixture(scope="module")
def record():
    run = sim.simulate(sim.Scara(), LINES, sim.PD(), duration=1.5)
    return jaxid.Recording(run.time, run.q, run.tau, q_ref=run.q_ref)


@pytest.mark.slow
@pytest.mark.parametrize("between", [(), (SHAFT,), (WORN,)], ids=["rigid", "elastic", "worn"])
def test_signature_is_the_derivative_of_a_simulation(record, between):
    """What acts on a link acts there also behind a transmission; what loads it, as a load."""
    loop = set_substeps(jaxid.scara().add(*between), 8)
    batch = prepare(loop, jaxid.Recordings.of(record))
    linear = linearise(loop, batch, "tau")
    proposed = [(none, 1.0) for none, _ in PAIRS.values()]
    hypotheses, table = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    plain = jaxid.simulate(loop, record)[0].tau
    for hypothesis, (name, (_, some)) in zip(hypotheses, PAIRS.items(), strict=True):
        moved = jaxid.simulate(loop.add(some), record)[0].tau
        # A spring's second amplitude is its preload; of the others the first one was moved.
        column = hypothesis.columns[name == "spring"]
        expected = (np.asarray(moved) - np.asarray(plain)) / SMALL
        found = table.dense([column])[0, : record.samples, :, 0]
        error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        # Torque goes as a line from sample to sample, which misses most where friction is steep.
        assert error < 2e-2, (name, error)


TRACKED = jaxid.scara(jaxid.control.Tracking())


@pytest.mark.parametrize("loop", [jaxid.scara().add(SHAFT), TRACKED], ids=["elastic", "tracked"])
def test_signatures_are_the_same_in_small_portions(record, monkeypatch, loop):
    """Effects act before a gear with springs, behind it or on the reading."""
    loop = set_substeps(loop, 8)
    batch = prepare(loop, jaxid.Recordings.of(record))
    linear = linearise(loop, batch, "tau")
    proposed = [(effect, 1.0) for pair in PAIRS.values() for effect in pair]
    whole = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    # Three columns of one portion, so that effects of one class are divided.
    size = linear.motion.q.shape[1] * 2
    monkeypatch.setattr(responses, "_ROOM", 3 * size)
    parts = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    assert [h.columns for h in parts[0]] == [h.columns for h in whole[0]]
    one, other = (table.dense(range(table.width)) for table in (whole[1], parts[1]))
    largest = np.abs(one).max(axis=(0, 1, 2))
    assert np.all(largest > 0)
    assert np.all(np.abs(other - one) <= 1e-5 * largest)


def test_along_a_recorded_motion_torque_is_compared_at_its_own_joint(record, monkeypatch):
    """Where each output depends on the torque of its joint alone, nothing else is computed."""
    loop = set_substeps(TRACKED, 8)
    batch = prepare(loop, jaxid.Recordings.of(record))
    linear = linearise(loop, batch, "tau")
    proposed = [(none, 1.0) for none, _ in PAIRS.values()]
    _, quick = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    # The first joint has offset, spring, gravity of both links and errors of the other reading.
    assert [c.tolist() for c in quick.columns] == [[0, *range(2, 10)], [1, 5, 7, 8, 9]]
    monkeypatch.setattr(responses, "_own_response", lambda *_: None)
    _, whole = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    one, other = (table.dense(range(table.width)) for table in (quick, whole))
    largest = np.abs(other).max(axis=(0, 1, 2))
    assert np.all(np.abs(other - one) <= 1e-6 * largest)


class Rattle(AbstractEffect):
    """Torque that begins at a speed; nothing of it shows at nothing."""

    joint: int = eqx.field(static=True)
    size: jax.Array = jaxid.parameter(0.0, symbol="rattle", unit="N·m", linear=False)
    finite = True

    def torque(self, motion: Motion) -> jax.Array:
        """Half of it at 1 rad/s."""
        speed = motion.v[self.joint - 1]
        return on_joint(self.joint, self.size * speed**3 / (1 + speed**2), motion)


def test_finite_effects_that_share_a_program_are_as_in_simulations_of_their_own(record):
    loop = set_substeps(jaxid.scara(), 8)
    batch = prepare(loop, jaxid.Recordings.of(record))
    largest = np.abs(record.tau).max(axis=0)
    effects = [
        JointElasticity(joint=1, compliance=2e-3, rotor=1.0),
        JointElasticity(joint=2, compliance=1e-2, rotor=0.02),
        Backlash(joint=2, gap=1e-3, rotor=0.02),
        Rattle(1, 0.3),
        TorqueSaturation(1, 0.7 * largest[0]),
        TorqueSaturation(2, 0.8 * largest[1]),
        JointElasticity(joint=1, compliance=4e-3, rotor=1.0),
    ]
    plain = jaxid.simulate(loop, record)[0].tau
    nominal = jnp.asarray(simulate_batch(loop, batch).tau)
    found = differences(loop, batch, effects, 0, nominal)
    for effect, change in zip(effects, found, strict=True):
        alone = jaxid.simulate(loop.add(effect), record)[0].tau
        # Contact is stiff: what rounding does to its first touch grows.
        with_it = plain + change[0, : record.samples]
        np.testing.assert_allclose(with_it, alone, atol=1e-6 * largest.max(), err_msg=str(effect))


def test_an_effect_that_leaves_the_motion_given_is_held_against_the_given_run(record):
    """Under an unknown law friction in a gear needs no feedback, and a torque limit does."""
    loop = jaxid.scara(jaxid.control.Tracking())
    batch = prepare(loop, jaxid.Recordings.of(record))
    plain = np.asarray(simulate_batch(loop, batch).tau)
    effects = [TorqueSaturation(1, 1e9), GearFriction(joint=1, drive=0.1)]
    limit, gear = differences(loop, batch, effects, 0, jnp.asarray(plain))
    alone = jaxid.simulate(loop.add(effects[1]), record)[0].tau
    found = (plain + gear)[0, : record.samples]
    np.testing.assert_allclose(found, alone, atol=1e-12 * np.abs(alone).max())
    assert np.abs(gear).max() > 0.01 * np.abs(plain).max()
    # A limit that is never reached changes nothing, whatever feedback errs by.
    np.testing.assert_allclose(limit, 0.0, atol=1e-9 * np.abs(plain).max())


class Creep(AbstractEffect):
    """A Maxwell element: x' = k v - x / T, torque x; its amplitude stands in its state's rate."""

    joint: int = eqx.field(static=True)
    stiffness: jax.Array = jaxid.parameter(0.0, symbol="kM", unit="N·m/rad", scale=1.0)

    def initial_state(self):
        return jnp.zeros(1)

    def derivative(self, motion):
        return self.stiffness * motion.v[self.joint - 1] - motion.state / 0.2

    def torque(self, motion):
        return on_joint(self.joint, motion.state[0], motion)


class Resonance(AbstractEffect):
    """A hardly damped mass on the link: its two states turn into each other."""

    joint: int = eqx.field(static=True)
    size: jax.Array = jaxid.parameter(0.0, symbol="r", unit="N·m", scale=1.0)

    def initial_state(self):
        return jnp.zeros(2)

    def derivative(self, motion):
        x, rate = motion.state
        return jnp.stack([rate, 900.0 * (motion.v[self.joint - 1] - x) - 1.2 * rate])

    def torque(self, motion):
        return on_joint(self.joint, self.size * motion.state[0], motion)


class FixedDrag(AbstractEffect):
    """A law without any number of its own to be given."""

    joint: int = eqx.field(static=True)

    def torque(self, motion):
        return on_joint(self.joint, 1e-5 * motion.v[self.joint - 1], motion)


OWN_STATES = {
    "lag": (ActuatorLag(1, 2e-3), ActuatorLag(1, 2e-3)),
    "delay": (TimeDelay(1, 2e-3), TimeDelay(1, 2e-3)),
    "creep": (Creep(2), Creep(2, SMALL)),
    "resonance": (Resonance(2), Resonance(2, SMALL)),
    "no number": (FixedDrag(2), FixedDrag(2)),
}


def test_signatures_of_effects_with_states_begin_where_simulations_do():
    """An arm held up against gravity: its drives carry torque before anything moves."""
    loop = set_substeps(jaxid.two_link(), 32)
    time = np.arange(301) * 0.01
    ramp = np.clip(time, 0, 1) ** 3 * (10 - 15 * np.clip(time, 0, 1) + 6 * np.clip(time, 0, 1) ** 2)
    moves = np.stack([0.8 + 0.4 * ramp * np.sin(4 * time), 0.3 + 0.5 * ramp * np.sin(6 * time)], 1)
    held = np.asarray(loop.arm.bias(jnp.asarray(moves[0]), jnp.zeros(2)))
    record = jaxid.Recording(time, moves, np.ones_like(moves), q_ref=moves + held / 100.0)
    plain = jaxid.simulate(loop, record)[0]
    record = jaxid.Recording(time, plain.q, plain.tau, q_ref=record.q_ref)
    batch = prepare(loop, jaxid.Recordings.of(record))
    linear = linearise(loop, batch, "tau")
    proposed = [(none, 1.0) for none, _ in OWN_STATES.values()]
    hypotheses, table = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    for hypothesis, (name, (none, some)) in zip(hypotheses, OWN_STATES.items(), strict=True):
        moved = jaxid.simulate(loop.add(some), record)[0].tau
        expected = np.asarray(moved) - np.asarray(plain.tau)
        found = table.dense(hypothesis.columns[:1])[0, : record.samples, :, 0]
        found = found * (SMALL if amplitudes(none) else 1.0)
        along = np.sum(found * expected) / np.sum(expected**2)
        error = np.linalg.norm(found - along * expected) / np.linalg.norm(found)
        # Of second order in a lag of 2 ms under these gains: some hundredths.
        assert error < (0.06 if name in ("lag", "delay") else 1e-3), (name, error)
        assert along == pytest.approx(1.0, abs=0.01), name


def test_friction_of_a_slider_may_rise_along_its_travel():
    """With a constant beside them, as Coulomb friction is, the waves make a ramp within 2 %."""
    time, travel = np.arange(101) * 1e-3, np.linspace(0.05, 0.3, 101)[:, None]
    ones, none, label = jnp.ones(1), jnp.zeros(0), jnp.asarray(0)
    motion = jax.vmap(lambda t, q: Motion(t, q, ones, 0 * ones, 0 * ones, none, label))(
        jnp.asarray(time), jnp.asarray(travel)
    )
    record = jaxid.Recording(time, travel, 0 * travel, q_ref=travel)
    scene = survey(jaxid.emps(), jaxid.Recordings.of(record), motion, ((),))
    (effect,) = PositionDependentFriction.screened(scene)
    waves = [dataclasses.replace(effect, **{name: 1.0}) for name in ("A1", "B1", "A2", "B2")]
    columns = [jnp.ones((101, 1)), *(jax.vmap(wave.torque)(motion) for wave in waves)]
    ramp, matrix = travel[:, 0], np.concatenate(columns, axis=1)
    left = ramp - matrix @ np.linalg.lstsq(matrix, ramp)[0]
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(ramp - ramp.mean())


@pytest.mark.parametrize("even", [True, False])
def test_a_delayed_command_is_the_one_of_a_moment_ago(even):
    """Also if samples are not evenly spaced, and for its derivative by the delay."""
    rng, delay, samples = np.random.default_rng(2), 0.02, 2000
    steps = np.full(samples, 1e-3) if even else rng.uniform(0.5e-3, 1.5e-3, samples)
    time = np.cumsum(steps)

    def at(t):
        still = jnp.zeros(1)
        command = jnp.sin(20 * t)[None]
        return Motion(t, still, still, still, command, jnp.zeros(0), jnp.asarray(0))

    motion = jax.vmap(jax.vmap(at))(jnp.asarray(time)[None])
    placed = Placed.of(TimeDelay(joint=1, delay=delay), 1)
    push = np.asarray(force_and_slopes(placed, motion, motion.q)[0])[0, :, 0]
    settled = time > 20 * delay
    late = np.sin(20 * (time - delay)) - np.sin(20 * time)
    rate = -20 * np.cos(20 * (time - delay))
    np.testing.assert_allclose(push[settled, 0], late[settled], atol=2e-4)
    np.testing.assert_allclose(push[settled, 1], rate[settled], atol=2e-2)
