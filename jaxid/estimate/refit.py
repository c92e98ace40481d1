"""Many fits at once, from values close by: what bootstrap, profiles and coverage are made of."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..display.progress import silent
from ..errors import FitError
from ..linear_algebra import solve
from ..noise import ARFilter, VectorAR, fit_ar
from .covariance import Optimum, optimum_of
from .minimise.problem import (
    Point,
    Problem,
    Sensitivity,
    absorb_start,
    linearise,
    point_around,
    products,
    raw_residual,
    unfiltered,
)
from .result import Fit

# Lanes of one vmap: enough to fill the vector units, few enough for the caches.
LANES = 8


class Lanes(eqx.Module):
    """What differs from one fit to the next; `(lanes,)` before every axis.

    - `measured`: signals to fit, outputs in the order of the problem's weights.
    - `noise`: polynomials of the noise filter. `lower`, `upper`: bounds. `theta`: start values.
    """

    measured: Float[Array, "*lanes recordings samples outputs"]
    noise: Float[Array, "..."]
    lower: Float[Array, "*lanes values"]
    upper: Float[Array, "*lanes values"]
    theta: Float[Array, "*lanes values"]

    @classmethod
    def around(
        cls,
        optimum: Optimum,
        count: int,
        measured: Float[np.ndarray, "lanes recordings samples outputs"] | None = None,
    ) -> "Lanes":
        """So many fits of an optimum's own problem, of other signals if they are given."""
        problem = optimum.problem

        def each(x) -> Array:
            return jnp.broadcast_to(jnp.asarray(x), (count, *np.shape(x)))

        return cls(
            each(measured_of(problem)) if measured is None else jnp.asarray(measured),
            each(problem.noise),
            each(problem.lower),
            each(problem.upper),
            each(optimum.theta),
        )


class Refitted(eqx.Module):
    """Where the fits ended; `(lanes,)` before every axis.

    - `theta`: values; `loss`: squared filtered error, in units of the problem's weights.
    - `last`: squared length of the last step, in deviations.
    - `raw`, `residual`: weighted residual before and after the filter.
    - `jacobian`: of the filtered residual by the loop's parameters, with what initial states and
      filter coefficients can explain taken out.
    """

    theta: Float[Array | np.ndarray, "*lanes values"]
    loss: Float[Array | np.ndarray, "*lanes"]
    last: Float[Array | np.ndarray, "*lanes"]
    raw: Float[Array | np.ndarray, "*lanes recordings samples outputs"]
    residual: Float[Array | np.ndarray, "*lanes recordings samples outputs"]
    jacobian: Float[Array | np.ndarray, "*lanes recordings samples outputs parameters"]


def measured_of(problem: Problem) -> Float[Array, "recordings samples outputs"]:
    """The signals that a problem fits."""
    return jnp.concatenate([getattr(problem.batch, s) for s in problem.signals], axis=-1)


def _measuring(problem: Problem, measured: Float[Array, "recordings samples outputs"]) -> Problem:
    n = problem.loop.joints
    parts = {s: measured[..., k * n : (k + 1) * n] for k, s in enumerate(problem.signals)}
    return dataclasses.replace(problem, batch=dataclasses.replace(problem.batch, **parts))


def _bounded_step(
    point: Point,
    low: Float[Array, " values"],
    high: Float[Array, " values"],
    damping: Float[Array, ""],
) -> tuple[Float[Array, " values"], Float[Array, "recordings initials"], Float[Array, ""]]:
    """A damped Gauss-Newton step inside bounds, and what it promises."""
    width = jnp.sqrt(jnp.diag(point.gram))
    width = jnp.where(width > 0, width, 1.0)
    initials = point.cross.shape[1]
    reduced, push = point.gram, point.slope
    inner = jnp.zeros((point.start.shape[0], initials, len(width) + 1))
    if initials:
        size = jnp.einsum("raa->ra", point.start_gram)
        own = jnp.where(size > 0, (1e-10 + damping) * size, 1.0)[..., None] * jnp.eye(initials)
        pair = jnp.concatenate([point.cross, point.start_slope[..., None]], axis=2)
        inner = jax.vmap(solve)(point.start_gram + own, pair)
        reduced = reduced - jnp.einsum("rap,raq->pq", point.cross, inner[..., :-1])
        push = push - jnp.einsum("rap,ra->p", point.cross, inner[..., -1])
    scaled = reduced / jnp.outer(width, width) + (1e-12 + damping) * jnp.eye(len(width))
    low, high, push = low * width, high * width, push / width
    step = jnp.zeros_like(push)
    stuck = ((low >= 0) & (push > 0)) | ((high <= 0) & (push < 0))
    for _ in range(3):
        # What would leave its bounds stops there, and the others make up for it.
        held = jnp.where(stuck, jnp.clip(step, low, high), 0.0)
        matrix = jnp.where(stuck[:, None] | stuck, jnp.eye(len(push)), scaled)
        right = jnp.where(stuck, held, -push - scaled @ held)
        step = solve(matrix, right)
        stuck = stuck | (step < low) | (step > high)
    step = jnp.clip(step, low, high) / width
    start_step = jnp.zeros_like(point.start)
    if initials:
        start_step = start_step.at[:, :initials].set(-inner[..., -1] - inner[..., :-1] @ step)
    # Initial states follow the parameters, so that the reduced problem is the whole promise.
    wide = step * width
    return step, start_step, -2 * push @ wide - wide @ (scaled @ wide)


def _settle(
    problem: Problem, near: Sensitivity, theta: Float[Array, " values"], start, steps: int
) -> tuple[Float[Array, " values"], Float[Array, "recordings initials"]]:
    """Steps with the simulation's sensitivities of close by, and everything else exact."""
    n, own = problem.loop.joints, problem.loop.theta.shape[0]

    def point_at(theta, start) -> Point:
        batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
        loop = problem.loop.with_theta(theta[:own])
        raw = raw_residual(loop, batch, problem.weights, problem.signals)
        plain = dataclasses.replace(near, raw=raw, residual=raw)
        return products(problem, theta, start, problem.whitened(plain, theta[own:]))

    def body(carry, _):
        theta, start, best, damping = carry
        point = point_at(theta, start)
        better = point.loss <= best[2]
        kept = (point.theta, point.start, point.loss)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), kept, best)
        # After a step that failed the next is shorter, from where it began.
        damping = jnp.where(better, 0.0, jnp.maximum(10 * damping, 1e-1))
        low, high = problem.lower - theta, problem.upper - theta
        step, start_step, _ = _bounded_step(point, low, high, damping)
        ahead = (theta + step, start + start_step)
        theta, start = jax.tree.map(lambda a, b: jnp.where(better, a, b), ahead, best[:2])
        return (theta, start, best, damping), None

    theta = jnp.clip(theta, problem.lower, problem.upper)
    first = (theta, start, (theta, start, jnp.asarray(jnp.inf)), jnp.zeros(()))
    (theta, start, _, _), _ = jax.lax.scan(body, first, None, length=steps)
    return theta, start


def _own_columns(problem: Problem, point: Point) -> Float[Array, "recordings samples outputs p"]:
    """The loop's columns with what initial states and filter coefficients explain taken out."""
    p = problem.loop.theta.shape[0]
    columns = absorb_start(point.found, problem.free).jacobian
    if problem.coefficients is None:
        return columns
    own, past = columns[..., :p], columns[..., p:]
    there = jnp.diag(jnp.where(problem.coefficients.there, 0.0, 1.0))
    gram = jnp.einsum("rkoa,rkob->ab", past, past) + there
    cross = jnp.einsum("rkoa,rkop->ap", past, own)
    return own - past @ solve(gram, cross)


def _changed(
    found: Sensitivity,
    step: Float[Array, " parameters"],
    moved: Float[Array, "recordings initials"],
) -> Float[Array, "recordings samples outputs"]:
    """What steps of parameters and initial states add to the residual."""
    change = found.jacobian @ step
    return (
        change if found.start is None else change + jnp.einsum("rkoa,ra->rko", found.start, moved)
    )


@eqx.filter_jit
def _refit_some(optimum: Optimum, lanes: Lanes, steps: int) -> Refitted:
    problem, start = optimum.problem, jnp.asarray(optimum.start)
    n, own = problem.loop.joints, problem.loop.theta.shape[0]
    loop = problem.loop.with_theta(jnp.asarray(optimum.theta)[:own])
    here = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
    near = unfiltered(loop, here, problem.weights, problem.signals, problem.free_start)

    def one(lane: Lanes) -> Refitted:
        mine = dataclasses.replace(
            _measuring(problem, lane.measured),
            noise=lane.noise,
            lower=lane.lower,
            upper=lane.upper,
        )
        theta, initials = _settle(mine, near, lane.theta, start, steps)
        point = point_around(mine, theta, initials)
        low, high = mine.lower - theta, mine.upper - theta
        step, moved, promise = _bounded_step(point, low, high, jnp.zeros(()))
        found = point.found
        last = promise / (point.loss / jnp.sum(found.residual != 0))
        columns = _own_columns(mine, point)
        residual = found.residual + _changed(found, step, moved)
        raw = found.raw + _changed(near, step[:own], moved)
        return Refitted(theta + step, jnp.sum(residual**2), last, raw, residual, columns)

    return jax.vmap(one)(lanes)


def refit(
    optimum: Optimum, lanes: Lanes, steps: int = 4, say: Callable[..., None] = silent
) -> Refitted:
    """Fits of a problem with other signals, filters, bounds or start values, vmapped.

    Gauss-Newton with weights kept: some steps with the sensitivities of the problem's own values,
    which need no more than a simulation each, and a last one with those of where they led. For
    fits that end close to the problem's own, as `Refitted.last` tells.

    **Arguments:**

    - `optimum`: of a fit; its values and initial states are where sensitivities are taken.
    - `steps`: how many before the last.
    - `say`: told how far it is.
    """
    count, pieces = lanes.theta.shape[0], []
    for begin in range(0, count, LANES):
        say(f"{begin} of {count} fits", begin / count)
        # Always as many, the last ones again where they run out: one program serves all counts.
        rows = np.minimum(np.arange(begin, begin + LANES), count - 1)
        some = jax.tree.map(lambda x, rows=rows: x[rows], lanes)
        pieces.append(jax.tree.map(np.asarray, _refit_some(optimum, some, steps)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *pieces)


def redrawn(
    fit: Fit, noise: Sequence[Float[np.ndarray, "draws _samples outputs"]]
) -> Float[np.ndarray, "draws recordings samples outputs"]:
    """Signals that the fitted model would have given under other noise, padded.

    **Arguments:**

    - `noise`: on the outputs, for each recording.

    **Raises:** `FitError` for regressions, and where only part of the signals is compared.
    """
    optimum = optimum_of(fit, "draws")
    problem = optimum.problem
    if problem.batch.band is not None:
        raise FitError(
            "noise cannot be drawn for a virtual controller, which compares a part of the torque "
            "only: give the loop its own controller"
        )
    found = linearise(problem, jnp.asarray(optimum.theta), jnp.asarray(optimum.start)).found
    clean = np.asarray(measured_of(problem)) - np.asarray(found.raw / problem.weights)
    draws = len(noise[0])
    signals = np.repeat(clean[None], draws, axis=0)
    for k, (there, rows) in enumerate(zip(np.asarray(problem.batch.mask), noise, strict=True)):
        signals[:, k, there] += rows
    return signals


def refit_signals(
    fit: Fit,
    measured: Float[np.ndarray, "draws recordings samples outputs"],
    steps: int = 4,
    say: Callable[..., None] = silent,
) -> Refitted:
    """Fits of other signals by the method of a fit.

    Output error keeps the fit's weights. Joint prediction error estimates its filters from every
    draw; for separable prediction error they are estimated from each draw's output-error residual
    by Burg's method, with the orders of the fit.

    **Arguments:**

    - `measured`: outputs, padded to the longest recording.
    - `steps`, `say`: as in `refit`.
    """
    optimum = optimum_of(fit, "draws")
    problem = optimum.problem
    lanes = Lanes.around(optimum, len(measured), measured)
    separable = problem.coefficients is None and fit.rounds > 0
    if not separable or not isinstance(fit.noise, tuple):
        return refit(optimum, lanes, steps, say)
    white = jnp.zeros_like(lanes.noise).at[..., 0].set(1.0)
    first = refit(optimum, dataclasses.replace(lanes, noise=white), steps, say)
    taps = _taps_by_draw(np.asarray(first.raw), problem, fit.noise)
    again = dataclasses.replace(lanes, noise=jnp.asarray(taps), theta=jnp.asarray(first.theta))
    return refit(optimum, again, steps, say)


def _taps_by_draw(
    raw: Float[np.ndarray, "draws recordings samples outputs"],
    problem: Problem,
    like: tuple[ARFilter, ...],
) -> Float[np.ndarray, "draws outputs taps"]:
    kept, size = np.asarray(problem.batch.kept), problem.noise.shape[-1]
    return np.array(
        [
            [
                fit_ar([x[there, j] for x, there in zip(rows, kept, strict=True)], filt.order).taps(
                    size
                )
                for j, filt in enumerate(like)
            ]
            for rows in raw
        ]
    )


def drawn_noise(
    noise: tuple[ARFilter, ...] | VectorAR,
    lengths: Sequence[int],
    draws: int,
    rng: np.random.Generator,
    strengths: Sequence[Float[np.ndarray, " outputs"]] | None = None,
) -> list[Float[np.ndarray, "draws _samples outputs"]]:
    """Stationary noise of a filter, for recordings of these lengths, each with its strength."""
    if isinstance(noise, VectorAR):
        made = [noise.simulate((draws, n), rng) for n in lengths]
    else:
        made = [np.stack([f.simulate((draws, n), rng) for f in noise], axis=-1) for n in lengths]
    return made if strengths is None else [x * k for x, k in zip(made, strengths, strict=True)]
