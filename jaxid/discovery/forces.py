"""Torques and sensor errors of effects along a motion, and their derivatives."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..compiling import compiled
from ..effects import AbstractEffect, Motion
from ..effects.placed import Placed, alike, along_effects
from ..parameters import Parameter, list_parameters, read_values, write_values
from ..simulation.loads import effect_loads
from ..simulation.loop import ClosedLoop
from ..simulation.own_states import settled_states
from ..simulation.runs import each
from ..simulation.sharing import one_by_one
from .hypotheses import amplitudes, free_of

Forces = tuple[
    Float[Array, "*points joints columns"],
    Float[Array, "*points joints columns"],
    Float[Array, "*points joints columns"],
]


class OwnForces(eqx.Module):
    """Forces of effects of one structure on their own joints, by amplitude, in single precision.

    - `push`: torque, N·m or N.
    - `noise`, `rate`: additions to the readings of position, rad or m, and velocity, rad/s or m/s;
      None if the effects do not act on a sensor.
    """

    push: Float[Array, "*points effects own columns"]
    noise: Float[Array, "*points effects own columns"] | None
    rate: Float[Array, "*points effects own columns"] | None


def _forces(effect: AbstractEffect, motion: Motion, left: Float[Array, "points joints"]) -> Forces:
    """Additions to joint torque, position reading and velocity reading, by amplitude."""
    linear = amplitudes(effect)
    along = _force_by(effect, linear, motion, left)
    if linear:
        return jax.jacfwd(along)(read_values(effect, linear))
    return jax.tree.map(lambda x: x[..., None], along(jnp.zeros(0)))


def _force_by(
    effect: AbstractEffect,
    parameters: tuple[Parameter, ...],
    motion: Motion,
    left: Float[Array, "points joints"],
) -> Callable[[Float[Array, " values"]], Any]:
    """The same as a function of some of the effect's parameters."""

    def along(values: Float[Array, " values"]):
        here = write_values(effect, parameters, values) if parameters else effect
        # Computed here, because a parameter may affect the rate of a state.
        states = settled_states(here, motion)

        def one(at: Motion, state, rest):
            at = eqx.tree_at(lambda m: m.state, at, state)
            loaded = eqx.tree_at(lambda m: m.tau, at, rest) if effect.loaded else at
            q, v = jax.jvp(here.read, (at.q,), (at.v,))
            return here.command(at) - at.tau - here.torque(loaded), q - at.q, v - at.v

        return jax.vmap(one)(motion, states, left)

    return along


def force_and_slopes(
    placed: Placed,
    motion: Motion,
    left: Float[Array, "recordings points joints"],
    fields: tuple[str, ...] | None = None,
) -> Forces:
    """Additions by an effect along each run, and their derivatives by its free parameters.

    **Arguments:**

    - `motion`: nominal, `(recordings, points)` first. `left`: torque that remains for the links,
      N·m or N.
    - `fields`: names of the fields for derivatives; by default those of free parameters.

    **Returns:** torque on the joint, N·m or N, position reading, rad or m, and velocity reading,
    rad/s or m/s; the first column is the value, the others are derivatives.
    """
    return one_by_one(lambda one: _force_and_slopes(placed, one[0], one[1], fields), (motion, left))


@compiled
def _force_and_slopes(
    placed: Placed,
    motion: Motion,
    left: Float[Array, "recordings points joints"],
    fields: tuple[str, ...] | None,
) -> Forces:
    effect = placed.effect
    free = free_of(effect)
    if fields is not None:
        free = tuple(p for p in list_parameters(effect) if p.place[-1] in fields)
    values = read_values(effect, free) if free else jnp.zeros(0)

    def of_run(run: Motion, left) -> Forces:
        along = _force_by(effect, free, placed.motion(run), left[:, placed.own])
        both = along(values), jax.jacfwd(along)(values)
        found = jax.tree.map(lambda x, d: jnp.concatenate([x[..., None], d], -1), *both)
        return placed.back(found)

    return each(of_run, motion, left)


def torques_of(
    effects: Sequence[AbstractEffect],
    motion: Motion,
    left: Float[Array, "recordings points joints"],
) -> Float[Array, "recordings points joints effects"]:
    """Torque on the joints by effects of one structure at their values, N·m or N.

    **Arguments:** as for `force_and_slopes`.
    """
    ((stacked, _),) = alike(effects, motion.q.shape[-1])
    return one_by_one(lambda one: _torques_of(stacked, one[0], one[1]), (motion, left))


@compiled
def _torques_of(
    stacked: Placed, motion: Motion, left: Float[Array, "recordings points joints"]
) -> Float[Array, "recordings points joints effects"]:
    def of_run(run: Motion, left):
        def own(placed: Placed):
            by = _force_by(placed.effect, (), placed.motion(run), left[:, placed.own])
            return placed.back(by(jnp.zeros(0))[0])

        return jnp.moveaxis(along_effects(own, stacked), 0, -1)

    return each(of_run, motion, left)


def left_for_links(loop: ClosedLoop, motion: Motion) -> Float[Array, "recordings points joints"]:
    """Torque that remains for the links after the loop's effects on the drives, along the runs."""
    return one_by_one(lambda one: _left_for_links(loop, one), motion)


@compiled
def _left_for_links(loop: ClosedLoop, motion: Motion) -> Float[Array, "recordings points joints"]:
    def remaining(at: Motion, states: tuple[Float[Array, " _"], ...]):
        return at.tau - effect_loads(loop, at, states, grouped=True)[0]

    def along(run: Motion):
        states = tuple(settled_states(effect, run) for effect in loop.effects)
        return jax.vmap(remaining)(run, states)

    return jax.vmap(along)(motion)


def misreads(effect: AbstractEffect) -> bool:
    """Whether the effect acts on a sensor's reading."""
    return type(effect).read is not AbstractEffect.read


# A diagnosis has some thirty structures of effects.
@functools.partial(compiled, kept=64)
def own_forces(
    stacked: Placed, motion: Motion, left: Float[Array, "recordings points joints"]
) -> OwnForces:
    """Forces of stacked effects along each run.

    It does not depend on the loop, so it is not compiled again when the model grows.

    **Arguments:**

    - `motion`: nominal, `(recordings, points)` first. `left`: torque that remains for the links,
      N·m or N.
    """

    def of_run(run: Motion, left) -> OwnForces:
        def own(placed: Placed) -> Forces:
            return _forces(placed.effect, placed.motion(run), left[:, placed.own])

        forces = along_effects(own, stacked)
        push, noise, rate = (jnp.moveaxis(x.astype(jnp.float32), 0, 1) for x in forces)
        return (
            OwnForces(push, noise, rate)
            if misreads(stacked.effect)
            else OwnForces(push, None, None)
        )

    return jax.vmap(of_run)(motion, left)
