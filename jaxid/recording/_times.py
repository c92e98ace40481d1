"""Checks of the times of samples: gaps, jitter, order."""

import warnings
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int

from ..errors import JaxidWarning
from ._problem import Labels, Lines, label, place, problem

Gaps = Literal["refuse", "allow"]

# A warning needs at least this jitter of times, in steps, and a motion that is smoother on even
# times by at least this factor.
_JITTER, _ROUGHER = 0.05, 2.0
# Number of samples before and after a long step that show whether samples are missing there, share
# of the spans of as many samples from which the first estimate of the period is taken, and number
# of estimates.
_NEAR, _SHORT, _TURNS = 10, 0.3, 3
# Added to a delay in samples before it is rounded down. Less than a half, because a sample that is
# wrongly taken for missing makes all later times wrong.
_CERTAIN = 0.3


def even(
    source: str, time: Float64[np.ndarray, " samples"], lines: Lines
) -> Float64[np.ndarray, " samples"]:
    """Times on the grid of the sampling, without jitter.

    Missing samples leave holes in it, and a warning counts them.

    **Raises:** `RecordingError` for times that do not increase.
    """
    count = len(time)
    near = min(_NEAR, count // 2)
    # Few of the shortest spans lack a sample, and the jitter of a span is divided by its length.
    period = float(np.quantile(time[near:] - time[:-near], _SHORT)) / near
    first, number = 0.0, np.arange(count)
    for _ in range(_TURNS if period > 0 else 0):
        number = _numbered(time, period)
        period, first = np.polyfit(number, time, 1)
    if not period > 0:
        raise problem(source, "time does not increase over the recording", "give it in seconds")
    missing = int(number[-1]) - count + 1
    if missing:
        first_hole = place(int(np.argmax(np.diff(number) > 1)), lines)
        warnings.warn(
            f"{source}: {missing} of {number[-1] + 1} samples seem to be missing, first after "
            f"{first_hole}; the other times are evenly spaced around these holes.",
            JaxidWarning,
            stacklevel=5,
        )
    return first + period * number


def _numbered(time: Float64[np.ndarray, " samples"], period: float) -> Int[np.ndarray, " samples"]:
    """The number of each sample on a grid of this period.

    A late sample is followed by shorter steps. After a missing one all samples are late, so the
    earliest of the next samples is compared with the earliest of the last ones.
    """
    number = np.arange(len(time))
    late = time - period * number
    for k in np.flatnonzero(np.diff(time) > 1.5 * period):
        before, after = late[max(k + 1 - _NEAR, 0) : k + 1], late[k + 1 : k + 1 + _NEAR]
        missing = int((after.min() - before.min()) / period + _CERTAIN)
        if missing > 0:
            number[k + 1 :] += missing
            late[k + 1 :] -= missing * period
    return number


def steady(source: str, signals: Mapping[str, Float64[np.ndarray, "..."]]) -> None:
    """Warns of times that jitter although the samples are evenly spaced.

    A motion is smooth over its true times. If it is much smoother over even times, those are the
    true ones, and the recorded times are a logger's.
    """
    time, q = signals["time"], signals["q"]
    steps = np.diff(time)
    usual = float(np.median(steps))
    jitter = float(np.quantile(np.abs(steps - usual), 0.9))
    if jitter < _JITTER * usual or missing_after(time).any():
        return
    smooth = np.linspace(time[0], time[-1], len(time))
    rough = [
        np.std(np.diff(np.diff(q, axis=0) / np.diff(t)[:, None], axis=0)) for t in (time, smooth)
    ]
    if rough[0] > _ROUGHER * rough[1]:
        warnings.warn(
            f"{source}: times jitter by {1e3 * jitter:.3g} ms about {1e3 * usual:.3g} ms, and "
            f"positions are {rough[0] / rough[1]:.2g} times as smooth on even times, so these are "
            "probably times of a logger, not those at which the drive sampled; pass "
            'clock="even" (--clock even), or record the drive\'s own times.',
            JaxidWarning,
            stacklevel=5,
        )


def increasing(
    source: str, time: Float64[np.ndarray, " samples"], labels: Labels, gaps: Gaps, lines: Lines
) -> None:
    """Refuses times that go back or repeat, and gaps unless they are allowed.

    **Raises:** `RecordingError` for the first of these.
    """
    name = label(labels, "time", 0, 1)
    with np.errstate(over="ignore"):
        steps, span = np.diff(time), time[-1] - time[0]
    if not (steps > 0).all():
        row = int(np.argmin(steps > 0))
        verb = "repeats" if steps[row] == 0 else "goes back"
        raise problem(
            source,
            f"{name} {verb} at {place(row + 1, lines)} ({time[row + 1]:.9g} s after "
            f"{time[row]:.9g} s)",
            "sort the rows by time and drop the repeated ones",
        )
    if not np.isfinite(span):
        raise problem(source, f"{name} spans more than float64 can hold", "give it in seconds")
    too_long = missing_after(time)
    if gaps != "allow" and too_long.any():
        row = int(np.argmax(too_long))
        raise problem(
            source,
            f"{name} has a gap of {steps[row]:.4g} s before {place(row + 1, lines)}, but the "
            f"usual step is {np.median(steps):.4g} s",
            'split the recording there, or pass gaps="allow" (--gaps allow)',
        )


def missing_after(time: Float64[np.ndarray, " samples"]) -> Bool[np.ndarray, " steps"]:
    """Samples that are followed by a gap.

    A gap is a step of more than five times the 95th percentile of all steps. Five times the median
    would find gaps in uneven sampling, which has many long steps.
    """
    steps = np.diff(time)
    return steps / 5 > np.quantile(steps, 0.95, method="lower")
