"""Checks of the times of samples: gaps, jitter, order."""

import warnings
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from ..errors import JaxidWarning
from ._problem import Labels, Lines, label, place, problem

Gaps = Literal["refuse", "allow"]

# A warning needs at least this jitter of times, in steps, and a motion that is smoother on even
# times by at least this factor.
_JITTER, _ROUGHER = 0.05, 2.0


def even(source: str, time: Float64[np.ndarray, " samples"]) -> Float64[np.ndarray, " samples"]:
    """Evenly spaced times, by a straight line through the recorded ones.

    **Raises:** `RecordingError` for times that do not increase.
    """
    number = np.arange(len(time))
    slope, first = np.polyfit(number, time, 1)
    if not slope > 0:
        raise problem(source, "time does not increase over the recording", "give it in seconds")
    return first + slope * number


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
