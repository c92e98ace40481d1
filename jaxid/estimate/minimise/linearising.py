"""Linearisation of a problem in parts: over cores, devices, or stretches of time."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ...simulation.dynamics import imposed
from ...simulation.sharing import (
    EndToEnd,
    at_once,
    cores,
    everywhere,
    of_this_machine,
    shares_of,
    taken,
)
from ...simulation.widening import widened
from .problem import Point, Problem, Sums, point_around
from .residual import Sensitivity
from .stretches import Stretches


def linearise(
    problem: Problem,
    theta: Float[Any, " parameters"],
    start: Float[Any, "recordings initials"],
) -> Sensitivity:
    """Residual and all derivatives at parameter values and initial states."""
    return linearisation(problem, whole=True)(theta, start).found


def with_derivatives(problem: Problem, point: Point) -> Sensitivity:
    """Residual and derivatives at a point, computed again if they were not kept."""
    if point.found.jacobian is not None:
        return point.found
    return linearise(problem, point.theta, point.start)


def linearisation(problem: Problem, whole: bool = False) -> Callable[[Any, Any], Point]:
    """The function that linearises a problem; the problem is distributed only once.

    Recordings are distributed over the cores or over the problem's mesh. With a mesh every process
    gets the whole result.

    **Arguments:**

    - `whole`: keep all derivatives; otherwise only if they are small.
    """
    if problem.prior is None:
        return _of_recordings(problem, whole)
    # A prior counts once, however the recordings are divided.
    inner = _of_recordings(dataclasses.replace(problem, prior=None), whole)
    prior = jax.device_get(problem.prior)

    def at(theta: Any, start: Any) -> Point:
        point = inner(theta, start)
        sums, loss = jax.device_get((point.sums, point.loss))
        return dataclasses.replace(point, sums=sums, loss=loss).beside(prior, np)

    return at


def _of_recordings(problem: Problem, whole: bool) -> Callable[[Any, Any], Point]:
    """`linearisation` of a problem without a prior."""
    mesh = problem.mesh
    if mesh is not None and not of_this_machine(mesh):
        return lambda theta, start: _over_mesh(problem, mesh, theta, start)
    # Each host device would compile the program, and they would collect results one by one.
    problem = dataclasses.replace(problem, mesh=None)
    if mesh is None and imposed(problem.loop):
        return _Widened.of(problem, whole)
    return _linearisation(problem, whole, cores() if mesh is None else mesh.size)


def _linearisation(problem: Problem, whole: bool, threads: int) -> Callable[[Any, Any], Point]:
    """`linearisation` on this machine, by so many threads."""
    recordings, samples = problem.batch.mask.shape
    if recordings * samples <= _WORTH_SHARING:
        threads = 1
    size = problem.lower.shape[0] + 2 * problem.loop.joints * problem.free_start
    kept = whole or recordings * samples * problem.weights.shape[0] * size <= _KEPT
    if samples > _STRETCH and problem.batch.band is None:
        rows = shares_of(recordings, recordings)
        parts = [Stretches.of(_share(problem, row), _STRETCH, kept) for row in rows]
        return _Shared(parts, rows, threads)
    rounds = -(-recordings * samples // (threads * _AT_A_TIME))
    rows = shares_of(recordings, threads * rounds)
    if len(rows) == 1:
        return lambda theta, start: point_around(problem, jnp.asarray(theta), jnp.asarray(start))
    return _Shared([_Part(_share(problem, row), kept) for row in rows], rows, threads)


# Total number of samples above which threads are faster.
_WORTH_SHARING = 3000
# Samples of one share, and intervals of a stretch of a longer recording. With more, intermediate
# results would be allocated anew each time.
_AT_A_TIME = _STRETCH = 40_000
# Number of derivatives that are kept at every point, 64 MB.
_KEPT = 8_000_000


class _Part(eqx.Module):
    """The linearisation of one share."""

    problem: Problem
    whole: bool

    def __call__(
        self, theta: Float[Any, " parameters"], start: Float[Any, "rows initials"]
    ) -> Point:
        point = point_around(self.problem, theta, start)
        if self.whole:
            return point
        few = dataclasses.replace(point.found, jacobian=None, start=None)
        return dataclasses.replace(point, found=few)


class _Widened(eqx.Module):
    """The linearisation along an imposed motion, by the program of the widened loop.

    Further derivatives take little time there, since nothing is simulated.

    - `inner`: the linearisation of the widened problem. `values`: all values of its loop.
    - `own`: indices of the values that the problem estimates.
    """

    inner: Callable[[Any, Any], Point]
    values: Float[np.ndarray, " wide"]
    own: Int[np.ndarray, " own"]

    @classmethod
    def of(cls, problem: Problem, whole: bool) -> "_Widened":
        wide, own = widened(problem.loop)
        values = np.asarray(wide.theta)
        # The bounds do not matter here, but their size is that of all unknowns.
        bounds = jax.device_put(np.zeros(len(values) + problem.lower.shape[0] - len(own)))
        wider = dataclasses.replace(problem, loop=wide, lower=bounds, upper=bounds)
        return cls(_linearisation(wider, whole, cores()), values, own)

    def __call__(
        self, theta: Float[Any, " parameters"], start: Float[Any, "rows initials"]
    ) -> Point:
        values = self.values.copy()
        values[self.own], coefficients = np.split(np.asarray(theta), [len(self.own)])
        point = self.inner(np.append(values, coefficients), start)
        return point.with_only(np.append(self.own, len(values) + np.arange(len(coefficients))))


class _Shared(eqx.Module):
    """The linearisation of all recordings in shares, on several threads."""

    parts: list[Any]
    rows: list[Int[np.ndarray, " rows"]]
    threads: int

    def __call__(
        self, theta: Float[Any, " parameters"], start: Float[Any, "recordings initials"]
    ) -> Point:
        kept = EndToEnd(len(self.parts))
        theta, start = jnp.asarray(theta), np.asarray(start)

        def part(k: int) -> tuple[Array, ...]:
            point = self.parts[k](theta, taken(start, self.rows[k]))
            sums = point.sums
            own = sums.start_gram, sums.start_slope, sums.cross
            kept.put(k, (point.found, tuple(np.moveaxis(np.asarray(x), 1, 0) for x in own)))
            return point.loss, sums.loss, sums.gram, sums.slope

        parts = at_once(part, range(len(self.parts)), self.threads)
        found, own = kept.whole(len(start))
        # For a diverging step infinities of both signs are added; it is refused without a warning.
        with np.errstate(invalid="ignore"):
            loss, *sums = (np.sum(np.stack(x), axis=0) for x in zip(*parts, strict=True))
        own = (np.moveaxis(np.asarray(x), 0, 1) for x in own)
        return Point(theta, jnp.asarray(start), found, Sums(*sums, *own), loss)


def _over_mesh(problem: Problem, mesh: Mesh, theta: Any, start: Any) -> Point:
    point = point_around(*everywhere((problem, jnp.asarray(theta), jnp.asarray(start)), mesh))
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), point)


def _share(problem: Problem, rows: Int[np.ndarray, " rows"]) -> Problem:
    """The problem of some recordings; repetitions of a recording, as padding, do not count."""
    batch, free = taken((problem.batch, problem.free), rows)
    new: Bool[Array, "rows 1"] = jnp.asarray(np.append(True, np.diff(rows) > 0))[:, None]
    batch = dataclasses.replace(batch, mask=batch.mask & new)
    if batch.band is not None:
        kept = dataclasses.replace(batch.band, keep=batch.band.keep & new)
        batch = dataclasses.replace(batch, band=kept)
    return dataclasses.replace(problem, batch=batch, free=free)
