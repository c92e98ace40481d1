"""Simulation of a loop along recordings, and its exact sensitivities."""

import dataclasses
import zlib
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ..control import Reading, Reference
from ..errors import JaxidError, ModelError, RecordingError
from ..recording import Recording, Recordings
from ..signals.smoothing import Band
from .loop import ClosedLoop, Instant, Outside, State, behind, instant, rest, settle
from .stepping import RK4, flow
from .unrolling import unrolled


class Interval(eqx.Module):
    """What drives the loop from one grid point to the next; the last interval has no length.

    `reference` holds the coefficients of the interval's cubic, `torque` those of a line; `noise`
    and `rate` are added to the position and velocity that the sensors read, `push` and `pull` to
    the torque on drives and links, each given at both ends and joined by a line, or None.
    """

    t0: Float[Array, ""]
    h: Float[Array, ""]
    tick: Bool[Array, ""]
    label: Int[Array, ""]
    reference: Float[Array, "4 joints"]
    torque: Float[Array, "2 joints"]
    noise: Float[Array, "2 joints"] | None = None
    rate: Float[Array, "2 joints"] | None = None
    push: Float[Array, "2 joints"] | None = None
    pull: Float[Array, "2 joints"] | None = None


class Batch(eqx.Module):
    """Recordings padded to one length, so that one `vmap` covers them.

    `intervals` has `(recordings, points)` before the axes of each leaf. `at` says which grid
    points are samples, `mask` which of those are there; the initial state is `q0`, `v0`; `q`,
    `tau` are the measured signals. `band` says which part of them the controller lets compare,
    None for all.
    """

    intervals: Interval
    at: Int[Array, "recordings samples"] | None
    mask: Bool[Array, "recordings samples"]
    q0: Float[Array, "recordings joints"]
    v0: Float[Array, "recordings joints"]
    time: Float[Array, "recordings samples"]
    q: Float[Array, "recordings samples joints"]
    tau: Float[Array, "recordings samples joints"]
    band: Band | None = None

    @property
    def kept(self) -> Bool[Array, "recordings samples"]:
        """Which samples are there and compared."""
        return self.mask if self.band is None else self.band.keep


class Simulated(eqx.Module):
    """Signals of one simulation at the samples, `(samples, joints)`, in SI units.

    `q` and `v` are what the sensors read, `tau` the commanded torque as it is recorded, `a` the
    acceleration of the drives and `delivered` their torque. `states` is the whole state,
    `(samples, states)`.
    """

    time: Float[Array | np.ndarray, "*batch samples"]
    q: Float[Array | np.ndarray, "*batch samples joints"]
    v: Float[Array | np.ndarray, "*batch samples joints"]
    a: Float[Array | np.ndarray, "*batch samples joints"]
    tau: Float[Array | np.ndarray, "*batch samples joints"]
    delivered: Float[Array | np.ndarray, "*batch samples joints"]
    states: Float[Array | np.ndarray, "*batch samples states"]


def recording_label(name: str) -> int:
    """The number by which effects know a recording of that name."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


# --- from recordings to a batch (host side, NumPy) ---------------------------------------------


def _pieces(
    time: np.ndarray, values: np.ndarray, at: np.ndarray, kind: str, order: int
) -> np.ndarray:
    """Taylor coefficients of an interpolant at the grid points, `(points, order + 1, joints)`."""
    beyond = np.append(time, time[-1] + 1.0)
    if kind == "cubic" and order == 3:
        spline = scipy.interpolate.CubicSpline(time, values)
    else:
        slope = np.zeros_like(values)
        if kind != "hold":
            slope[:-1] = np.diff(values, axis=0) / np.diff(time)[:, None]
        spline = scipy.interpolate.PPoly(np.stack([slope, values]), beyond)
    factorial = (1.0, 1.0, 2.0, 6.0)
    return np.stack([spline(at, nu) / factorial[nu] for nu in range(order + 1)], axis=1)


def _grid(recording: Recording, period: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Grid times and which of them are ticks: the samples, and the controller's own instants."""
    time = recording.time
    if period is None:
        grid = _without_gaps(time, recording.period)
        return grid, np.zeros(len(grid), bool)
    ticks = time[0] + period * np.arange(int((time[-1] - time[0]) / period + 1e-6) + 1)
    # Instants closer than a thousandth of a period are the same: clocks are written in decimals.
    near = time[np.clip(np.searchsorted(time, ticks - 1e-3 * period), 0, len(time) - 1)]
    ticks = np.where(np.abs(near - ticks) < 1e-3 * period, near, ticks)
    grid = np.union1d(time, ticks)
    return grid, np.isin(grid, ticks)


def _without_gaps(
    time: Float[np.ndarray, " samples"], period: float
) -> Float[np.ndarray, " points"]:
    """The samples, and evenly between them where they are further apart than usual."""
    parts = np.maximum(np.round(np.diff(time) / period - 0.25), 1).astype(int)
    if parts.max() == 1:
        return time
    first = np.repeat(time[:-1], parts)
    step = np.repeat(np.diff(time) / parts, parts)
    number = np.arange(len(first)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(first + number * step, time[-1])


def _drive(
    loop: ClosedLoop,
    recording: Recording,
    points: tuple[np.ndarray, np.ndarray],
    length: int,
    noise: np.ndarray | None,
) -> tuple[np.ndarray | None, ...]:
    """The fields of the intervals of one recording, each with `length` points."""
    grid, ticks = points
    signals = loop.controller.signals(recording)
    kind = loop.stepping.interpolation
    pad = length - len(grid)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[-1:], pad, axis=0)])

    ends = rate = None
    if noise is not None:
        lines = padded(_pieces(recording.time, noise, grid, "linear", 1))
        ends = np.stack([lines[:, 0], np.append(lines[1:, 0], lines[-1:, 0], axis=0)], axis=1)
        rate = np.stack([lines[:, 1], lines[:, 1]], axis=1)
    return (
        padded(grid),
        np.append(np.diff(grid), np.zeros(pad + 1)),
        np.append(ticks, np.zeros(pad, bool)),
        np.full(length, recording_label(recording.name)),
        padded(_pieces(recording.time, signals.q, grid, kind, 3)),
        padded(_pieces(recording.time, signals.tau, grid, "linear", 1)),
        ends,
        rate,
    )


def start_of(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at the first sample, `(joints,)`: a parabola through the first ten."""
    few = min(10, recording.samples)
    t = recording.time[:few] - recording.time[0]
    _, slope, level = np.polyfit(t, recording.q[:few], 2)
    return (level, slope) if recording.v is None else (level, recording.v[:3].mean(axis=0))


def at_rest(recording: Recording) -> bool:
    """Whether the arm starts with less than a hundredth of its highest speed."""
    _, start = start_of(recording)
    step = min(10, recording.samples - 1)
    speed = (recording.q[step:] - recording.q[:-step]) / (
        recording.time[step:] - recording.time[:-step]
    )[:, None]
    return bool(np.all(np.abs(start) < 1e-2 * np.abs(speed).max(axis=0)))


def check_joints(loop: ClosedLoop, recording: Recording) -> None:
    """Raises `RecordingError` where a recording has other joints than the loop."""
    if recording.joints != loop.joints:
        raise RecordingError(
            f"{recording.name} has {recording.joints} joints, but the robot {loop.name} has "
            f"{loop.joints}: choose another robot, or name the columns of its joints"
        )


def check_law(loop: ClosedLoop) -> None:
    """Raises `ModelError` where a controller's gains are those of other joints than the arm's."""
    n = loop.joints

    def command(zeros):
        reading = Reading(zeros, zeros)
        reference = Reference(zeros, zeros, zeros, zeros)
        law = loop.controller
        return law.command(reading, reference, law.initial_state(reading), jnp.outer(zeros, zeros))

    who = f"{type(loop.controller).__name__} of {loop.name}"
    try:
        shape = jax.eval_shape(command, jnp.zeros(n)).shape
    except JaxidError:
        raise
    except (TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ModelError(f"{who} has no torque for {n} joints, give all gains: {reason}") from error
    if shape != (n,):
        raise ModelError(f"{who} commands torques of shape {shape}, where there are {n} joints")


def _check_noise(noise: Sequence[np.ndarray], recordings: Recordings | Sequence[Recording]) -> None:
    if len(noise) != len(recordings):
        raise RecordingError(f"noise is given for {len(noise)} of {len(recordings)} recordings")
    for k, recording in enumerate(recordings):
        if np.shape(noise[k]) != recording.q.shape:
            raise RecordingError(
                f"noise of shape {np.shape(noise[k])} is given for {recording.name}, whose "
                f"positions have {recording.q.shape}"
            )


def prepare(
    loop: ClosedLoop,
    recordings: Recordings | Sequence[Recording],
    noise: Sequence[np.ndarray] | None = None,
) -> Batch:
    """Recordings as one batch for a loop.

    **Arguments:**

    - `loop`: which controller, and how to interpolate.
    - `recordings`: with as many joints as the loop.
    - `noise`: added to what the sensors read, `(samples, joints)` for each recording.

    **Raises:** `RecordingError` where the joints do not match, `ModelError` from the controller.
    """
    check_joints(loop, recordings[0])
    if noise is not None:
        _check_noise(noise, recordings)
    period = loop.controller.period
    grids = [_grid(r, period) for r in recordings]
    length = max(len(grid) for grid, _ in grids)
    samples = max(r.samples for r in recordings)
    noises = [None] * len(recordings) if noise is None else list(noise)
    rows = [
        _drive(loop, r, g, length, e) for r, g, e in zip(recordings, grids, noises, strict=True)
    ]
    fields = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    # The structure is that of one interval; the values are where they belong already.
    one = Interval(*jax.device_put(jax.tree.map(lambda leaf: leaf[0, 0], fields)))
    leaves = jax.tree.leaves(jax.device_put(fields))
    intervals = jax.tree.unflatten(jax.tree.structure(one), leaves)
    on_grid = all(len(grid) == r.samples for r, (grid, _) in zip(recordings, grids, strict=True))
    starts = [(r.q[0], np.zeros(loop.joints)) if at_rest(r) else start_of(r) for r in recordings]
    band = band_of(loop, recordings)
    if band is not None:
        starts = list(np.asarray(intervals.reference[:, 0, :2]))

    def stack(pick) -> Array:
        pieces = [pick(k, r) for k, r in enumerate(recordings)]
        pads = [np.repeat(p[-1:], samples - len(p), axis=0) for p in pieces]
        return jax.device_put(
            np.stack([np.concatenate(both) for both in zip(pieces, pads, strict=True)])
        )

    return Batch(
        intervals,
        None if on_grid else stack(lambda k, r: np.searchsorted(grids[k][0], r.time)),
        jax.device_put(np.arange(samples) < np.array([[r.samples] for r in recordings])),
        jax.device_put(np.stack([q for q, _ in starts])),
        jax.device_put(np.stack([v for _, v in starts])),
        stack(lambda k, r: r.time),
        stack(lambda k, r: r.q),
        stack(lambda k, r: r.tau),
        band,
    )


def band_of(loop: ClosedLoop, recordings: Recordings | Sequence[Recording]) -> Band | None:
    """The part of the recordings' signals that the controller lets compare; None for all."""
    cutoffs = [loop.controller.comparable(r) for r in recordings]
    given = [c for c in cutoffs if c is not None]
    if len(given) < len(cutoffs):
        return None
    return Band.of(list(recordings), given, max(r.samples for r in recordings))


def compared(
    loop: ClosedLoop,
    recordings: Recordings | Sequence[Recording],
    signals: Sequence[Float[np.ndarray, "_samples joints"]],
) -> list[Float[np.ndarray, "_samples joints"]]:
    """What of signals the controller lets compare, `(samples, joints)` for each recording.

    **Arguments:**

    - `signals`: one for each recording, `(samples, joints)`.
    """
    band = band_of(loop, recordings)
    if band is None:
        return list(signals)
    longest = band.keep.shape[1]
    padded = np.stack([np.pad(x, ((0, longest - len(x)), (0, 0))) for x in signals])
    passed, keep = np.asarray(band(jnp.asarray(padded))), np.asarray(band.keep)
    return [x[kept] for x, kept in zip(passed, keep, strict=True)]


# --- one interval -------------------------------------------------------------------------------


def _line(ends: Float[Array, "2 joints"] | None, dt, h, joints: int) -> Float[Array, " joints"]:
    """A line between its two ends, after a time from the first."""
    if ends is None:
        return jnp.zeros(joints)
    return ends[0] + dt * (ends[1] - ends[0]) / jnp.where(h > 0, h, 1.0)


def _reference(interval: Interval, dt: Float[Array, ""]) -> Reference:
    c0, c1, c2, c3 = interval.reference
    q = c0 + dt * (c1 + dt * (c2 + dt * c3))
    v = c1 + dt * (2 * c2 + 3 * dt * c3)
    a = 2 * c2 + 6 * dt * c3
    return Reference(q, v, a, interval.torque[0] + dt * interval.torque[1])


def _instant_at(loop: ClosedLoop, interval: Interval, t: Float[Array, ""], state: State) -> Instant:
    dt = t - interval.t0
    noise, rate, push, pull = (
        _line(ends, dt, interval.h, loop.joints)
        for ends in (interval.noise, interval.rate, interval.push, interval.pull)
    )
    outside = Outside(push, pull, Reading(noise, rate))
    return instant(loop, t, state, _reference(interval, dt), outside, interval.label)


def unflatten(loop: ClosedLoop) -> Callable[[Float[Array, " states"]], State]:
    """The function that makes a state of a flat vector, `(states,)`."""
    zeros = jnp.zeros(loop.joints)
    return ravel_pytree(rest(loop, zeros, zeros))[1]


def initial(
    loop: ClosedLoop,
    intervals: Interval,
    q: Float[Array, " joints"],
    v: Float[Array, " joints"],
) -> Float[Array, " states"]:
    """The flat state at the start of a run, `(states,)`, at measured position and velocity."""
    first = jax.tree.map(lambda leaf: leaf[0], intervals)
    reference = _reference(first, jnp.zeros(()))
    start = rest(loop, *behind(loop, q, v))
    return ravel_pytree(settle(loop, first.t0, start, reference, first.label))[0]


Scalars = tuple[Float[Array, ""], ...]


def advance(
    loop: ClosedLoop, interval: Interval, x: Float[Array, " states"]
) -> tuple[Float[Array, " states"], Float[Array, "5 joints"]]:
    """One interval: the state at its end, and what is to be seen at its start.

    **Arguments:**

    - `interval`: what drives the loop.
    - `x`: the state at its start, flat, `(states,)`.

    **Returns:** the state, `(states,)`, and the rows of `SIGNALS`, `(5, joints)`.
    """
    after, _, seen = _advance(loop, interval, tuple(x), tuple(range(5)))
    return jnp.stack(after), seen


def _advance(
    loop: ClosedLoop,
    interval: Interval,
    y: Scalars,
    rows: tuple[int, ...],
    substeps: Int[Array, ""] | None = None,
) -> tuple[Scalars, Scalars, Float[Array, "rows joints"]]:
    """The states at an interval's end and start, and signals at its start, state by state."""
    unravel = unflatten(loop)

    def begin(interval: Interval, y: Scalars):
        state = unravel(jnp.stack(y))
        if loop.controller.period is not None:
            now = _instant_at(loop, interval, interval.t0, state)
            asked = _reference(interval, jnp.zeros(()))
            ticked = loop.controller.tick(now.reading, asked, state.controller)
            held = jnp.where(interval.tick, ticked, state.controller)
            state = State(state.q, state.v, state.effects, held)
        now = _instant_at(loop, interval, interval.t0, state)
        seen = (now.command, now.reading.q, now.reading.v, now.a, now.tau)
        return tuple(ravel_pytree(state)[0]), jnp.stack([seen[row] for row in rows])

    def rate(t: Float[Array, ""], y: Scalars) -> Scalars:
        derivative = _instant_at(loop, interval, t, unravel(jnp.stack(y))).derivative
        return tuple(ravel_pytree(derivative)[0])

    held, seen = unrolled(begin, interval, y)(interval, y)
    written = unrolled(rate, interval.t0, y)
    if isinstance(loop.stepping.solver, RK4) and loop.stepping.control is None:
        plain = lambda t, y, _: written(t, y)  # noqa: E731
        after = flow(loop.stepping, plain, interval.t0, interval.h, held, substeps)
        return after, y, seen
    # Implicit methods and step control think of the state as one vector.
    after = flow(
        loop.stepping,
        lambda t, x, _: jnp.stack(written(t, tuple(x))),
        interval.t0,
        interval.h,
        jnp.stack(held),
        substeps,
    )
    return tuple(after), y, seen


# --- whole runs ---------------------------------------------------------------------------------

SIGNALS = ("tau", "q", "v", "a", "delivered")


def run(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    substeps: Int[Array, ""] | None = None,
) -> tuple[Float[Array, "points states"], Float[Array, "points 5 joints"]]:
    """One run from a flat initial state: states and signals at every grid point.

    `substeps` is for programs that serve any number of them; None for the loop's own.
    """

    def body(y, interval):
        after, before, seen = _advance(loop, interval, y, tuple(range(5)), substeps)
        return after, (jnp.stack(before), seen)

    return jax.lax.scan(body, tuple(x0), intervals)[1]


def run_with_sensitivities(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    start: Float[Array, "states columns"],
    rows: tuple[int, ...],
) -> tuple[Float[Array, "points rows joints"], Float[Array, "points rows joints columns"]]:
    """One run, and the exact derivative of its signals by the loop's free parameters.

    All tangents go through the run together, each stage of each step for all at once.

    **Arguments:**

    - `intervals`, `x0`: as in `run`.
    - `start`: derivative of `x0` by the parameters, and by whatever columns come after them,
      `(states, columns)`.
    - `rows`: which of `SIGNALS`.
    """
    theta, loop = loop.theta, with_rolled_stages(loop)
    p, columns = theta.shape[0], start.shape[1]

    def shown(theta, x0):
        changed = loop.with_theta(theta)

        def body(y, interval):
            after, _, seen = _advance(changed, interval, y, rows)
            return after, seen

        return jax.lax.scan(body, tuple(x0), intervals)[1]

    def along(d_theta, d_start):
        return jax.jvp(shown, (theta, x0), (d_theta, d_start))

    return jax.vmap(along, in_axes=1, out_axes=(None, -1))(jnp.eye(p, columns), start)


def each(fun: Callable, *args):
    """The function of every recording: one after the other on a CPU, together on an accelerator.

    One recording's states stay in a core's registers and first cache; a batch's do not.

    **Arguments:**

    - `args`: pytrees with `(recordings,)` before the axes of each leaf.
    """
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda one: fun(*one), args)
    return jax.vmap(fun)(*args)


@eqx.filter_jit
def _simulate(loop: ClosedLoop, batch: Batch, substeps: Int[Array, ""] | None) -> Simulated:
    def one(intervals, at, q0, v0, time):
        states, seen = run(loop, intervals, initial(loop, intervals, q0, v0), substeps)
        if at is not None:
            states, seen = states[at], seen[at]
        tau, q, v, a, delivered = jnp.moveaxis(seen, 1, 0)
        return Simulated(time, q, v, a, tau, delivered, states)

    return each(one, batch.intervals, batch.at, batch.q0, batch.v0, batch.time)


def simulate(
    loop: ClosedLoop,
    recordings: Recording | Recordings | Sequence[Recording],
    *,
    noise: Sequence[np.ndarray] | None = None,
) -> tuple[Simulated, ...]:
    """Simulates the loop along recordings: their references, their initial states.

    **Arguments:**

    - `loop`: the model.
    - `recordings`: where references and initial states come from.
    - `noise`: added to what the sensors read, `(samples, joints)` for each recording; it goes
      round the loop.

    **Returns:** one `Simulated` for each recording.

    **Raises:** `RecordingError` or `ModelError` where the two do not fit together.
    """
    recordings = Recordings.of(recordings)
    batch = prepare(loop, recordings, noise)
    check_law(loop)
    return by_recording(simulate_batch(with_substeps(loop, recordings), batch), recordings)


def by_recording(
    together: Simulated, recordings: Recordings | Sequence[Recording]
) -> tuple[Simulated, ...]:
    """The runs of a batch, `(recordings, samples, ...)`, one by one with their own samples."""
    return tuple(
        jax.tree.map(lambda leaf, k=k, r=r: leaf[k, : r.samples], together)
        for k, r in enumerate(recordings)
    )


def simulate_batch(loop: ClosedLoop, batch: Batch) -> Simulated:
    """Simulates the loop along a batch; leaves have `(recordings, samples)` first, padded."""
    substeps = None
    if loop.stepping.control is None:
        # One program for any number of steps: refining them need not compile again.
        substeps = jnp.asarray(loop.stepping.substeps or 1)
        loop = set_substeps(loop, None, settled=False)
    return jax.device_get(_simulate(loop, batch, substeps))


def with_substeps(loop: ClosedLoop, recordings: Recordings) -> ClosedLoop:
    """The loop with the number of steps between samples settled, where the user left it open.

    A step is at most 2.5 ms, and at most a quarter of the fastest time constant, met with friction
    at its steepest, at standstill; and no step is so long that a bristle at speed runs away. A
    number settled before grows where an effect with states of its own, added since, would.
    """
    check_joints(loop, recordings[0])
    before, settled = loop.stepping.substeps, loop.stepping.settled
    if before is not None and not (settled and _has_states(loop)):
        return loop
    period = loop.controller.period
    longest = max(r.period for r in recordings)
    interval = longest if period is None else min(longest, period)
    still, moving = _rates(loop, recordings)
    if before is None:
        # The torque of a stiff made-up law is wrong by about (pace · step)⁴ / 20.
        pace = 7 * loop.controller.pace
        rate = max(1 / 2.5e-3, still / 0.25, moving / 2, pace)
    else:
        rate = max(before / interval, still / 2, moving / 2)
    return set_substeps(loop, int(np.clip(np.ceil(interval * rate - 1e-9), 1, 64)), settled=True)


def set_substeps(loop: ClosedLoop, substeps: int | None, settled: bool = False) -> ClosedLoop:
    """The loop with that many steps between two grid points.

    **Arguments:**

    - `settled`: whether it is jaxid that has chosen them.
    """
    stepping = dataclasses.replace(loop.stepping, substeps=substeps, settled=settled)
    return dataclasses.replace(loop, stepping=stepping)


def _has_states(loop: ClosedLoop) -> bool:
    return any(effect.initial_state().size for effect in loop.effects)


def with_rolled_stages(loop: ClosedLoop) -> ClosedLoop:
    """The loop with the stages of its steps in a loop: for derivatives, and for many settings.

    Written out, as a lone simulation likes them best, four stages of all tangents are more than
    the registers and first cache of a core hold: half as fast, and longer to compile.
    """
    solver = loop.stepping.solver
    if not isinstance(solver, RK4):
        return loop
    rolled = dataclasses.replace(solver, rolled=True)
    stepping = dataclasses.replace(loop.stepping, solver=rolled)
    return dataclasses.replace(loop, stepping=stepping)


def fastest_rate(loop: ClosedLoop, recordings: Recordings) -> float:
    """Largest eigenvalue of the loop's equations at standstill along the recordings, 1/s."""
    return _rates(loop, recordings)[0]


def _rates(loop: ClosedLoop, recordings: Recordings) -> tuple[float, float]:
    """Largest eigenvalues at standstill, and as fast as recordings get over ten samples, 1/s."""
    still = np.concatenate([r.q[:: max(1, r.samples // 8)] for r in recordings])
    q, v = [], []
    for r in recordings:
        span = min(10, r.samples - 1)
        speed = (r.q[span:] - r.q[:-span]) / (r.time[span:] - r.time[:-span])[:, None]
        fastest = np.abs(speed).argmax(axis=0)
        q.append(r.q[fastest])
        v.append(speed[fastest])
    speed = np.concatenate([np.zeros_like(still), *v])
    slopes = np.asarray(_slopes(loop, *jax.device_put((np.concatenate([still, *q]), speed))))
    return _largest(slopes[: len(still)]), _largest(slopes[len(still) :])


@eqx.filter_jit
def _slopes(
    loop: ClosedLoop, q: Float[Array, "points joints"], v: Float[Array, "points joints"]
) -> Float[Array, "points n n"]:
    zeros = jnp.zeros(loop.joints)

    def rate(x, at, speed):
        reference = Reference(at, speed, zeros, zeros)
        state = unflatten(loop)(x)
        outside = Outside(zeros, zeros, Reading(zeros, zeros))
        now = instant(loop, jnp.zeros(()), state, reference, outside, jnp.asarray(NOBODY))
        return ravel_pytree(now.derivative)[0]

    def slope(at, speed):
        return jax.jacfwd(rate)(ravel_pytree(rest(loop, at, speed))[0], at, speed)

    return jax.vmap(slope)(q, v)


def _largest(slopes: Float[np.ndarray, "points n n"]) -> float:
    """Largest magnitude of an eigenvalue; zero where no slope is finite."""
    usable = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    return float(np.abs(np.linalg.eigvals(usable)).max()) if len(usable) else 0.0


# Of no recording: effects that act on some by name do not act.
NOBODY = 0
