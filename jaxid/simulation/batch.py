"""Recordings as a batch of intervals that drive a loop, built on the host with NumPy."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..control import AbstractController
from ..effects import recording_label
from ..errors import RecordingError
from ..recording import Recording, Recordings
from ..signals.smoothing import Band, shared_length, signal_cutoff
from .checks import check_joints, check_law
from .compared import compared_part
from .integrals import Along, integral_states, integrals_at_start
from .loop import ClosedLoop


class Interval(eqx.Module):
    """Inputs of the loop from one grid point to the next; the last interval has zero length.

    `reference` has the coefficients of the interval's cubic, `torque` those of a line. `held` has
    the signals that are constant in the interval, by name, `(joints,)` each. `noise` and `rate` are
    added to the position and velocity that the sensors read, `push` and `pull` to the torque on
    drives and links. Each of the four is given at both ends and is linear in between, or is None.
    `integrals` is added to the law's states at the start of the recording, or is None.
    """

    t0: Float[Array, ""]
    h: Float[Array, ""]
    tick: Bool[Array, ""]
    label: Int[Array, ""]
    reference: Float[Array, "4 joints"]
    torque: Float[Array, "2 joints"]
    held: dict[str, Float[Array, " joints"]]
    noise: Float[Array, "2 joints"] | None = None
    rate: Float[Array, "2 joints"] | None = None
    push: Float[Array, "2 joints"] | None = None
    pull: Float[Array, "2 joints"] | None = None
    integrals: Float[Array, " states"] | None = None


class Batch(eqx.Module):
    """Recordings padded to one length, for a common `vmap`.

    `intervals` has `(recordings, points)` before the axes of each leaf. `at` gives the grid points
    that are samples; `mask` is false for padding. The initial state is `q0`, `v0`; `q` and `tau`
    are the measured signals. `band` is the part of the signals that is compared under this
    controller, and `moving` the compared rows in which a joint moves; None for all.
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
    moving: Bool[Array, "recordings rows joints"] | None = None

    @property
    def kept(self) -> Bool[Array, "recordings rows"]:
        """Which of the compared rows are not padding."""
        return self.mask if self.band is None else self.band.keep

    def compared(
        self, x: Float[Any, "recordings samples *axes"], ahead: Float[Array, ""] | None = None
    ) -> Float[Any, "recordings rows *axes"]:
        """The part of signals at the samples that is compared.

        Missing samples, and rows in which a joint stands still, are zero.

        **Arguments:**

        - `ahead`: the controller's delay for simulated signals; None for measured ones.
        """
        return compared_part(self.band, self.moving, jnp.asarray(x), ahead)

    def uncompared(self) -> "Batch":
        """The batch for a simulation: what is compared would only make programs differ."""
        return dataclasses.replace(self, band=None, moving=None)


def _pieces(
    time: np.ndarray, values: np.ndarray, at: np.ndarray, kind: str, order: int
) -> np.ndarray:
    """Taylor coefficients of an interpolant at the grid points, `(points, order + 1, joints)`."""
    import scipy

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
    """Grid times (the samples and the controller's own ticks), and which of them are ticks."""
    time = recording.time
    if period is None:
        grid = _without_gaps(time, recording.period)
        return grid, np.zeros(len(grid), bool)
    ticks = time[0] + period * np.arange(int((time[-1] - time[0]) / period + 1e-6) + 1)
    # Times closer than a thousandth of a period are equal, because files round times.
    near = time[np.clip(np.searchsorted(time, ticks - 1e-3 * period), 0, len(time) - 1)]
    ticks = np.where(np.abs(near - ticks) < 1e-3 * period, near, ticks)
    grid = np.union1d(time, ticks)
    return grid, np.isin(grid, ticks)


def _without_gaps(
    time: Float[np.ndarray, " samples"], period: float
) -> Float[np.ndarray, " points"]:
    """The samples, with evenly spaced points added in gaps."""
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
    held: tuple[str, ...],
) -> tuple[Any, ...]:
    """The fields of the intervals of one recording, each padded to `length` points."""
    grid, ticks = points
    signals = loop.controller.signals(recording)
    kind, torque_kind = loop.stepping.interpolation, "linear"
    if signals.hold:
        kind = torque_kind = "hold"
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
        padded(_pieces(recording.time, signals.tau, grid, torque_kind, 1)),
        {name: padded(x) for name, x in held_at(recording, grid, held).items()},
        ends,
        rate,
    )


def reference_at(
    loop: ClosedLoop, recording: Recording, q: Float[np.ndarray, "samples joints"]
) -> Float[np.ndarray, "points 4 joints"]:
    """The cubics of a reference in the intervals of a recording, before padding.

    **Arguments:**

    - `q`: the reference at the samples, rad or m.
    """
    grid, _ = _grid(recording, loop.controller.period)
    return _pieces(recording.time, q, grid, loop.stepping.interpolation, 3)


def held_names(recordings: Recordings | Sequence[Recording]) -> tuple[str, ...]:
    """Names of the signals that are constant from sample to sample, over all recordings.

    Drives of recordings without `on` count as powered.

    **Raises:** `RecordingError` if one recording lacks a signal that another has.
    """
    names = tuple(dict.fromkeys(n for r in recordings for n in r.held_names))
    for r in recordings:
        absent = [n for n in names if n not in r.held_names and n != "on"]
        if absent:
            raise RecordingError(
                f"{r.name} has no {absent[0]}, which other recordings have: name its column, or "
                f"give one number for the recording, Recording.from_arrays(..., {absent[0]}=...)"
            )
    return names


def held_at(
    recording: Recording, time: Float[np.ndarray, " times"], names: tuple[str, ...]
) -> dict[str, Float[np.ndarray, "times joints"]]:
    """Signals that are constant from sample to sample, at any times; drives are powered by default.

    **Arguments:**

    - `names`: as returned by `held_names`.
    """
    found = recording.held_at(time)
    powered = np.ones((len(time), recording.joints))
    return {name: found.get(name, powered) for name in names}


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


def _check_noise(noise: Sequence[np.ndarray], recordings: Recordings | Sequence[Recording]) -> None:
    if len(noise) != len(recordings):
        raise RecordingError(f"noise is given for {len(noise)} of {len(recordings)} recordings")
    for k, recording in enumerate(recordings):
        if np.shape(noise[k]) != recording.q.shape:
            raise RecordingError(
                f"the noise for {recording.name} has shape {np.shape(noise[k])}, but its "
                f"positions have {recording.q.shape}"
            )


def prepare(
    loop: ClosedLoop,
    recordings: Recordings | Sequence[Recording],
    noise: Sequence[np.ndarray] | None = None,
) -> Batch:
    """Recordings as one batch for a loop.

    **Arguments:**

    - `loop`: gives the controller and the interpolation.
    - `recordings`: with as many joints as the loop.
    - `noise`: added to the sensor readings, `(samples, joints)` for each recording.

    **Raises:** `RecordingError` if the joints do not match, `ModelError` from the controller.
    """
    check_joints(loop, recordings[0])
    check_law(loop)
    if noise is not None:
        _check_noise(noise, recordings)
    period = loop.controller.period
    grids = [_grid(r, period) for r in recordings]
    length = shared_length(max(len(grid) for grid, _ in grids))
    samples = shared_length(max(r.samples for r in recordings))
    noises = [None] * len(recordings) if noise is None else list(noise)
    held = held_names(recordings)
    rows = [
        _drive(loop, r, g, length, e, held)
        for r, g, e in zip(recordings, grids, noises, strict=True)
    ]
    own = integral_states(loop)
    if own.any():
        rows = _with_integrals(loop, own, recordings, grids, rows)
    fields = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    # The structure is that of one interval; the values are already in place.
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
        moving_of(loop, recordings, band),
    )


def _with_integrals(
    loop: ClosedLoop,
    own: Bool[np.ndarray, " states"],
    recordings: Recordings | Sequence[Recording],
    grids: Sequence[tuple[np.ndarray, np.ndarray]],
    rows: Sequence[tuple[Any, ...]],
) -> list[tuple[Any, ...]]:
    """The fields of `_drive` with the states that the law's integrals `own` have at the start."""
    along = []
    for recording, (grid, tick), row in zip(recordings, grids, rows, strict=True):
        _, _, _, _, cubics, lines, signals, *_ = row
        c0, c1, c2, _ = np.moveaxis(cubics[: len(grid)], 1, 0)
        reference = np.stack([c0, c1, 2 * c2, lines[: len(grid), 0]], axis=1)
        held = {name: x[: len(grid)] for name, x in signals.items()}
        along.append(Along.of(recording, grid, tick, reference, held))
    states = integrals_at_start(loop, own, along)
    return [
        (*row, None, None, np.tile(state, (len(row[0]), 1)))
        for row, state in zip(rows, states, strict=True)
    ]


def band_of(loop: ClosedLoop, recordings: Recordings | Sequence[Recording]) -> Band | None:
    """The part of the recordings' signals that is compared under the controller; None for all."""
    cutoffs = [loop.controller.comparable(r) for r in recordings]
    given = [c for c in cutoffs if c is not None]
    if len(given) < len(cutoffs):
        return None
    longest = shared_length(max(r.samples for r in recordings))
    return Band.of(list(recordings), given, longest)


def motion_cutoff(law: AbstractController, recordings: Recordings | Sequence[Recording]) -> float:
    """The frequency up to which the motion of all recordings is known, Hz."""
    given = [law.comparable(r) for r in recordings]
    known = [c for c in given if c is not None]
    return min(known) if known else signal_cutoff(*recordings)


def moving_of(
    loop: ClosedLoop, recordings: Recordings | Sequence[Recording], band: Band | None
) -> Bool[Array, "recordings rows joints"] | None:
    """The compared rows in which each joint moves; None for all.

    **Arguments:**

    - `band`: as returned by `band_of`.
    """
    law = loop.controller
    standstill = loop.standstill.settled(loop.joints, law.imposes)
    if not np.any(np.asarray(standstill.still) > 0):
        return None
    cutoff = motion_cutoff(law, recordings)
    rows = [standstill.moving(r, cutoff) for r in recordings]
    if band is None:
        longest = shared_length(max(r.samples for r in recordings))
        padded = [np.pad(m, ((0, longest - len(m)), (0, 0))) for m in rows]
        return jax.device_put(np.stack(padded))
    picked = [m[row] for m, row in zip(rows, np.asarray(band.rows), strict=True)]
    return jax.device_put(np.stack(picked))


def compared(
    loop: ClosedLoop,
    recordings: Recordings | Sequence[Recording],
    signals: Sequence[Float[np.ndarray, "_samples joints"]],
    ahead: Float[Array, ""] | None = None,
) -> list[Float[np.ndarray, "_samples joints"]]:
    """The part of signals that is compared under the controller, for each recording.

    **Arguments:**

    - `signals`: one for each recording, `(samples, joints)`.
    - `ahead`: the controller's delay for simulated signals; None for measured ones.
    """
    band = band_of(loop, recordings)
    moving = moving_of(loop, recordings, band)
    found = list(signals)
    if band is not None:
        longest = max(len(x) for x in found)
        padded = np.stack([np.pad(x, ((0, longest - len(x)), (0, 0))) for x in found])
        passed, keep = np.asarray(compared_part(band, None, padded, ahead)), np.asarray(band.keep)
        found = [x[kept] for x, kept in zip(passed, keep, strict=True)]
    if moving is not None:
        found = [x * there[: len(x)] for x, there in zip(found, np.asarray(moving), strict=True)]
    return found


def compared_torques(
    loop: ClosedLoop,
    recordings: Recordings | Sequence[Recording],
    simulated: Sequence[Float[np.ndarray, "_samples joints"]],
) -> tuple[list[Float[np.ndarray, "_samples joints"]], ...]:
    """Measured and simulated torque as they are compared, N·m or N, for each recording.

    **Arguments:**

    - `simulated`: the torque of a simulation of each recording, `(samples, joints)`.
    """
    measured = compared(loop, recordings, [r.tau for r in recordings])
    return measured, compared(loop, recordings, simulated, loop.controller.late)
