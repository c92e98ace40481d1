"""The residual of a simulated loop as a function of its parameters, and its minimisation."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ...linear_algebra import column_basis
from ...simulation.loop import ClosedLoop
from ...simulation.runs import SIGNALS, Batch, each, initial, run, run_with_sensitivities
from ...simulation.sharing import (
    EndToEnd,
    at_once,
    cores,
    everywhere,
    of_this_machine,
    shared_out,
    shares_of,
    taken,
)
from ..result import Status


class Sensitivity(eqx.Module):
    """Weighted residual of a batch and its derivatives, at one set of parameter values.

    `residual` is zero where there is no sample; `start` is its derivative by each recording's own
    initial position and velocity. `raw` is the residual before the noise filter.
    """

    raw: Float[Array, "recordings samples outputs"]
    residual: Float[Array, "recordings samples outputs"]
    jacobian: Float[Array, "recordings samples outputs parameters"]
    start: Float[Array, "recordings samples outputs initials"] | None


@eqx.filter_jit
def sensitivity(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    noise: Float[Array, "outputs taps"],
    signals: tuple[str, ...],
    free_start: bool,
) -> Sensitivity:
    """Weighted residual (measured less simulated) and its exact derivatives.

    **Arguments:**

    - `weights`: one over the deviation of each output, `(signals · joints,)`.
    - `noise`: the polynomial A of each output's noise filter 1/A, padded with zeros.
    - `signals`: which of `"tau"` and `"q"` are outputs.
    - `free_start`: whether initial states are parameters too.
    """
    plain = unfiltered(loop, batch, weights, signals, free_start)
    return through_filter(plain, noise, known_rows(noise, batch.kept))


def unfiltered(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    signals: tuple[str, ...],
    free_start: bool,
) -> Sensitivity:
    """`sensitivity` before any noise filter: the only pass through the simulation."""
    rows = tuple(SIGNALS.index(s) for s in signals)
    p, n = loop.theta.shape[0], loop.joints

    def one(intervals, at, q0, v0):
        by_start = jax.jacfwd(lambda z: initial(loop, intervals, z[:n], z[n:]))(
            jnp.concatenate([q0, v0])
        )
        x0 = initial(loop, intervals, q0, v0)
        extra = 2 * n if free_start else 0
        start = jnp.concatenate([jnp.zeros((x0.shape[0], p)), by_start[:, :extra]], axis=1)
        seen, slopes = run_with_sensitivities(loop, intervals, x0, start, rows)
        if at is not None:
            seen, slopes = seen[at], slopes[at]
        k = seen.shape[0]
        return seen.reshape(k, -1), slopes.reshape(k, len(rows) * n, p + extra)

    seen, slopes = each(one, batch.intervals, batch.at, batch.q0, batch.v0)
    measured = jnp.concatenate([getattr(batch, s) for s in signals], axis=-1)
    scale = weights * batch.mask[..., None]
    residual = (measured - seen) * scale
    slopes = -slopes * scale[..., None]
    if batch.band is not None:
        residual, slopes = batch.band(residual), batch.band(slopes)
    by_start = slopes[..., p:] if free_start else None
    return Sensitivity(residual, residual, slopes[..., :p], by_start)


def raw_residual(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    signals: tuple[str, ...],
) -> Float[Array, "recordings samples outputs"]:
    """Weighted residual before any noise filter, without derivatives."""
    rows = jnp.asarray([SIGNALS.index(s) for s in signals])

    def one(intervals, at, q0, v0):
        _, seen = run(loop, intervals, initial(loop, intervals, q0, v0))
        seen = seen[:, rows] if at is None else seen[at][:, rows]
        return seen.reshape(seen.shape[0], -1)

    seen = each(one, batch.intervals, batch.at, batch.q0, batch.v0)
    measured = jnp.concatenate([getattr(batch, s) for s in signals], axis=-1)
    residual = (measured - seen) * weights * batch.mask[..., None]
    return residual if batch.band is None else batch.band(residual)


def through_filter(
    plain: Sensitivity,
    noise: Float[Array, "..."],
    known: Bool[Array, "recordings samples outputs"],
) -> Sensitivity:
    """Residual and derivatives through the inverse of the noise filters.

    **Arguments:**

    - `noise`: polynomials, `(outputs, taps)`, or matrices of them where one output's noise
      drives another's, `(outputs, outputs, taps)`; padded with zeros.
    - `known`: which filtered rows count.
    """
    p = plain.jacobian.shape[-1]
    columns = [plain.raw[..., None], plain.jacobian]
    if plain.start is not None:
        columns.append(plain.start)
    white = filtered_by(noise, jnp.concatenate(columns, axis=-1))
    white = white * known[..., None]
    by_start = None if plain.start is None else white[..., p + 1 :]
    return Sensitivity(plain.raw, white[..., 0], white[..., 1 : p + 1], by_start)


def known_rows(
    noise: Float[Array, "..."], kept: Bool[Array, "recordings samples"]
) -> Bool[Array, "recordings samples outputs"]:
    """Which filtered rows need nothing from before the first sample, which nobody knows."""
    used = noise != 0 if noise.ndim == 2 else jnp.any(noise != 0, axis=1)
    taps = used.shape[1] - jnp.argmax(used[:, ::-1], axis=1) - 1
    row = jnp.cumsum(kept, axis=1) - 1
    return kept[..., None] & (row[..., None] >= taps)


class Coefficients(eqx.Module):
    """Taps of the noise filter that are estimated with the parameters, padded to few lengths.

    Coefficient c stands in row `row` for the past of `column`, `lag` samples back; `there` is
    False for padding. The residual is linear in them: their columns are the residual's own past.
    """

    row: Int[Array, " coefficients"]
    column: Int[Array, " coefficients"]
    lag: Int[Array, " coefficients"]
    there: Bool[Array, " coefficients"]

    @classmethod
    def of(cls, orders: Sequence[int], full: bool) -> "Coefficients":
        """The coefficients of filters of these orders, of full matrices of them if asked."""
        n = len(orders)
        places = [
            (i, j, lag)
            for i in range(n)
            for j in (range(n) if full else (i,))
            for lag in range(1, orders[i] + 1)
        ]
        size = 8 * -(-len(places) // 8)
        padded = np.array(places + [(0, 0, 0)] * (size - len(places)), int).reshape(size, 3)
        row, column, lag = (jnp.asarray(x) for x in padded.T)
        return cls(row, column, lag, jnp.arange(size) < len(places))

    def into(
        self, noise: Float[Array, "..."], values: Float[Array, " coefficients"]
    ) -> Float[Array, "..."]:
        """The filter with these values for its coefficients."""
        at = (self.row, self.lag) if noise.ndim == 2 else (self.row, self.column, self.lag)
        return noise.at[at].add(jnp.where(self.there, values, 0.0))

    def known(self, kept: Bool[Array, "recordings samples"]) -> Bool[Array, "recordings samples 1"]:
        """Rows that need nothing from before the first sample, the same for all outputs."""
        row = jnp.cumsum(kept, axis=1) - 1
        return (kept & (row >= jnp.max(self.lag, initial=0)))[..., None]

    def derivative(
        self, raw: Float[Array, "recordings samples outputs"]
    ) -> Float[Array, "recordings samples outputs coefficients"]:
        """Of the filtered residual by the coefficients."""
        at = jnp.arange(raw.shape[1])[:, None] - self.lag
        past = raw[:, jnp.maximum(at, 0), self.column] * ((at >= 0) & self.there)
        rows = self.row == jnp.arange(raw.shape[2])[:, None]
        return past[:, :, None, :] * rows


def filtered_by(
    noise: Float[Array, "..."], x: Float[Array, "recordings samples outputs columns"]
) -> Float[Array, "recordings samples outputs columns"]:
    """A(z) x along the samples; before the first sample all is zero."""

    def passed(lag, x):
        a = noise[..., lag]
        return a[:, None] * x if noise.ndim == 2 else jnp.einsum("ij,rkjc->rkic", a, x)

    def body(lag, total):
        earlier = jnp.roll(x, lag, axis=1)
        known = jnp.arange(x.shape[1]) >= lag
        return total + passed(lag, jnp.where(known[:, None, None], earlier, 0.0))

    # White noise, the usual case, has no second tap: what is not there is not paid for.
    used = jnp.max(jnp.where(noise != 0, jnp.arange(noise.shape[-1]), 0))
    return jax.lax.fori_loop(1, used + 1, body, passed(0, x))


def absorb_start(found: Sensitivity, free: Float[Array, " recordings"]) -> Sensitivity:
    """Takes out of the derivatives what initial states can explain as well.

    **Arguments:**

    - `free`: one for recordings whose initial state is estimated, else zero.
    """
    if found.start is None:
        return found
    count, p = found.jacobian.shape[0], found.jacobian.shape[-1]
    j = found.jacobian.reshape(count, -1, p)
    s = (found.start * free[:, None, None, None]).reshape(count, j.shape[1], -1)
    # Columns may be alike, or nil where a start is given: only a full decomposition says so.
    basis, size = jax.vmap(column_basis)(s)
    basis = jnp.where((size > 1e-10 * size[:, :1])[:, None, :], basis, 0.0)
    j = j - basis @ jnp.einsum("rka,rkp->rap", basis, j)
    return Sensitivity(found.raw, found.residual, j.reshape(found.jacobian.shape), None)


class Point(eqx.Module):
    """A set of parameter values and initial states, and the least-squares problem around it.

    - `theta`: parameter values; `start`: initial position and velocity of each recording.
    - `loss`: sum of squared weighted residuals; infinite where values are not physical or the
      simulation fails.
    - `gram`, `slope`: J'J and J'r for the parameters; `start_gram`, `start_slope` for the initial
      states of each recording, and `cross` between the two; empty where none is estimated.
    """

    theta: Float[Array, " parameters"]
    start: Float[Array, "recordings initials"]
    found: Sensitivity
    loss: Float[Array, ""]
    gram: Float[Array, "parameters parameters"]
    slope: Float[Array, " parameters"]
    start_gram: Float[Array, "recordings estimated estimated"]
    start_slope: Float[Array, "recordings estimated"]
    cross: Float[Array, "recordings estimated parameters"]


class Problem(eqx.Module):
    """Which residual is minimised, and where its parameters may go.

    - `free`: one for recordings whose initial state is estimated, else zero.
    - `mesh`: devices that share the recordings; None for one.
    - `coefficients`: of the noise filter, estimated after the loop's parameters in one vector;
      None where the filter is given.
    - `mix`: makes filtered outputs white and uncorrelated, `(outputs, outputs)`; None where the
      weights do all of it.
    """

    loop: ClosedLoop
    batch: Batch
    weights: Float[Array, " outputs"]
    noise: Float[Array, "outputs *taps"]
    free: Float[Array, " recordings"]
    lower: Float[Array, " parameters"]
    upper: Float[Array, " parameters"]
    signals: tuple[str, ...] = eqx.field(static=True)
    free_start: bool = eqx.field(static=True)
    mesh: Mesh | None = eqx.field(static=True, default=None)
    coefficients: Coefficients | None = None
    mix: Float[Array, "outputs outputs"] | None = None

    def linearised(self, loop: ClosedLoop, batch: Batch, extra: Float[Array, " _"]) -> Sensitivity:
        """Residual and derivatives, with one run of the simulation.

        **Arguments:**

        - `extra`: values of the noise filter's coefficients.
        """

        def part(loop: ClosedLoop, batch: Batch) -> Sensitivity:
            return unfiltered(loop, batch, self.weights, self.signals, self.free_start)

        plain = part(loop, batch) if self.mesh is None else shared_out(part, self.mesh, loop, batch)
        return self.whitened(plain, extra)

    def whitened(self, plain: Sensitivity, extra: Float[Array, " _"]) -> Sensitivity:
        """The unfiltered residual through the noise filter, with the coefficients' derivatives."""
        kept = self.batch.kept
        if self.coefficients is None:
            known = known_rows(self.noise, kept)
            found = through_filter(plain, self.noise, known)
        else:
            known = self.coefficients.known(kept)
            noise = self.coefficients.into(self.noise, extra)
            found = through_filter(plain, noise, known)
            past = self.coefficients.derivative(plain.raw) * known[..., None]
            wide = jnp.concatenate([found.jacobian, past], axis=-1)
            found = dataclasses.replace(found, jacobian=wide)
        return found if self.mix is None else mixed(found, self.mix)


def mixed(found: Sensitivity, mix: Float[Array, "outputs outputs"]) -> Sensitivity:
    """Filtered residual and derivatives with outputs combined by a matrix."""
    start = None if found.start is None else jnp.einsum("ij,rkja->rkia", mix, found.start)
    return Sensitivity(
        found.raw,
        jnp.einsum("ij,rkj->rki", mix, found.residual),
        jnp.einsum("ij,rkjp->rkip", mix, found.jacobian),
        start,
    )


def linearise(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
) -> Point:
    """The problem around parameter values and initial states, on all cores or over its mesh."""
    return linearisation(problem)(theta, start)


def linearisation(problem: Problem) -> Callable[[Array, Array], Point]:
    """`linearise` for many sets of values of one problem, which is shared out but once.

    With a mesh every process has the whole of it afterwards.
    """
    mesh = problem.mesh
    if mesh is not None and not of_this_machine(mesh):
        return lambda theta, start: _over_mesh(problem, mesh, theta, start)
    # Host devices would each compile the program, and take turns to put results together.
    problem = dataclasses.replace(problem, mesh=None)
    threads = cores() if mesh is None else mesh.size
    recordings, samples = problem.batch.mask.shape
    if recordings * samples <= _WORTH_SHARING:
        threads = 1
    rounds = -(-recordings * samples // (threads * _AT_A_TIME))
    shares = shares_of(recordings, threads * rounds)
    if len(shares) == 1:
        return lambda theta, start: point_around(problem, theta, start)
    return _Shared([_share(problem, rows) for rows in shares], shares, threads)


# Samples in all from which on threads gain more than they cost.
_WORTH_SHARING = 3000
# Samples of one share: intermediate results of more would be fresh memory each time.
_AT_A_TIME = 40_000


class _Shared(eqx.Module):
    """The linearisation of all recordings by shares, which threads take in turn."""

    parts: list[Problem]
    rows: list[Int[np.ndarray, " rows"]]
    threads: int

    def __call__(
        self, theta: Float[Array, " parameters"], start: Float[Array, "recordings initials"]
    ) -> Point:
        found = EndToEnd(len(self.parts))

        def part(k: int) -> tuple[Array, ...]:
            point = point_around(self.parts[k], theta, taken(start, self.rows[k]))
            found.put(k, (point.found, point.start_gram, point.start_slope, point.cross))
            return point.loss, point.gram, point.slope

        sums = at_once(part, range(len(self.parts)), self.threads)
        by_recording, *products = found.whole(start.shape[0])
        # Where a step diverges, infinities of both signs meet: it is refused, and no warning.
        with np.errstate(invalid="ignore"):
            loss, gram, slope = (jnp.asarray(np.sum(x, axis=0)) for x in zip(*sums, strict=True))
        return Point(theta, start, by_recording, loss, gram, slope, *products)


def _over_mesh(problem: Problem, mesh: Mesh, theta: Array, start: Array) -> Point:
    point = point_around(*everywhere((problem, theta, start), mesh))
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), point)


def _share(problem: Problem, rows: Int[np.ndarray, " rows"]) -> Problem:
    """The problem of some recordings; one that comes again to fill up does not count."""
    batch, free = taken((problem.batch, problem.free), rows)
    new = jnp.asarray(np.append(True, np.diff(rows) > 0))[:, None]
    batch = dataclasses.replace(batch, mask=batch.mask & new)
    if batch.band is not None:
        kept = dataclasses.replace(batch.band, keep=batch.band.keep & new)
        batch = dataclasses.replace(batch, band=kept)
    return dataclasses.replace(problem, batch=batch, free=free)


@eqx.filter_jit
def point_around(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
) -> Point:
    """`linearise` as one compiled function, also for use in others."""
    n, own = problem.loop.joints, problem.loop.theta.shape[0]
    loop = problem.loop.with_theta(theta[:own])
    batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
    found = problem.linearised(loop, batch, theta[own:])
    return products(problem, theta, start, found)


def products(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
    found: Sensitivity,
) -> Point:
    """What a step needs of a linearisation."""
    loop = problem.loop.with_theta(theta[: problem.loop.theta.shape[0]])
    loss, *sums = _sums(found.residual, found.jacobian, found.start, problem.free)
    gram, _, start_gram, _, _ = sums
    # By the squares: a loop close to running away has derivatives that are finite and useless.
    sound = jnp.isfinite(loss) & jnp.isfinite(jnp.sum(gram)) & jnp.isfinite(jnp.sum(start_gram))
    sound = sound & (loop.arm.smallest_inertia() > 0)
    return Point(theta, start, found, jnp.where(sound, loss, jnp.inf), *sums)


def _sums(residual: Any, jacobian: Any, by_start: Any, free: Any) -> tuple[Any, ...]:
    """Squared error, and the products of `Point` in their order; of NumPy's arrays or JAX's."""
    count, p = free.shape[0], jacobian.shape[-1]
    r = residual.reshape(count, -1)
    j = jacobian.reshape(*r.shape, p)
    s = j[..., :0]
    if by_start is not None:
        s = by_start.reshape(*j.shape[:2], -1) * free[:, None, None]
    flat, across = j.reshape(r.size, p), s.swapaxes(1, 2)
    return (
        (r**2).sum(),
        flat.T @ flat,
        r.reshape(-1) @ flat,
        across @ s,
        (across @ r[..., None])[..., 0],
        across @ j,
    )


def reweighted(problem: Problem, point: Point, ratio: Float[Array, " outputs"]) -> Point:
    """The linearisation of a problem that has other weights, without another simulation.

    **Arguments:**

    - `point`: of the problem with its former weights.
    - `ratio`: new weights over former ones. What a mix makes white knows no weights.
    """
    raw = np.asarray(ratio)
    scale = raw if problem.mix is None else np.ones_like(raw)
    found, by_start = point.found, point.found.start
    residual = np.asarray(found.residual) * scale
    jacobian = np.asarray(found.jacobian) * scale[:, None]
    if by_start is not None:
        by_start = np.asarray(by_start) * scale[:, None]
    # On the host: as a program it would be compiled for every loop, which takes longer.
    sums = _sums(residual, jacobian, by_start, np.asarray(problem.free))
    changed = np.asarray(found.raw) * raw, residual, jacobian, by_start
    changed, sums = jax.device_put((changed, sums))
    return Point(point.theta, point.start, Sensitivity(*changed), *sums)


class Minimum(eqx.Module):
    """Where a minimisation ended."""

    point: Point
    status: Status = eqx.field(static=True)
    iterations: int = eqx.field(static=True)


class _Scales(eqx.Module):
    """Squared sizes of columns, the largest met so far (Moré 1978)."""

    theta: Float[np.ndarray, " parameters"]
    start: Float[np.ndarray, "recordings estimated"]

    @classmethod
    def of(cls, point: Point, before: "_Scales | None" = None) -> "_Scales":
        theta = np.diag(np.asarray(point.gram))
        start = np.einsum("raa->ra", np.asarray(point.start_gram))
        if before is not None:
            theta, start = np.maximum(theta, before.theta), np.maximum(start, before.start)
        return cls(theta, start)


def _step(
    problem: Problem, point: Point, scales: _Scales, damping: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """A damped Gauss-Newton step inside the bounds, and how much it should lower the loss.

    Initial states are eliminated recording by recording, so that their number costs little.
    A parameter that stands on a bound and is pushed against it stays there.
    """
    theta, start = np.asarray(point.theta), np.asarray(point.start)
    lower, upper = np.asarray(problem.lower), np.asarray(problem.upper)
    slope, start_slope = np.asarray(point.slope), np.asarray(point.start_slope)
    gram, cross = np.asarray(point.gram), np.asarray(point.cross)
    initials = cross.shape[1]
    own = np.asarray(point.start_gram) + _diagonal(damping * scales.start)
    pair = np.concatenate([cross, start_slope[..., None]], axis=2)
    inner = np.linalg.solve(own, pair) if initials else pair
    reduced = gram + np.diag(damping * np.where(scales.theta > 0, scales.theta, 1.0))
    reduced = reduced - np.einsum("rap,raq->pq", cross, inner[..., :-1])
    push = slope - np.einsum("rap,ra->p", cross, inner[..., -1])
    step = _within(reduced, push, lower - theta, upper - theta)
    start_step = -inner[..., -1] - inner[..., :-1] @ step
    gain = -2 * (slope @ step + np.sum(start_slope * start_step)) - step @ gram @ step
    gain -= 2 * np.einsum("ra,rap,p->", start_step, cross, step)
    gain -= np.einsum("ra,rab,rb->", start_step, np.asarray(point.start_gram), start_step)
    full = np.zeros_like(start)
    full[:, :initials] = start_step
    return step, full, float(gain)


def _within(
    gram: Float[np.ndarray, "parameters parameters"],
    slope: Float[np.ndarray, " parameters"],
    low: Float[np.ndarray, " parameters"],
    high: Float[np.ndarray, " parameters"],
) -> Float[np.ndarray, " parameters"]:
    """The step that solves `gram step = -slope` for those that do not end on a bound."""
    step = np.where((low >= 0) & (slope > 0), low, 0.0)
    step = np.where((high <= 0) & (slope < 0), high, step)
    open_ = ~(((low >= 0) & (slope > 0)) | ((high <= 0) & (slope < 0)))
    unit = np.sqrt(np.diag(gram))
    while open_.any():
        some = np.ix_(open_, open_)
        scaled = gram[some] / np.outer(unit[open_], unit[open_])
        right = slope[open_] + gram[np.ix_(open_, ~open_)] @ step[~open_]
        step[open_] = -np.linalg.solve(scaled, right / unit[open_]) / unit[open_]
        beyond = open_ & ((step < low) | (step > high))
        if not beyond.any():
            break
        # Those that would go beyond a bound stop there, and the others make up for it.
        step = np.where(beyond, np.clip(step, low, high), step)
        open_ = open_ & ~beyond
    return step


def _diagonal(values: np.ndarray) -> np.ndarray:
    """Diagonal matrices of rows; one where there is nothing to scale by."""
    return np.where(values > 0, values, 1.0)[..., None] * np.eye(values.shape[-1])


def minimise(
    problem: Problem,
    theta: Float[Array, " parameters"],
    start: Float[Array, "recordings initials"],
    tolerance: float,
    worth: float,
    max_steps: int,
    say: Callable[[str], None],
    deadline: float = math.inf,
    known: Point | None = None,
) -> Minimum:
    """Levenberg–Marquardt inside bounds, over parameters and initial states together.

    Damping after Nielsen 1999, scaling after Moré 1978. optimistix's solver knows neither bounds
    nor that initial states concern one recording each, and would factor all of them at once.

    **Arguments:**

    - `theta`, `start`: where to start, `(parameters,)` and `(recordings, 2 · joints)`.
    - `tolerance`: it stops when a step is shorter than this many standard deviations, or
    - `worth`: when five steps together lower the loss by less than this share.
    - `max_steps`: largest number of steps, refused ones included.
    - `say`: told about every step.
    - `deadline`: of `time.perf_counter`, looked at before every step.
    - `known`: the linearisation at the start, where there is one already.
    """
    around = linearisation(problem)
    theta = jnp.asarray(np.clip(theta, problem.lower, problem.upper))
    point = around(theta, start) if known is None else known
    if not np.isfinite(point.loss):
        return Minimum(point, Status.diverged, 1)
    count = point.found.residual.size
    scales, damping, growth = _Scales.of(point), 1e-3, 2.0
    losses = [float(point.loss)]
    for k in range(2, max_steps + 1):
        if time.perf_counter() > deadline:
            return Minimum(point, Status.max_seconds, k - 1)
        # A loop close to running away has derivatives whose squares overflow: such a step comes out
        # as nothing, is refused like any other, and damping grows.
        with np.errstate(over="ignore", invalid="ignore"):
            # What a full step promises, in units of the residual's own spread.
            promised = _step(problem, point, scales, 1e-10)[2]
            step, start_step, gain = _step(problem, point, scales, damping)
        if promised <= tolerance**2 * float(point.loss) / count:
            return Minimum(point, Status.converged, k - 1)
        ahead = np.asarray(point.theta) + step, np.asarray(point.start) + start_step
        trial = around(*map(jnp.asarray, ahead))
        say(f"iteration {k}, weighted squared error {float(trial.loss):.6g}")
        share = (float(point.loss) - float(trial.loss)) / gain
        if share > 0:
            point, scales = trial, _Scales.of(trial, scales)
            losses.append(float(point.loss))
            damping, growth = max(damping * max(1 / 3, 1 - (2 * share - 1) ** 3), 1e-10), 2.0
        else:
            damping, growth = damping * growth, 2 * growth
        # Where friction sticks, the loss has kinks, and full steps keep promising what small ones
        # do not find: what five of them no longer change is where the model is at its best.
        if len(losses) > 5 and losses[-6] - losses[-1] < worth * losses[-1]:
            return Minimum(point, Status.converged, k)
        if damping > 1e12:
            return Minimum(point, Status.stalled, k)
    return Minimum(point, Status.max_steps, max_steps)
