"""Torque that the effects of a loop require along a motion, and inverse dynamics with it."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects import AbstractEffect, Motion
from ..effects.placed import Placed, alike, along_effects
from .loop import ClosedLoop

# Number of Newton steps for friction by load, which is linear in torque between its few kinks.
_STEPS = 3


def effect_loads(
    loop: ClosedLoop,
    motion: Motion,
    states: tuple[Float[Array, " _"], ...],
    links: Motion | None = None,
    *,
    push: Float[Array, " joints"] | float = 0.0,
    curves: bool = True,
    inertia: bool = True,
    spinning: Float[Array, " joints"] | None = None,
    needed: bool = False,
    grouped: bool = False,
) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
    """Torque that effects on the drives and on the links require, `(joints,)` each.

    Load-dependent effects come last, because they depend on the torque minus all other effects, if
    they are `geared` also minus the torque that accelerates the rotors.

    **Arguments:**

    - `motion`: motion of the drives. `states`: the effects' own states. `links`: motion of the
      links, if it differs from that of the drives.
    - `push`: external torque on the drives, which load-dependent effects include.
    - `curves`: False to leave out effects that need an acceleration which is not known yet.
    - `inertia`: False to leave out terms proportional to acceleration.
    - `spinning`: acceleration of the rotors that `geared` effects are behind, `(joints,)`, rad/s²
      or m/s²; that of `motion` if None.
    - `needed`: whether the torque of `motion` is what it needs without load-dependent effects, not
      that of the drives.
    - `grouped`: whether effects of one structure are computed as one array, for many instants. A
      program with all joints of a large arm then compiles in a fraction of the time.
    """
    behind = motion if links is None else links
    own = [
        (effect, state)
        for effect, state in zip(loop.effects, states, strict=True)
        if curves or not effect.needs_acceleration
    ]

    def required(which: Callable[[AbstractEffect], bool], motion: Motion, inertia: bool = True):
        return _required([(e, s) for e, s in own if which(e)], motion, inertia, grouped)

    link = required(lambda e: e.on_link and not e.loaded, behind, inertia)
    steady = required(lambda e: not (e.on_link or e.loaded or e.inertial), motion)
    drive = steady + required(turns, motion, inertia)
    if any(effect.loaded for effect, _ in own):
        ahead = steady + required(turns, motion, inertia=False)
        spun = motion if spinning is None else dataclasses.replace(motion, a=spinning)
        rotors = required(turns, spun) - required(turns, motion, inertia=False)
        load = link_load(loop, behind, states)
        left = dataclasses.replace(motion, tau=motion.tau - ahead + push, load=load)

        def by_load(tau: Float[Array, " joints"]) -> Float[Array, " joints"]:
            whole, passed = (dataclasses.replace(left, tau=x) for x in (tau, tau - rotors))
            by_drive = required(lambda e: e.loaded and not e.geared, whole)
            return by_drive + required(lambda e: e.loaded and e.geared, passed)

        tau = _with_friction(by_load, left.tau) if needed else left.tau
        drive = drive + by_load(tau)
    return drive, link


def _with_friction(
    by_load: Callable[[Float[Array, " joints"]], Float[Array, " joints"]],
    link: Float[Array, " joints"],
) -> Float[Array, " joints"]:
    """Torque of the drives of which friction leaves the torque that the links need, `(joints,)`.

    **Arguments:**

    - `by_load`: friction by the torque of the drives, `(joints,)`, N·m or N. That of a joint
      depends on its own torque.
    - `link`: torque that the links need, `(joints,)`, N·m or N.
    """
    tau = link
    for _ in range(_STEPS):
        friction, slope = jax.jvp(by_load, (tau,), (jnp.ones_like(tau),))
        tau = tau - (tau - friction - link) / (1 - slope)
    return tau


def turns(effect: AbstractEffect) -> bool:
    """Whether the torque of an effect on the drives depends on acceleration, as that of a rotor."""
    return effect.inertial and not (effect.on_link or effect.loaded)


def _required(
    effects: Sequence[tuple[AbstractEffect, Float[Array, " _"]]],
    motion: Motion,
    inertia: bool,
    grouped: bool,
) -> Float[Array, " joints"]:
    """Torque that effects with their own states require, `(joints,)`."""
    still = dataclasses.replace(motion, a=jnp.zeros_like(motion.a))

    def seen(effect: AbstractEffect) -> Motion:
        return still if effect.inertial and not inertia else motion

    total = jnp.zeros_like(motion.v)
    if not grouped:
        for effect, state in effects:
            total = total + effect.torque(dataclasses.replace(seen(effect), state=state))
        return total

    def of_placed(one: Placed, state: Float[Array, " _"]) -> Float[Array, " own"]:
        return one.effect.torque(dataclasses.replace(one.motion(seen(one.effect)), state=state))

    for group, places in alike([effect for effect, _ in effects], len(motion.v)):
        states = jnp.stack([effects[k][1] for k in places])
        total = total.at[group.own].add(along_effects(of_placed, group, states))
    return total


def link_load(
    loop: ClosedLoop, links: Motion, states: tuple[Float[Array, " _"], ...]
) -> Float[Array, " joints"]:
    """Torque that the links need at their position and velocity without accelerating, `(joints,)`.

    **Arguments:**

    - `links`: motion of the links. `states`: the effects' own states.
    """
    load, still = loop.arm.bias(links.q, links.v), jnp.zeros_like(links.q)
    for effect, state in zip(loop.effects, states, strict=True):
        if effect.on_link and not effect.needs_acceleration:
            load = load + effect.torque(dataclasses.replace(links, a=still, state=state))
    return load


def inverse(
    loop: ClosedLoop, motion: Motion, states: tuple[Float[Array, " _"], ...]
) -> Float[Array, " joints"]:
    """Torque at the joints that a motion needs (the inverse dynamic model), `(joints,)`."""
    drive, link = effect_loads(loop, motion, states, grouped=True)
    return loop.arm.inverse(motion.q, motion.v, motion.a) + drive + link
