"""Minimisation of output error, iterated over weights and initial states."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..control import OpenLoop
from ..noise import ARFilter, Noise, VectorAR
from ..parameters import Bounds
from ..recording import Recording, Recordings
from ..simulation.batch import Batch, prepare
from ..simulation.loop import ClosedLoop
from ..simulation.runs import simulate_batch
from ..simulation.sharing import taken
from ..simulation.steps import (
    ACCURATE,
    HALF_STABLE,
    MANY,
    needed_substeps,
    refined,
    set_substeps,
    sharpest,
)
from .covariance import Optimum
from .minimise import Minimum, Point, Problem, Stopping, minimise, reweighted
from .pieces import (
    OutputErrorSettings,
    compared_signals,
    estimated_starts,
    first_weights,
    pieces_of,
)
from .prior import prior_of
from .result import Status


class Converged(eqx.Module):
    """A minimisation, converged or not, with the data for its report."""

    loop: ClosedLoop
    pieces: tuple[Recording, ...]
    batch: Batch
    weights: Float[Array, " outputs"]
    minimum: Minimum
    problem: Problem
    signals: tuple[str, ...] = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    @property
    def optimum(self) -> Optimum:
        """The optimum, from which deviations follow."""
        point = self.minimum.point
        return Optimum(self.problem, point.theta, point.start)


def converge(
    method: OutputErrorSettings,
    loop: ClosedLoop,
    recordings: Recordings,
    say: Callable[[str], None],
    filters: Noise = None,
    deadline: float = math.inf,
    weights: Float[Array, " outputs"] | None = None,
    batch: Batch | None = None,
) -> Converged:
    """Minimises repeatedly with updated weights, delay and initial states, until they converge.

    **Arguments:**

    - `filters`: noise filter of each output; white noise if None.
    - `deadline`: time of `time.perf_counter` after which the best values so far are returned.
    - `weights`: start values, if known; filters have their own.
    - `batch`: the prepared pieces, if they exist.
    """
    pieces = pieces_of(recordings, method.window)
    signals = compared_signals(method, loop)
    batch = prepare(loop, pieces) if batch is None else batch
    estimated = estimated_starts(method, pieces, batch)
    free, first = map(jax.device_put, (estimated, first_weights(loop, pieces, signals)))
    start = jax.device_put(np.concatenate([batch.q0, batch.v0], axis=1))
    bounds = _resolved(loop, recordings)
    # From poor start values the delay of the torque may move far, so it is estimated last.
    held = _delays(loop) & (weights is None and filters is None)
    if weights is None and filters is not None:
        weights = _weights_of(filters, first)
    prior = prior_of(loop, recordings)
    # For a single output the weight only scales the loss, if there is no prior.
    alone = len(first) == 1 and prior is None
    # Until the weights are known, a rough minimum is enough.
    worth = 1e-4 if alone or weights is not None else 1e-2
    weights = jnp.asarray(first if weights is None else weights)

    def posed(weights: Float[Array, " outputs"]) -> Problem:
        theta = loop.theta
        within = jnp.where(held, theta, bounds.lower), jnp.where(held, theta, bounds.upper)
        noise = jax.device_put(_taps(filters, weights))
        kinds = signals, bool(estimated.any()), method.mesh
        mix = _mix(filters, weights)
        return Problem(loop, batch, weights, noise, free, *within, *kinds, mix=mix, prior=prior)

    total, minimum, ratio, again = 0, None, jnp.ones_like(first), False
    problem = posed(weights)
    for _ in range(20):
        left = method.max_steps - total
        known = None if minimum is None or again else reweighted(problem, minimum.point, ratio)
        settings = Stopping(method.tolerance, worth, left, deadline, method.solver)
        minimum = minimise(problem, loop.theta, start, settings, say, known)
        total += minimum.iterations
        if not minimum.status.simulated:
            break
        loop, start = loop.with_theta(minimum.point.theta), minimum.point.start
        new = _new_weights(minimum.point, problem, first)
        # Estimates depend little on the weights: an error of 10 % raises deviations by 0.5 %.
        floor = bool(np.all(np.asarray(new) > 0.99 / _FLOOR * np.asarray(first)))
        if minimum.status is Status.stalled and floor:
            # The residual is at rounding level, and no step lowers it.
            minimum = dataclasses.replace(minimum, status=Status.converged)
        settled = bool(np.all(np.abs(np.asarray(new) / np.asarray(weights) - 1) < 0.1))
        ended = total >= method.max_steps or minimum.status is Status.max_seconds
        again, held = bool(held.any()), np.zeros_like(held)
        if ended or (settled and worth < 1e-2 and not again):
            break
        ratio, weights, worth = new / weights, new, 1e-4 if settled else worth
        problem = posed(weights)
        if alone and not again:
            there = reweighted(problem, minimum.point, ratio)
            minimum = dataclasses.replace(minimum, point=there)
            break
    assert minimum is not None
    return Converged(
        loop=loop,
        pieces=pieces,
        batch=batch,
        weights=problem.weights,
        minimum=minimum,
        problem=problem,
        signals=signals,
        iterations=total,
    )


def _delays(loop: ClosedLoop) -> Bool[np.ndarray, " parameters"]:
    """Which free parameters are a delay of the torque."""
    free = loop.free_parameters
    delays = [p.place == ("controller", "delay") for p in free for _ in range(p.size)]
    return np.array(delays, bool) & loop.controller.imposes


def _resolved(loop: ClosedLoop, recordings: Recordings) -> Bounds:
    """The parameters' bounds, with smoothings of signs no smaller than the steps resolve."""
    bounds, factor = Bounds.of(loop.free_parameters), sharpest(loop, recordings)
    if not factor:
        return bounds
    least = np.where(_smoothings(loop), factor * np.asarray(loop.theta), -np.inf)
    return dataclasses.replace(bounds, lower=jax.device_put(np.maximum(bounds.lower, least)))


def _smoothings(loop: ClosedLoop) -> Bool[np.ndarray, " parameters"]:
    """Which free parameters are smoothings of a sign."""
    free = loop.free_parameters
    return np.array([p.place[-1] == "smoothing" for p in free for _ in range(p.size)], bool)


def _weights_of(filters: Noise, first: Float[Array, " outputs"]) -> Float[Array, " outputs"]:
    """Inverse deviation of each filter's innovations; deviations have a floor by the signal."""
    if isinstance(filters, VectorAR):
        variance = np.diag(filters.covariance)
    else:
        variance = np.array([f.variance for f in filters or ()])
    return jnp.asarray(1 / np.maximum(np.sqrt(variance), _FLOOR / np.asarray(first)))


def _taps(filters: Noise, weights: Float[Array, " outputs"]) -> Float[np.ndarray, "..."]:
    """Noise filters of the weighted outputs, padded; few different lengths are compiled."""
    w = np.asarray(weights)
    if isinstance(filters, VectorAR):
        scale = np.outer(w, 1 / w)[..., None]
        return scale * filters.taps(32 * (filters.order // 32 + 1))
    longest = max((f.order for f in filters or ()), default=0)
    size = 32 * (longest // 32 + 1)
    white = ARFilter(np.zeros(0), 1.0)
    return np.stack([f.taps(size) for f in filters or [white] * len(w)])


def _mix(filters: Noise, weights: Float[Array, " outputs"]) -> Float[Array, "..."] | None:
    """The matrix that whitens the innovations of a vector filter; None for other filters."""
    if not isinstance(filters, VectorAR):
        return None
    w = np.asarray(weights)
    root = np.linalg.cholesky(filters.covariance * np.outer(w, w))
    return jnp.asarray(np.linalg.inv(root))


def _new_weights(
    point: Point, problem: Problem, first: Float[Array, " outputs"]
) -> Float[Array, " outputs"]:
    """Inverse of each output's residual deviation, which has a floor for noise-free recordings.

    The floor is relative to the signal: relative to the weights it would rise in each round.
    """
    residual, now = np.asarray(point.found.residual), np.asarray(problem.weights)
    # Rows in which a joint is at rest are zero and do not count.
    samples = np.maximum(np.count_nonzero(residual, axis=(0, 1)), 1)
    spread = np.sqrt(np.einsum("rko,rko->o", residual, residual) / samples) / now
    return jnp.asarray(1 / np.maximum(spread, _FLOOR / np.asarray(first)))


# Residuals below this share of a tenth of the signal are due to rounding.
_FLOOR = 1e-10


def finer_substeps(done: Converged, before: float = np.inf) -> tuple[int | None, float]:
    """A finer number of substeps, if halving the step moves the torque by more than 1e-4.

    None for a model that explains nothing: its values are meaningless, and may need any number.
    None also if the last refinement did not reduce the change: a user's law that rounds its
    readings rounds them differently, which causes a change that no step removes.

    **Arguments:**

    - `before`: relative change of the torque before the last refinement.

    **Returns:** the number, and the relative change of the torque; infinite if it is not known.
    """
    if not done.minimum.status.simulated or done.loop.stepping.control is not None:
        return None, np.inf
    if isinstance(done.loop.controller, OpenLoop) or _explains_nothing(done):
        return None, np.inf
    now = done.loop.stepping.substeps or 1
    if _at_its_sharpest(done):
        # A sign that changes at once has no step that is small enough.
        return (4 * now if 4 * now <= MANY else None), np.inf
    error = _moved(done, now, 2 * now)
    if not np.isfinite(error) or error <= _ACCURATE or error > _FELL * before:
        return None, error
    return refined(_enough(done, error), done.loop.name), error


def fewer_substeps(done: Converged, recordings: Recordings, error: float) -> int | None:
    """At most half as many substeps, if they move the torque by at most 1e-4; otherwise None.

    Start values may be stiffer than the optimum, and need more steps. Steps of a quarter of a time
    constant are also shorter than necessary if the time constant matters for short times only, as
    that of friction at reversals. Signs that are held may become sharper in later fits, for which
    stable steps would be too long.

    **Arguments:**

    - `error`: relative change of the torque if the steps are halved; infinite if it is not known.
    """
    stepping = done.loop.stepping
    simulated = done.minimum.status.simulated and not isinstance(done.loop.controller, OpenLoop)
    if not simulated or not stepping.settled or stepping.substeps is None or _at_its_sharpest(done):
        return None
    free, now = {p.place for p in done.loop.free_parameters}, stepping.substeps
    signs = {p.place for p in done.loop.parameters if p.place[-1] == "smoothing"}
    longest, least = ACCURATE, 1.0
    if error <= _ACCURATE and signs <= free:
        longest, least = HALF_STABLE, _enough(done, error)
    bare = set_substeps(done.loop, None)
    fewer = max(needed_substeps(bare, recordings, longest), least)
    if 2 * fewer > now:
        return None
    fewer = math.ceil(fewer)
    allowed = max(_ACCURATE, error if math.isfinite(error) else 0.0)
    return fewer if _moved(done, fewer, now) <= allowed else None


def _enough(done: Converged, error: float) -> float:
    """Substeps of which halving moves the torque by 1e-4, from that error at the present number."""
    now = done.loop.stepping.substeps or 1
    # A method of order p leaves 2⁻ᵖ of its error at half the step.
    power = 1.2 / (done.loop.stepping.solver.order(None) or 1)
    return now * (error / _ACCURATE) ** power + 1


def _moved(done: Converged, one: int, other: int) -> float:
    """Largest relative change of a joint's torque between two numbers of substeps."""
    batch = done.batch
    # Few recordings use the program that is already compiled; of many recordings, one is enough.
    if len(done.pieces) > 4:
        shortest = int(np.argmin([piece.samples for piece in done.pieces]))
        batch = taken(batch, np.array([shortest]))
    runs = [simulate_batch(set_substeps(done.loop, k), batch).tau for k in (one, other)]
    coarse, fine = map(batch.compared, runs)
    there = np.asarray(batch.kept)
    coarse, fine = np.asarray(coarse)[there], np.asarray(fine)[there]
    size = np.linalg.norm(fine, axis=0)
    return float(np.max(np.linalg.norm(coarse - fine, axis=0) / np.where(size > 0, size, 1.0)))


# Largest relative change of the torque by the length of the steps.
_ACCURATE = 1e-4
# Largest ratio of that change after a refinement to that before.
_FELL = 0.9


def residual_series(done: Converged) -> list[np.ndarray]:
    """Measured minus simulated, `(samples, outputs)` for each recording, in their own units."""
    raw = np.asarray(done.minimum.point.found.raw) / np.asarray(done.weights)
    mask = np.asarray(done.batch.kept)
    return [row[there] for row, there in zip(raw, mask, strict=True)]


def _explains_nothing(done: Converged) -> bool:
    """Whether every residual is larger than its signal."""
    batch = done.batch
    measured = {"tau": batch.tau, "q": batch.q}
    signals = [np.asarray(batch.compared(measured[name])) for name in done.signals]
    signal = np.concatenate(signals, axis=-1)[np.asarray(batch.kept)]
    rest = np.concatenate(residual_series(done))
    with np.errstate(over="ignore"):
        return bool(np.all(np.linalg.norm(rest, axis=0) > np.linalg.norm(signal, axis=0)))


def _at_its_sharpest(done: Converged) -> bool:
    """Whether a smoothing of a sign is at the smallest value that the steps resolve."""
    signs = _smoothings(done.loop)
    declared = np.asarray(Bounds.of(done.loop.free_parameters).lower)[signs]
    lower = np.asarray(done.problem.lower)[: len(signs)][signs]
    theta = np.asarray(done.loop.theta)[signs]
    return bool(np.any((lower > declared) & (theta <= 1.01 * lower)))


def from_best_starts(
    method: OutputErrorSettings, loop: ClosedLoop, recordings: Sequence[Recording], batch: Batch
) -> Batch:
    """The batch with the best initial states for the loop, if the method estimates them.

    The measured velocity is poor at the start of a recording in motion, or with a sensor error. A
    fit estimates the initial state, so a comparison with a fit must do the same.
    """
    signals, free = compared_signals(method, loop), estimated_starts(method, recordings, batch)
    if not free.any():
        return batch
    weights = jnp.asarray(first_weights(loop, tuple(recordings), signals))
    noise = jnp.asarray(_taps(None, weights))
    # Equal bounds keep the parameters at their values.
    at, own = loop.theta, jnp.asarray(free)
    problem = Problem(loop, batch, weights, noise, own, at, at, signals, True)
    start = jnp.concatenate([batch.q0, batch.v0], axis=1)
    found = minimise(problem, at, start, Stopping(method.tolerance, 1e-4, 20))
    best, n = found.point.start, loop.joints
    return dataclasses.replace(batch, q0=best[:, :n], v0=best[:, n:])
