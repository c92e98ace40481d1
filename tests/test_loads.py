"""Torque of effects: grouped for all joints of an arm, and one after the other."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import threadpoolctl
from independent import effects as fx
from loops import four_joints

import jaxid
from jaxid.control import Reading, Reference
from jaxid.effects import (
    AbstractEffect,
    Coulomb,
    Counterbalance,
    GearFriction,
    LoadDependentFriction,
    Motion,
    RotorInertia,
    SharedShaft,
    Spring,
    Stribeck,
    ThermalDrift,
    Viscous,
    on_joint,
)
from jaxid.simulation.dynamics import Outside, instant
from jaxid.simulation.loads import effect_loads
from jaxid.simulation.sharing import with_one_blas_thread
from jaxid.simulation.state import rest


class OfAFunction(AbstractEffect):
    """A torque by a function that is a field, as a network's activation is."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    function: Callable

    def torque(self, motion):
        """The function of the joint's velocity."""
        return on_joint(self.joint, self.function(motion.v[self.joint - 1]), motion)


@eqx.filter_jit
def accelerations(loop, q, v, tau):
    """Of an arm without a law, at a torque of its drives."""
    n = len(q)
    none = jnp.zeros(n)
    state = dataclasses.replace(rest(loop, q, none), v=v)
    outside = Outside(none, none, Reading(none, none), none)
    reference = Reference(none, none, none, tau)
    return instant(loop, jnp.asarray(0.0), state, reference, outside, jnp.asarray(0)).a


def test_effects_of_one_structure_are_computed_together():
    """As one after the other, with states, acceleration and load; and so is a derivative."""
    effects = (
        *(Viscous(joint=j, coefficient=0.1 * j) for j in (1, 2, 3, 4)),
        *(Coulomb(joint=j, level=1.0 + j, lead=1e-3) for j in (4, 2)),
        Stribeck(joint=2, level=0.7),
        *(RotorInertia(joint=j, inertia=0.1 * j) for j in (2, 3)),
        *(Spring(joint=j, stiffness=2.0) for j in (3, 1)),
        Counterbalance(joint=2, level=50.0, angle=0.3),
        *(ThermalDrift(joint=j, coulomb=0.3) for j in (1, 4)),
        SharedShaft(joint=3, driven=4, coulomb=0.2, inertia=0.1),
        *(LoadDependentFriction(joint=j, ratio=0.05) for j in (2, 3)),
        *(OfAFunction(joint=j, function=f) for j, f in ((1, jnp.sin), (2, jnp.sin), (3, jnp.cos))),
    )
    loop = jaxid.serial(four_joints()).with_effects(effects)
    rng = np.random.default_rng(3)
    q, v, a, tau = jnp.asarray(rng.normal(size=(4, 4)))
    states = tuple(jnp.asarray(rng.uniform(size=e.initial_state().shape)) for e in effects)
    motion = Motion(jnp.asarray(0.5), q, v, a, tau, jnp.zeros(0), jnp.asarray(0), imposed=True)

    def both(grouped, inertia):
        def loads(theta):
            there = loop.with_theta(theta)
            return effect_loads(there, motion, states, push=tau, inertia=inertia, grouped=grouped)

        along = jnp.asarray(np.random.default_rng(4).normal(size=loop.theta.shape))
        return jax.jit(lambda theta: jax.jvp(loads, (theta,), (along,)))(loop.theta)

    for inertia in (True, False):
        one, other = both(True, inertia), both(False, inertia)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), one, other)


@pytest.mark.parametrize("behind", [0.0, 0.4, 1.0])
def test_load_dependent_friction_is_the_same_by_torque_and_by_motion(behind):
    """The torque that a motion needs gives that motion: friction depends on the whole torque."""
    loaded = (
        LoadDependentFriction(joint=1, ratio=0.3, behind=behind),
        LoadDependentFriction(joint=2, ratio=0.6, behind=behind),
        GearFriction(joint=3, drive=0.3, back=0.2, slow=0.4, slow_back=0.1, velocity=0.5),
    )
    loop = jaxid.serial(four_joints()).with_effects((Coulomb(joint=1, level=0.5), *loaded))
    plain = loop.with_effects(loop.effects[:1])
    rng = np.random.default_rng(8)
    for q, v, a, tau in rng.normal(size=(20, 4, 4)):
        motion = Motion(*map(jnp.asarray, (0.5, q, v, a, 30 * tau)), jnp.zeros(0), jnp.asarray(0))
        states = tuple(e.initial_state() for e in loop.effects)
        drive, _ = effect_loads(loop, motion, states)
        others, _ = effect_loads(plain, motion, states[:1])
        assert np.abs(drive - others)[:3].min() > 0
        left = dataclasses.replace(motion, tau=motion.tau - (drive - others))
        again, _ = effect_loads(loop, left, states, needed=True)
        np.testing.assert_allclose(again, drive, rtol=1e-9)


@pytest.mark.parametrize("behind", [1.0, 0.0])
def test_torque_along_a_recorded_motion_has_the_friction_of_its_load(behind):
    """Hamon's friction by the independent simulator; by the drive's torque in closed form."""
    t = np.arange(0, 4, 1e-3)
    q = np.stack([0.3 * np.sin(5 * t)], axis=1)
    record = jaxid.Recording.from_arrays(t, q, q)
    friction = LoadDependentFriction(joint=1, ratio=0.3, behind=behind, smoothing=0.01)
    effects = Viscous(joint=1, coefficient=2.0), friction
    loop = jaxid.ClosedLoop(jaxid.arms.Axis(M=3.0), jaxid.control.Tracking(cutoff=20.0), effects)
    (run,) = jaxid.simulate(loop, record)
    v, a = run.v[:, 0], np.gradient(run.v[:, 0], t)
    net = run.tau[:, 0] - 2.0 * v
    if behind:
        law = fx.LoadDependentFriction(1, 0.3, gamma=100.0)
        link = np.array([law.delivered(x, w) for x, w in zip(net, v, strict=True)])
    else:
        link = net - 0.3 * np.abs(net) * 2 / np.pi * np.arctan(100.0 * v)
    inner = slice(200, -200)
    np.testing.assert_allclose(link[inner], 3.0 * a[inner], atol=2e-3 * np.abs(a).max())


@pytest.mark.parametrize("behind", [1.0, 0.4])
def test_torque_that_accelerates_a_rotor_is_no_load(behind):
    """What passes the gear moves the link, in closed form; by motion and by torque."""
    friction = LoadDependentFriction(joint=1, ratio=0.3, behind=behind, smoothing=0.01)
    effects = friction, RotorInertia(joint=1, inertia=2.0)
    loop = jaxid.ClosedLoop(jaxid.arms.Axis(M=3.0), jaxid.control.OpenLoop(), effects)
    rng = np.random.default_rng(5)
    v = jnp.asarray([0.02])
    for tau in 10 * rng.normal(size=8):
        a = float(accelerations(loop, jnp.zeros(1), v, jnp.asarray([tau]))[0])
        link, available = 3.0 * a, tau - 2.0 * a
        sign = 2 / np.pi * np.arctan(0.02 / 0.01)
        load = abs(available) / (1 + behind * 0.3 * sign * np.sign(available))
        assert link + 0.3 * sign * load == pytest.approx(available, rel=1e-12)
    t = np.arange(0, 4, 1e-3)
    q = np.stack([0.3 * np.sin(5 * t)], axis=1)
    record = jaxid.Recording.from_arrays(t, q, q)
    along = dataclasses.replace(loop, controller=jaxid.control.Tracking(cutoff=20.0))
    (run,) = jaxid.simulate(along, record)
    v, a = run.v[:, 0], np.gradient(run.v[:, 0], t)
    available = run.tau[:, 0] - 2.0 * a
    sign = 2 / np.pi * np.arctan(v / 0.01)
    load = np.abs(available) / (1 + behind * 0.3 * sign * np.sign(available))
    inner = slice(200, -200)
    left = available - 3.0 * a - 0.3 * sign * load
    np.testing.assert_allclose(left[inner], 0.0, atol=6e-3 * np.abs(a).max())


def test_an_arm_with_rotors_moves_as_its_torque_asks():
    """Forward and inverse dynamics of several joints, with friction by load behind rotors."""
    effects = (
        *(RotorInertia(joint=j, inertia=0.5 * j) for j in (1, 2, 3, 4)),
        *(LoadDependentFriction(joint=j, ratio=0.3) for j in (2, 4)),
        GearFriction(joint=3, drive=0.3, back=0.2, slow=0.4, slow_back=0.1, velocity=0.5),
    )
    loop = jaxid.serial(four_joints(), jaxid.control.OpenLoop()).with_effects(effects)
    plain = loop.with_effects(effects[:4])
    rng = np.random.default_rng(9)
    states = tuple(e.initial_state() for e in effects)
    for q, v, tau in rng.normal(size=(10, 3, 4)):
        q, v, tau = map(jnp.asarray, (q, v, 30 * tau))
        a = accelerations(loop, q, v, tau)
        motion = Motion(jnp.asarray(0.5), q, v, a, tau, jnp.zeros(0), jnp.asarray(0))
        rigid = loop.arm.inverse(q, v, a)
        others, _ = effect_loads(plain, motion, states[:4])
        needed = dataclasses.replace(motion, tau=rigid + others)
        drive, _ = effect_loads(loop, needed, states, needed=True)
        assert np.abs(drive - others)[1:].min() > 0
        np.testing.assert_allclose(rigid + drive, tau, rtol=1e-8, atol=1e-8)


def test_blas_has_one_thread_only_while_a_function_runs():
    """So that a result does not depend on the number of cores."""

    def threads():
        info = threadpoolctl.threadpool_info()
        return {x["filepath"]: x["num_threads"] for x in info if x["user_api"] == "blas"}

    with_one_blas_thread(threads)()
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        # A library of another package may have been built for one thread.
        before = threads()
        assert 2 in before.values()
        assert set(with_one_blas_thread(threads)().values()) == {1}
        assert threads() == before
