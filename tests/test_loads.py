"""Torque of effects: grouped for all joints of an arm, and one after the other."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import threadpoolctl
from loops import four_joints

import jaxid
from jaxid.effects import (
    AbstractEffect,
    Coulomb,
    Counterbalance,
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
from jaxid.simulation.loads import effect_loads
from jaxid.simulation.sharing import with_one_blas_thread


class OfAFunction(AbstractEffect):
    """A torque by a function that is a field, as a network's activation is."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    function: Callable

    def torque(self, motion):
        """The function of the joint's velocity."""
        return on_joint(self.joint, self.function(motion.v[self.joint - 1]), motion)


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
