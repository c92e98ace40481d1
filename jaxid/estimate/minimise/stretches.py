"""Linearisation of long recordings in stretches of time, one after the other.

Only one stretch is in memory. A stretch begins with the final state and tangents of the previous
one, and with the past rows that its noise filter needs.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...compiling import compiled
from ...simulation.batch import Batch
from .problem import Point, Problem, Sums
from .residual import Sensitivity, beginning, sensitivity_from


class Carried(eqx.Module):
    """The state that one stretch passes to the next.

    - `x`, `tangents`: the loop's state and its derivatives.
    - `past`: last rows of the residual and its derivatives before the noise filter.
    - `count`: number of earlier samples.
    """

    x: Float[Array, "recordings states"]
    tangents: Float[Array, "recordings states columns"]
    past: Float[Array, "recordings taps outputs wide"]
    count: Int[Array, " recordings"]


@compiled
def begun(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
) -> Carried:
    """The state before the first stretch.

    **Arguments:**

    - `problem`: at least its first stretch.
    """
    n, own = problem.loop.joints, problem.loop.theta.shape[0]
    loop = problem.loop.with_theta(theta[:own])
    batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
    x, tangents = beginning(loop, batch, problem.free_start)
    outputs, taps = problem.weights.shape[0], problem.noise.shape[-1] - 1
    past = jnp.zeros((len(start), taps, outputs, 1 + tangents.shape[-1]))
    return Carried(x, tangents, past, jnp.zeros(len(start), int))


@compiled
def along(
    problem: Problem, theta: Float[Array, " parameters"], carried: Carried
) -> tuple[Sums, Bool[Array, ""], Sensitivity, Carried]:
    """One stretch: its sums, whether they are finite, its rows, and the state for the next one."""
    own, kept = problem.loop.theta.shape[0], problem.batch.kept
    loop = problem.loop.with_theta(theta[:own])
    plain, x, tangents = sensitivity_from(
        loop, problem.batch, problem.weights, problem.signals, carried.x, carried.tangents
    )
    columns = [plain.raw[..., None], plain.jacobian]
    columns += [] if plain.start is None else [plain.start]
    rows = jnp.concatenate([carried.past, jnp.concatenate(columns, axis=-1)], axis=1)
    taps = carried.past.shape[1]
    wide = Sensitivity(
        rows[..., 0],
        rows[..., 0],
        rows[..., 1 : own + 1],
        None if plain.start is None else rows[..., own + 1 :],
        plain.result,
    )
    known = problem.known(kept, carried.count)
    blank = jnp.zeros((len(kept), taps, known.shape[2]), bool)
    known = jnp.concatenate([blank, known], axis=1)
    found = problem.whitened(wide, theta[own:], known)
    found = jax.tree.map(lambda leaf: leaf[:, taps:] if leaf.ndim > 1 else leaf, found)
    count = jnp.sum(kept, axis=1)
    # Samples come before padding, so the last `taps` of all rows begin at row `count`.
    last = jax.vmap(lambda r, n: jax.lax.dynamic_slice_in_dim(r, n, taps))(rows, count)
    point = problem.around(theta, carried.x, found)
    following = Carried(x, tangents, last, carried.count + count)
    return point.sums, jnp.isfinite(point.loss), found, following


class Stretches(eqx.Module):
    """A problem of one recording, cut into stretches when it is linearised.

    - `host`: its recording as NumPy arrays, which are cut without compilation.
    - `size`: number of intervals of a stretch. `most`: largest number of samples in a stretch.
    """

    problem: Problem
    host: Batch
    size: int
    most: int
    whole: bool

    @classmethod
    def of(cls, problem: Problem, size: int, whole: bool) -> "Stretches":
        """The stretches of a problem.

        **Arguments:**

        - `size`: number of intervals of a stretch. `whole`: whether derivatives are kept.
        """
        host = jax.tree.map(np.asarray, problem.batch)
        most = int(np.bincount(_at(host)[host.mask] // size).max())
        return cls(problem, host, size, most, whole)

    def __call__(
        self, theta: Float[Any, " parameters"], start: Float[Any, "recordings initials"]
    ) -> Point:
        """The linearised point, with derivatives only if they are kept."""
        intervals = self.host.intervals.h.shape[1]
        carried, total, found, sound = None, None, None, True
        for first in range(0, intervals, self.size):
            problem, rows = self._stretch(first)
            if not len(rows):
                break
            if carried is None:
                carried = begun(problem, theta, start)
            sums, good, piece, carried = along(problem, theta, carried)
            if not self.whole:
                piece = dataclasses.replace(piece, jacobian=None, start=None)
            found = jax.tree.map(self._room_for, piece) if found is None else found
            jax.tree.map(lambda room, x, rows=rows: self._put(room, rows, x), found, piece)
            total = sums if total is None else jax.tree.map(np.add, total, sums)
            sound = sound and bool(good)
        assert total is not None
        assert found is not None
        loss = np.sum(total.loss) if sound else np.inf
        return Point(theta, start, found, total, np.asarray(loss))

    def _room_for(self, piece: Array) -> np.ndarray:
        samples = self.host.mask.shape[1:] if piece.ndim > 1 else ()
        return np.zeros((1, *samples, *piece.shape[2:]), piece.dtype)

    @staticmethod
    def _put(room: np.ndarray, rows: Int[np.ndarray, " rows"], piece: Array) -> None:
        if piece.ndim > 1:
            room[:, rows] = np.asarray(piece)[:, : len(rows)]
        else:
            # After a failed stretch, all later ones have failed too.
            room[:] = np.maximum(room, piece)

    def _stretch(self, first: int) -> tuple[Problem, Int[np.ndarray, " rows"]]:
        """The problem of the stretch from a grid point on, and its samples."""
        batch, last = self.host, first + self.size
        at = _at(batch)
        there = np.asarray(batch.mask) & (at >= first) & (at < last)
        rows = np.flatnonzero(there.any(axis=0))

        def cut(leaf: Any) -> Any:
            # The last point is the end of the stretch; indices stop at the recording's end.
            return leaf[:, np.minimum(np.arange(first, last + 1), leaf.shape[1] - 1)]

        def sampled(leaf: Any) -> Any:
            filled = np.append(rows, np.full(self.most - len(rows), rows[-1] if len(rows) else 0))
            return leaf[:, filled]

        mask: Any = np.zeros((len(at), self.most), bool)
        mask[:, : len(rows)] = there[:, rows]
        fields = {
            "intervals": jax.tree.map(cut, batch.intervals),
            "at": sampled(at - first).clip(0, self.size),
            "mask": mask,
            **{name: sampled(getattr(batch, name)) for name in ("time", "q", "tau")},
        }
        if batch.moving is not None:
            fields["moving"] = sampled(batch.moving)
        part = Batch(q0=self.problem.batch.q0, v0=self.problem.batch.v0, **jax.device_put(fields))
        return dataclasses.replace(self.problem, batch=part), rows


def _at(batch: Batch) -> Int[np.ndarray, "recordings samples"]:
    """The grid point of each sample."""
    if batch.at is not None:
        return np.asarray(batch.at)
    return np.broadcast_to(np.arange(batch.mask.shape[1]), batch.mask.shape)
