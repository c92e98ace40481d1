"""Many fits at once from nearby start values, for bootstrap, profiles and coverage."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..display.progress import silent
from ..errors import FitError
from ..linear_algebra import solve
from ..noise import ARFilter, VectorAR, fit_ar, innovations, levels
from .covariance import Optimum, optimum_of
from .minimise import (
    BoundedDescent,
    LevenbergMarquardt,
    Point,
    Problem,
    Sensitivity,
    absorb_start,
    linearise,
    point_around,
    promised,
    raw_residual,
    unfiltered,
)
from .result import Fit

# Number of fits in one vmap: enough for the vector units, few enough for the caches.
LANES = 8


class Lanes(eqx.Module):
    """The inputs that differ between fits; `(lanes,)` before every axis.

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
        """Inputs of a number of fits of an optimum's problem, with other signals if given."""
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
    """Results of the fits; `(lanes,)` before every axis.

    - `theta`: values; `loss`: squared filtered error, in units of the problem's weights.
    - `last`: squared length of the last step, in deviations.
    - `raw`, `residual`: weighted residual before and after the filter.
    - `jacobian`: of the filtered residual with respect to the loop's parameters, with initial
      states and filter coefficients projected out.
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


def _solver(problem: Problem) -> LevenbergMarquardt:
    return LevenbergMarquardt(descent=BoundedDescent(problem.lower, problem.upper))


def _settle(
    problem: Problem, near: Sensitivity, theta: Float[Array, " values"], start, steps: int
) -> tuple[Float[Array, " values"], Float[Array, "recordings initials"]]:
    """Gauss-Newton steps with sensitivities from nearby values and exact residuals."""
    n, own, solver = problem.loop.joints, problem.loop.theta.shape[0], _solver(problem)

    def point_at(theta, start) -> Point:
        batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
        loop = problem.loop.with_theta(theta[:own])
        raw = raw_residual(loop, batch, problem.weights, problem.signals)
        plain = dataclasses.replace(near, raw=raw, residual=raw)
        return problem.around(theta, start, problem.whitened(plain, theta[own:]))

    def body(carry, _):
        y, state = carry
        trial, estimated = state.y_eval
        point = point_at(trial, estimated if problem.free_start else start)
        options = {"linearised": point.sums.products(point.loss), "rows": problem.batch.kept.size}
        y, state, _ = solver.step(None, y, None, options, state, frozenset())
        return (y, state), None

    y = problem.unknowns(jnp.clip(theta, problem.lower, problem.upper), start)
    state = solver.init(None, y, None, {}, None, None, frozenset())
    (y, state), _ = jax.lax.scan(body, (y, state), None, length=steps)
    # The end of the last step, which was not evaluated yet.
    theta, estimated = state.y_eval
    return theta, estimated if problem.free_start else start


def _last_step(
    problem: Problem, point: Point
) -> tuple[Float[Array, " values"], Float[Array, "recordings initials"], Float[Array, ""]]:
    """A full step, and its predicted decrease of the loss."""
    descent = _solver(problem).descent
    y, products = problem.unknowns(point.theta, point.start), point.sums.products(point.loss)
    state = descent.query(y, products, descent.init(y, jax.tree.map(jnp.zeros_like, products)))
    (step, moved), _ = descent.step(jnp.asarray(1e12), state)
    moved = moved if problem.free_start else jnp.zeros_like(point.start)
    estimated = moved if problem.free_start else moved[:0, :0]
    return step, moved, 2 * promised((step, estimated), products)


def _own_columns(problem: Problem, point: Point) -> Float[Array, "recordings samples outputs p"]:
    """The loop's columns with initial states and filter coefficients projected out."""
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
    """Linear change of the residual by steps of parameters and initial states."""
    change = found.jacobian @ step
    return (
        change if found.start is None else change + jnp.einsum("rkoa,ra->rko", found.start, moved)
    )


@compiled
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
        step, moved, promise = _last_step(mine, point)
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

    Gauss-Newton with fixed weights: some steps with the sensitivities at the problem's own values,
    which need only one simulation each, and a last step with sensitivities at the new values. The
    fits must end close to the problem's own; check `Refitted.last`.

    **Arguments:**

    - `optimum`: optimum of a fit; sensitivities are computed at its values and initial states.
    - `steps`: number of steps before the last.
    - `say`: called with progress.
    """
    count, pieces = lanes.theta.shape[0], []
    for begin in range(0, count, LANES):
        say(f"{begin} of {count} fits", begin / count)
        # The number is fixed, padded with the last ones; one program serves all counts.
        rows = np.minimum(np.arange(begin, begin + LANES), count - 1)
        some = jax.tree.map(lambda x, rows=rows: x[rows], lanes)
        pieces.append(jax.tree.map(np.asarray, _refit_some(optimum, some, steps)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *pieces)


def redrawn(
    fit: Fit, noise: Sequence[Float[np.ndarray, "draws _samples outputs"]]
) -> Float[np.ndarray, "draws recordings samples outputs"]:
    """Signals of the fitted model with other noise, padded.

    **Arguments:**

    - `noise`: noise of the outputs, for each recording.

    **Raises:** `FitError` for regressions, and if only part of the signals is compared.
    """
    optimum = optimum_of(fit, "draws")
    problem = optimum.problem
    if problem.batch.band is not None:
        raise FitError(
            "noise cannot be drawn for a virtual controller, because only a part of the torque is "
            "compared: give the loop its real controller"
        )
    found = linearise(problem, optimum.theta, optimum.start)
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

    Output error keeps the fit's weights. Joint prediction error estimates its filters with every
    draw. For separable prediction error the filters are estimated from each draw's output-error
    residual by Burg's method, with the orders of the fit.

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


def noise_strengths(
    residuals: Sequence[Float[np.ndarray, "_samples outputs"]],
    noise: tuple[ARFilter, ...] | VectorAR,
) -> list[Float[np.ndarray, " outputs"]]:
    """Noise level of each recording relative to that of a filter, for `drawn_noise`.

    Samples that are not compared are zero, so the noise of the others is stronger than the mean.

    **Arguments:**

    - `residuals`: `(samples, outputs)` of each recording. `noise`: their filters.
    """
    return levels([innovations(r, noise) * (r != 0) for r in residuals])


def drawn_noise(
    noise: tuple[ARFilter, ...] | VectorAR,
    lengths: Sequence[int],
    draws: int,
    rng: np.random.Generator,
    strengths: Sequence[Float[np.ndarray, " outputs"]] | None = None,
) -> list[Float[np.ndarray, "draws _samples outputs"]]:
    """Stationary noise of a filter, for recordings of given lengths and noise levels."""
    if isinstance(noise, VectorAR):
        made = [noise.simulate((draws, n), rng) for n in lengths]
    else:
        made = [np.stack([f.simulate((draws, n), rng) for f in noise], axis=-1) for n in lengths]
    return made if strengths is None else [x * k for x, k in zip(made, strengths, strict=True)]
