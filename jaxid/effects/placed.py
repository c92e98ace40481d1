"""An effect as a function of its own joints only, so that one program serves all joints."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._base import AbstractEffect, Motion
from .curve import Curve

# What a curve may be over beside time, in the order in which `Placed` counts.
_COORDINATES = ("q", "v", "a", "tau")


class Placed(eqx.Module):
    """An effect with its own joints as the only ones, and which joints of the arm these are.

    The joints are data, so one program serves an effect on any joint. An effect that does not
    declare its joints has all of them. The coordinate of a curve is data as well: `along` is its
    index among time and the positions, velocities, accelerations and torques of all joints, and
    takes the place of time.

    - `own`: indices of the effect's joints. `joints`: number of the arm's joints.
    """

    effect: AbstractEffect
    own: Int[Array | np.ndarray, " own"]
    along: Int[Array | np.ndarray, ""] | None
    joints: int = eqx.field(static=True)

    @classmethod
    def of(cls, effect: AbstractEffect, joints: int) -> "Placed":
        """An effect of an arm."""
        along = None
        if isinstance(effect, Curve):
            timed = effect.coordinate == "t"
            place = 0 if timed else _COORDINATES.index(effect.coordinate) * joints + effect.of
            along = np.asarray(place)
            effect = dataclasses.replace(effect, coordinate="t", of=effect.joint)
        if not effect.joint_fields:
            return cls(effect, np.arange(joints), along, joints)
        given = [getattr(effect, name) for name in effect.joint_fields]
        own = list(dict.fromkeys(given))
        moved = {n: own.index(j) + 1 for n, j in zip(effect.joint_fields, given, strict=True)}
        return cls(dataclasses.replace(effect, **moved), np.asarray(own) - 1, along, joints)

    def motion(self, motion: Motion) -> Motion:
        """A motion of the arm as the effect sees it, with vectors of its own joints, `(own,)`."""
        if self.along is not None:
            signals = [getattr(motion, name) for name in _COORDINATES]
            every = jnp.concatenate([motion.t[..., None], *signals], axis=-1)
            motion = eqx.tree_at(lambda m: m.t, motion, every[..., self.along])

        def rows(m: Motion):
            return jax.tree.leaves((m.q, m.v, m.a, m.tau, m.held, m.load))

        return eqx.tree_at(rows, motion, [x[..., self.own] for x in rows(motion)])

    def back(self, forces: Any) -> Any:
        """Results for the effect's joints, `(points, own, ...)`, for all joints of the arm."""

        def whole(x: Float[Array, "points own *columns"]):
            none = jnp.zeros((x.shape[0], self.joints, *x.shape[2:]), x.dtype)
            return none.at[:, self.own].set(x)

        return jax.tree.map(whole, forces)


def alike(effects: Sequence[AbstractEffect], joints: int) -> list[tuple[Placed, list[int]]]:
    """Effects of an arm that share one program, stacked, with their places.

    Arrays have `(effects,)` first; `along_effects` maps a function over them.
    """
    placed = [Placed.of(effect, joints) for effect in effects]
    return [
        (jax.tree.map(_stacked, *(placed[k] for k in places)), places)
        for places in by_structure(placed)
    ]


def along_effects(fun: Callable[..., Any], placed: Placed, *args: Any) -> Any:
    """`fun` of each of several stacked effects, and of rows of arrays; results have them first."""
    return eqx.filter_vmap(fun, in_axes=lambda x: 0 if eqx.is_array_like(x) else None)(
        placed, *args
    )


def _stacked(*leaves: Any) -> Any:
    if not eqx.is_array_like(leaves[0]):
        return leaves[0]
    # Values of a loop may be traced.
    plain = not any(isinstance(leaf, jax.Array) for leaf in leaves)
    return np.stack(leaves) if plain else jnp.stack(leaves)


def by_structure(effects: Sequence[eqx.Module]) -> list[list[int]]:
    """Places of effects, grouped by structure; one trace serves a group."""
    groups: dict[Any, list[int]] = {}
    for k, effect in enumerate(effects):
        leaves, structure = jax.tree.flatten(effect)
        kinds = (np.shape(leaf) if eqx.is_array_like(leaf) else leaf for leaf in leaves)
        groups.setdefault((structure, tuple(kinds)), []).append(k)
    return list(groups.values())
