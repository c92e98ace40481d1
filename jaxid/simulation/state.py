"""The state of a closed loop, and what its sensors read."""

import dataclasses
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from ..control import Reading, Reference
from ..effects import AbstractEffect, AbstractTransmission, Motion
from .loads import link_load
from .loop import ClosedLoop


class State(eqx.Module):
    """The loop's state: drive positions and velocities, the effects' states, the controller's."""

    q: Float[Array, " joints"]
    v: Float[Array, " joints"]
    effects: tuple[Float[Array, " _"], ...]
    controller: Float[Array, " states"]


def rest(loop: ClosedLoop, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> State:
    """The state at a position and velocity, `(joints,)`, with all else at rest."""
    effects = tuple(effect.initial_state() for effect in loop.effects)
    return State(q, v, effects, loop.controller.initial_state(read(loop, q, v)))


def settle(
    loop: ClosedLoop,
    t: Float[Array, ""],
    state: State,
    reference: Reference,
    label: Int[Array, ""],
) -> State:
    """The state with the effects' own states in equilibrium.

    Those of drives are at the first command, transmissions at the torque that holds the links.
    """
    seen = read(loop, state.q, state.v)
    mass = loop.arm.mass_matrix(state.q)
    tau = loop.controller.command(seen, reference, state.controller, mass)
    still, none = jnp.zeros_like(state.q), jnp.zeros(0)
    motion = Motion(t, state.q, state.v, still, tau, none, label, reference.held)
    held, settled = motion, []
    if any(isinstance(effect, AbstractTransmission) for effect in loop.effects):
        held = dataclasses.replace(motion, tau=_held(loop, motion, state.effects))
    for effect in loop.effects:
        own = effect.settled(held if isinstance(effect, AbstractTransmission) else motion)
        settled.append(own)
        motion = dataclasses.replace(
            motion, tau=effect.command(dataclasses.replace(motion, state=own))
        )
    return dataclasses.replace(state, effects=tuple(settled))


def _held(
    loop: ClosedLoop, motion: Motion, states: tuple[Float[Array, " _"], ...]
) -> Float[Array, " joints"]:
    """Torque through transmissions that holds the links at rest, `(joints,)`, N·m or N.

    A drive that gives less does not hold them: then it is the command. The command of a law that
    imposes the motion is not that of the drives.
    """
    still = dataclasses.replace(motion, v=jnp.zeros_like(motion.v))
    needed = link_load(loop, still, states)
    if loop.controller.imposes:
        return needed
    return jnp.clip(motion.tau, jnp.minimum(needed, 0.0), jnp.maximum(needed, 0.0))


def _sensor(loop: ClosedLoop, q: Float[Array, " joints"]) -> Float[Array, " joints"]:
    """Reading of sensors with infinite resolution, `(joints,)`."""
    for effect in loop.effects:
        q = effect.read(q)
    return q


def read(loop: ClosedLoop, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> Reading:
    """Sensor readings at a position and velocity, `(joints,)`."""
    seen, rate = jax.jvp(lambda position: _sensor(loop, position), (q,), (v,))
    if loop.resolution is not None:
        step = jnp.asarray(loop.resolution)
        # Rounding has zero derivative; sensitivities are those of an ideal encoder.
        seen = seen + jax.lax.stop_gradient(step * jnp.round(seen / step) - seen)
    return Reading(seen, rate)


def behind(
    loop: ClosedLoop, q: Float[Array, " joints"], v: Float[Array, " joints"]
) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
    """Position and velocity at which the sensors give these readings, `(joints,)` each."""
    if all(type(effect).read is AbstractEffect.read for effect in loop.effects):
        return q, v

    def position(reading: Float[Array, " joints"]) -> Float[Array, " joints"]:
        guess = reading
        # Sensor errors are some hundredths of the reading, so each iteration gains two digits.
        for _ in range(6):
            guess = guess + reading - _sensor(loop, guess)
        return guess

    return jax.jvp(position, (q,), (v,))


def sizes(loop: ClosedLoop) -> list[int]:
    """Lengths of the parts of a state: q, v, each effect's, the controller's."""
    zeros = jnp.zeros(loop.joints)
    parts = jax.eval_shape(lambda: rest(loop, zeros, zeros))
    return [math.prod(leaf.shape) for leaf in jax.tree.leaves(parts)]


def unflatten(loop: ClosedLoop) -> Callable[[Float[Array, " states"]], State]:
    """The function that converts a flat vector, `(states,)`, to a state."""
    zeros = jnp.zeros(loop.joints)
    return ravel_pytree(rest(loop, zeros, zeros))[1]
