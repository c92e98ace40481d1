"""The output-error method: simulate the closed loop, compare, follow the exact gradient."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ..control import OpenLoop, Reading
from ..display.progress import working
from ..errors import FitError, JaxidError
from ..noise import ARFilter, Noise, VectorAR
from ..parameters import Bounds
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..simulation.runs import (
    Batch,
    at_rest,
    compared,
    prepare,
    set_substeps,
    simulate,
    simulate_batch,
    with_substeps,
)
from ..simulation.sharing import taken
from .covariance import SAID, Deviations, Optimum, covariance_of
from .didim import DIDIM, physical
from .idim import IDIM
from .minimise.problem import Minimum, Problem, Sensitivity, minimise, reweighted
from .result import AbstractMethod, Fit, Status, relative_errors

Output = Literal["torque", "position", "both"]


class OEM(AbstractMethod):
    """Output error, equations (7) and (9) of Brunot et al. 2016, by Levenberg–Marquardt.

    All recordings at once, each output weighted by its own deviation, iterates kept physical.

    **Arguments:**

    - `output`: what is compared: `"torque"`, `"position"` or `"both"`; by default torque, but
      position where the recorded torque drives the arm.
    - `start`: `"auto"` takes the best of the loop's own values, IDIM's and, where those leave more
      than a fifth of the torque, DIDIM's; `"given"` starts from the loop's values.
    - `initial`: `"rest"` trusts the first sample, `"free"` estimates every initial state,
      `"auto"` estimates those of recordings that do not start at rest.
    - `window`: length in s of pieces simulated on their own, each from its own estimated state
      (multiple shooting); None for whole recordings.
    - `deviations`: `"sandwich"` for coloured residuals, `"white"` for (A.1), `"paper"` for what
      the paper prints.
    - `tolerance`: it stops when a step is shorter than this many standard deviations.
    - `max_steps`: largest number of iterations, those for better weights included.
    - `max_seconds`: longest time, looked at between iterations; what is found until then is given.
    - `progress`: whether to show it on a terminal.
    - `mesh`: a `jax.sharding.Mesh` whose devices share the recordings; the numbers stay the same.
    """

    output: Output | None = eqx.field(static=True, default=None)
    start: Literal["auto", "given"] = eqx.field(static=True, default="auto")
    initial: Literal["auto", "rest", "free"] = eqx.field(static=True, default="auto")
    window: float | None = eqx.field(static=True, default=None)
    deviations: Deviations = eqx.field(static=True, default="sandwich")
    tolerance: float = 1e-2
    max_steps: int = eqx.field(static=True, default=100)
    max_seconds: float = eqx.field(static=True, default=math.inf)
    progress: bool = eqx.field(static=True, default=True)
    mesh: Mesh | None = eqx.field(static=True, default=None)

    def __repr__(self) -> str:
        changed = [
            f"{field.name}={value!r}"
            for field in dataclasses.fields(self)
            if field.name not in ("progress", "mesh")
            and (value := getattr(self, field.name)) != field.default
        ]
        return f"OEM({', '.join(changed)})"

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the loop's free parameters; called by `jaxid.fit`."""
        started = time.perf_counter()
        # What does not fit together is said before the work, not after it.
        _signals(self, loop)
        prepare(loop, pieces_of(recordings, self.window))
        deadline = started + self.max_seconds
        with working(f"OEM of {loop.name}", self.progress) as say:
            done = self._from_start(loop, recordings, say, deadline)
            kept = recordings
            if done.minimum.status is Status.diverged:
                kept = _without_diverging(done.loop, recordings)
            if len(kept) < len(recordings):
                done = self._from_start(loop, kept, say, deadline)
            finer = _too_coarse(done)
            if finer is not None and time.perf_counter() < deadline:
                say(f"again with {finer} steps between samples")
                finer_loop = set_substeps(done.loop, finer, settled=True)
                done = _converge(
                    self, finer_loop, kept, say, deadline=deadline, weights=done.weights
                )
        found = _report(self, done, kept, time.perf_counter() - started)
        more = (*_left_out(recordings, kept), *self._forgotten(loop))
        return dataclasses.replace(found, notes=(*found.notes, *more))

    def _forgotten(self, loop: ClosedLoop) -> list[str]:
        """What to say of states that windows do not hand on; only positions and velocities are."""
        if self.window is None:
            return []
        zeros = jnp.zeros(loop.joints)
        own = [e.effect_name() for e in loop.effects if e.initial_state().size]
        law = loop.controller.initial_state(Reading(zeros, zeros))
        own += [type(loop.controller).__name__] if sum(x.size for x in jax.tree.leaves(law)) else []
        if not own:
            return []
        said = "every window begins with the states of {} at rest, by which values may be off"
        return [f"{said.format(', '.join(own))}: see whether they stay without window"]

    def _from_start(
        self,
        loop: ClosedLoop,
        recordings: Recordings,
        say: Callable[[str], None],
        deadline: float,
    ) -> "_Done":
        loop = start_values(loop, recordings, self.start, say)
        loop = with_substeps(loop, recordings)
        return _converge(self, loop, recordings, say, deadline=deadline)


def _without_diverging(loop: ClosedLoop, recordings: Recordings) -> Recordings:
    """The recordings along which the loop can be simulated; all of them where it cannot at all."""
    runs = simulate(loop, recordings)
    sound = [np.isfinite(run.states).all() and np.isfinite(run.tau).all() for run in runs]
    kept = [r for r, good in zip(recordings, sound, strict=True) if good]
    return Recordings.of(kept) if kept else recordings


def _left_out(recordings: Recordings, kept: Recordings) -> list[str]:
    gone = [name for name in recordings.names if name not in kept.names]
    if not gone:
        return []
    return [
        f"{len(gone)} of {len(recordings)} recordings left out, the loop diverges when it is "
        f"simulated along them: {', '.join(gone)}"
    ]


def start_values(
    loop: ClosedLoop, recordings: Recordings, start: str, say: Callable[[str], None]
) -> ClosedLoop:
    """The loop at the best start: its own values, IDIM's or DIDIM's, by simulated torque error.

    DIDIM is asked only where the others leave much of the torque. Parameters in which torque is
    not linear keep their values.
    """
    if start == "given":
        return loop
    say("start values by inverse dynamics")
    batch = prepare(loop, recordings)
    candidates, errors = [loop], [_simulated_error(loop, recordings, batch)]
    for method in (IDIM(), DIDIM(max_steps=4)):
        try:
            found = method.fit(candidates[-1], recordings)
        except (JaxidError, np.linalg.LinAlgError):
            continue
        if np.isfinite(found.theta).all():
            candidates.append(physical(loop, _linear_values(found)))
            errors.append(_simulated_error(candidates[-1], recordings, batch))
        if min(errors) < _NEAR:
            break
    if isinstance(loop.controller, OpenLoop):
        return candidates[-1]
    return candidates[int(np.argmin(errors))]


# Share of the squared torque, mean over the joints, from which on a fit needs no better start.
_NEAR = 0.2**2


def _linear_values(fit: Fit) -> Float[np.ndarray, " parameters"]:
    return np.asarray(fit.theta)


def _simulated_error(loop: ClosedLoop, recordings: Recordings, batch: Batch) -> float:
    """Mean over joints of the squared relative torque error of a simulation; infinite if it fails.

    An open loop has no torque to compare.
    """
    if isinstance(loop.controller, OpenLoop):
        return np.inf
    tau = simulate_batch(with_substeps(loop, recordings), batch).tau
    there = np.asarray(batch.mask)[..., None]
    measured, left = (np.where(there, x, 0.0) for x in (batch.tau, batch.tau - tau))
    if batch.band is not None:
        measured, left = batch.band(jnp.asarray(measured)), batch.band(jnp.asarray(left))
    error, size = (np.sum(np.asarray(x) ** 2, axis=(0, 1)) for x in (left, measured))
    total = float(np.mean(error / size))
    return total if np.isfinite(total) else np.inf


class _Done(eqx.Module):
    """A converged (or not) minimisation, with what is needed to report it."""

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
        """Where it ended, for whatever asks how sure that is."""
        point = self.minimum.point
        return Optimum(self.problem, point.theta, point.start)


def pieces_of(recordings: Recordings, window: float | None) -> tuple[Recording, ...]:
    """The recordings cut into windows that share their end samples; whole where None."""
    if window is None:
        return tuple(recordings)
    pieces = []
    for r in recordings:
        step = round(window * r.rate)
        if step < 8:
            raise FitError(
                f"a window of {window:g} s is only {step} samples of {r.name}: make it longer"
            )
        for first in range(0, r.samples - 2, step):
            last = min(first + step, r.samples - 1)
            if last - first >= 8:
                end = r.time[last + 1] if last + 1 < r.samples else None
                pieces.append(r.slice(float(r.time[first]), end if end is None else float(end)))
    if not pieces:
        raise FitError(f"a window of {window:g} s is shorter than a few samples: make it longer")
    return tuple(pieces)


def _signals(method: OEM, loop: ClosedLoop) -> tuple[str, ...]:
    output = method.output or ("position" if isinstance(loop.controller, OpenLoop) else "torque")
    if output != "position" and isinstance(loop.controller, OpenLoop):
        raise FitError(
            "the recorded torque drives this loop, so there is no torque to compare: use "
            "OEM(output='position')"
        )
    return {"torque": ("tau",), "position": ("q",), "both": ("tau", "q")}[output]


def _free_starts(
    method: OEM, pieces: Sequence[Recording], batch: Batch
) -> Float[np.ndarray, " recordings"]:
    if method.initial == "rest" or (method.initial == "auto" and batch.band is not None):
        return np.zeros(len(pieces))
    if method.initial == "free" or method.window is not None:
        return np.ones(len(pieces))
    return np.array([0.0 if at_rest(piece) else 1.0 for piece in pieces])


def oem_of(fit: object) -> OEM:
    """The output error that a fit's method is or builds on; that of defaults where it has none."""
    method = getattr(fit, "method", None)
    method = getattr(method, "oem", method)
    return method if isinstance(method, OEM) else OEM()


def from_best_starts(
    method: OEM, loop: ClosedLoop, recordings: Sequence[Recording], batch: Batch
) -> Batch:
    """The batch with initial states at which the loop does best, where the method estimates them.

    A recording that starts in motion, or that sensors which are off set in motion at once, tells
    its first velocity badly; a fit estimates it, and what is held against a fit must as well.
    """
    signals, free = _signals(method, loop), _free_starts(method, recordings, batch)
    if not free.any():
        return batch
    weights = jnp.asarray(_first_weights(loop, tuple(recordings), signals))
    noise = jnp.asarray(_taps(None, weights))
    # Parameters stay where they are: between bounds that leave them no room.
    at, own = loop.theta, jnp.asarray(free)
    problem = Problem(loop, batch, weights, noise, own, at, at, signals, True)
    start = jnp.concatenate([batch.q0, batch.v0], axis=1)
    found = minimise(problem, at, start, method.tolerance, 1e-4, 20, lambda _: None)
    best, n = found.point.start, loop.joints
    return dataclasses.replace(batch, q0=best[:, :n], v0=best[:, n:])


def _first_weights(
    loop: ClosedLoop, pieces: Sequence[Recording], signals: tuple[str, ...]
) -> Float[np.ndarray, " outputs"]:
    """One over a tenth of each output's size: the first guess, before residuals are known."""
    sizes = []
    for signal in signals:
        values = np.concatenate([getattr(piece, signal) for piece in pieces])
        sizes.append(np.std(values, axis=0))
    size = np.concatenate(sizes)
    return 10 / np.where(size > 0, size, 1.0)


def _converge(
    method: OEM,
    loop: ClosedLoop,
    recordings: Recordings,
    say: Callable[[str], None],
    filters: Noise = None,
    deadline: float = math.inf,
    weights: Float[Array, " outputs"] | None = None,
) -> _Done:
    """Minimises, then again with the weights and initial states that follow, until they settle.

    **Arguments:**

    - `filters`: noise filter of each output; white noise where None.
    - `deadline`: of `time.perf_counter`; past it, what there is is given.
    - `weights`: to begin with, if they are about known; filters know theirs.
    """
    pieces = pieces_of(recordings, method.window)
    signals = _signals(method, loop)
    batch = prepare(loop, pieces)
    free = jnp.asarray(_free_starts(method, pieces, batch))
    first = jnp.asarray(_first_weights(loop, pieces, signals))
    bounds = Bounds.of(loop.free_parameters)
    start = jnp.asarray(np.concatenate([batch.q0, batch.v0], axis=1))
    if weights is None and filters is not None:
        weights = _weights_of(filters, first)
    # The weight of a lone output is but its unit.
    alone = len(first) == 1
    # Until the weights are known, a rough minimum is enough.
    worth = 1e-4 if alone or weights is not None else 1e-2
    weights = first if weights is None else weights

    def posed(weights: Float[Array, " outputs"]) -> Problem:
        within = bounds.lower, bounds.upper
        noise = jnp.asarray(_taps(filters, weights))
        kinds = signals, bool(free.any()), method.mesh
        mix = _mix(filters, weights)
        return Problem(loop, batch, weights, noise, free, *within, *kinds, mix=mix)

    total, minimum, problem, ratio = 0, None, posed(weights), jnp.ones_like(first)
    for _ in range(20):
        left = method.max_steps - total
        known = None if minimum is None else reweighted(problem, minimum.point, ratio)
        minimum = minimise(
            problem, loop.theta, start, method.tolerance, worth, left, say, deadline, known
        )
        total += minimum.iterations
        if minimum.status is Status.diverged:
            break
        loop, start = loop.with_theta(minimum.point.theta), minimum.point.start
        new = _new_weights(minimum.point.found, batch, weights, first)
        # Estimates are flat in the weights: those that are a tenth off cost half a percent.
        floor = bool(np.all(np.asarray(new) > 0.99 / _FLOOR * np.asarray(first)))
        if minimum.status is Status.stalled and floor:
            # Only rounding is left, in which no step finds less.
            minimum = dataclasses.replace(minimum, status=Status.converged)
        settled = bool(np.all(np.abs(np.asarray(new) / np.asarray(weights) - 1) < 0.1))
        ended = total >= method.max_steps or minimum.status is Status.max_seconds
        if ended or (settled and worth < 1e-2):
            break
        ratio, weights, worth = new / weights, new, 1e-4 if settled else worth
        problem = posed(weights)
        if alone:
            there = reweighted(problem, minimum.point, ratio)
            minimum = dataclasses.replace(minimum, point=there)
            break
    assert minimum is not None
    return _Done(loop, pieces, batch, problem.weights, minimum, problem, signals, total)


def _weights_of(filters: Noise, first: Float[Array, " outputs"]) -> Float[Array, " outputs"]:
    """One over the deviation of what each filter leaves, with a floor of the signal's size."""
    if isinstance(filters, VectorAR):
        variance = np.diag(filters.covariance)
    else:
        variance = np.array([f.variance for f in filters or ()])
    return jnp.asarray(1 / np.maximum(np.sqrt(variance), _FLOOR / np.asarray(first)))


def _taps(filters: Noise, weights: Float[Array, " outputs"]) -> Float[np.ndarray, "..."]:
    """Noise filters of the weighted outputs, padded so that few lengths ever get compiled."""
    w = np.asarray(weights)
    if isinstance(filters, VectorAR):
        scale = np.outer(w, 1 / w)[..., None]
        return scale * filters.taps(32 * (filters.order // 32 + 1))
    longest = max((f.order for f in filters or ()), default=0)
    size = 32 * (longest // 32 + 1)
    white = ARFilter(np.zeros(0), 1.0)
    return np.stack([f.taps(size) for f in filters or [white] * len(w)])


def _mix(filters: Noise, weights: Float[Array, " outputs"]) -> Float[Array, "..."] | None:
    """What makes the innovations of a vector filter white; other filters' are taken for it."""
    if not isinstance(filters, VectorAR):
        return None
    w = np.asarray(weights)
    root = np.linalg.cholesky(filters.covariance * np.outer(w, w))
    return jnp.asarray(np.linalg.inv(root))


# Share of a tenth of a signal below which its residual is rounding.
_FLOOR = 1e-10


def _new_weights(
    found: Sensitivity,
    batch: Batch,
    weights: Float[Array, " outputs"],
    first: Float[Array, " outputs"],
) -> Float[Array, " outputs"]:
    """One over each output's residual deviation; recorded noise-free outputs keep a floor.

    The floor is of the signal's size: one of the present weights would rise from round to round.
    """
    residual, now = np.asarray(found.residual), np.asarray(weights)
    spread = np.sqrt(np.sum(residual**2, axis=(0, 1)) / np.sum(np.asarray(batch.kept))) / now
    return jnp.asarray(1 / np.maximum(spread, _FLOOR / np.asarray(first)))


def _too_coarse(done: _Done) -> int | None:
    """A finer number of substeps, if halving the step moves the torque by more than 1e-4."""
    if done.minimum.status is Status.diverged or done.loop.stepping.control is not None:
        return None
    if isinstance(done.loop.controller, OpenLoop):
        return None
    now, batch = done.loop.stepping.substeps or 1, done.batch
    # A few recordings fit the program that there is already; of many one says enough.
    if len(done.pieces) > 4:
        shortest = int(np.argmin([piece.samples for piece in done.pieces]))
        batch = taken(batch, np.array([shortest]))
    runs = [simulate_batch(set_substeps(done.loop, k), batch).tau for k in (now, 2 * now)]
    coarse, fine = (x if batch.band is None else batch.band(jnp.asarray(x)) for x in runs)
    there = np.asarray(batch.kept)
    coarse, fine = np.asarray(coarse)[there], np.asarray(fine)[there]
    size = np.linalg.norm(fine, axis=0)
    error = np.linalg.norm(coarse - fine, axis=0) / np.where(size > 0, size, 1.0)
    if not np.isfinite(error).all() or error.max() <= 1e-4:
        return None
    return min(64, int(np.ceil(now * (error.max() / 1e-4) ** 0.3)) + 1)


def _report(
    method: OEM,
    done: _Done,
    recordings: Recordings,
    seconds: float,
    shown: AbstractMethod | None = None,
    noise: Noise = None,
    rounds: int = 0,
) -> Fit:
    """The `Fit`; `shown` names a method that builds on this one, `noise` the filters it found."""
    found, mask = done.minimum.point.found, np.asarray(done.batch.kept)
    p = len(done.loop.names)
    covariance, lost, said = np.full((p, p), np.inf), (), ""
    if done.minimum.status is not Status.diverged:
        covariance, lost = covariance_of(done.optimum, method.deviations, noise, found)
        said = SAID[method.deviations]
    raw, weights = np.asarray(found.raw), np.asarray(done.weights)
    unweighted = [raw[k][mask[k]] / weights for k in range(len(done.pieces))]
    n = done.loop.joints
    measured = [getattr(piece, done.signals[0]) for piece in done.pieces]
    measured = compared(done.loop, done.pieces, measured)
    errors = [r[:, :n] for r in unweighted]
    measured, errors = _rejoin(recordings, done.pieces, measured, errors)
    return Fit(
        done.loop,
        recordings,
        shown or method,
        done.minimum.status,
        covariance,
        tuple(errors),
        relative_errors(recordings, measured, errors),
        done.iterations,
        0,
        seconds,
        said,
        lost,
        tuple(_at_bounds(done.loop)),
        noise if noise is None or isinstance(noise, VectorAR) else tuple(noise),
        rounds,
        done.optimum,
    )


def _rejoin(recordings, pieces, measured, errors):
    """Windows put together again by recording; a sample that two share is kept once."""
    if len(pieces) == len(recordings):
        return measured, errors

    def together(values, name):
        own = [x for x, piece in zip(values, pieces, strict=True) if piece.name == name]
        return np.concatenate([own[0], *(x[1:] for x in own[1:])])

    return [[together(values, r.name) for r in recordings] for values in (measured, errors)]


def _at_bounds(loop: ClosedLoop) -> list[str]:
    notes = []
    for p in loop.free_parameters:
        value = np.ravel(np.asarray(p.where(loop)))
        for bound, word in ((p.declaration.lower, "lower"), (p.declaration.upper, "upper")):
            if np.isfinite(bound) and np.any(np.abs(value - bound) < 1e-9 * p.declaration.scale):
                notes.append(f"{p.name} is at its {word} bound, {bound:g} {loop.unit(p)}")
    return notes
