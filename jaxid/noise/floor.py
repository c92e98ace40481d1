"""Noise of recorded torque without a robot model, from repeats or from high frequencies."""

from collections.abc import Callable, Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..recording import Recording, Recordings
from ..signals.inspection import repeats_of
from ..signals.smoothing import low_pass

Source = Literal["repeats", "above the motion"]
Compared = Callable[[Sequence[Recording], Sequence[np.ndarray]], Sequence[np.ndarray]]

# Frequencies that are used, from this multiple of the cutoff, where the low-pass has decayed, up to
# this share of half the sample rate, near which loggers have their own filters.
_ABOVE, _UNTIL = 1.5, 0.9
# Samples of a window of the spectrum, and smallest numbers of windows and frequencies.
_WINDOW, _WINDOWS, _BINS = 64, 6, 6
# Smallest number of rows of a difference.
_ROWS = 20
# The test of whiteness uses the logarithm of the ratio of power in the lower half of the
# frequencies to that in the upper half. Noise is not white if this exceeds the first number and so
# many of its standard deviations; with a standard deviation above the third, there is no result.
_COLOURED, _SURE, _UNSURE = 0.15, 2.0, 0.2


class Level(eqx.Module):
    """Standard deviation of the noise in a joint's compared torque, and its 95 % interval.

    - `value`, `low`, `high`: N·m or N.
    """

    value: float
    low: float
    high: float
    source: Source = eqx.field(static=True)


def above_motion(
    recordings: Recordings,
    cutoffs: Sequence[float],
    moving: Sequence[Bool[np.ndarray, "_ joints"]],
    shares: Sequence[float],
) -> list[tuple[Level | None, ...]]:
    """Noise by recording and joint from the torque's spectrum above the frequencies of the motion.

    A rigid arm has no torque at these frequencies; neither has friction while a joint keeps its
    direction. Noise that is white above the motion's frequencies is assumed to be white below them.
    If it is not white, it cannot be extrapolated, and None is returned: for one recording if the
    noise is not white there, for all of them if it is not white in all together.

    **Arguments:**

    - `cutoffs`: frequencies up to which the motion is known, by recording, Hz.
    - `moving`: samples at which a joint moves without a nearby reversal; their windows are used.
    - `shares`: shares of the power of white noise that remain in the compared signals.
    """
    spectra = [_above(*row) for row in zip(recordings, cutoffs, moving, strict=True)]
    by_joint = []
    for powers in zip(*spectra, strict=True):
        tilts = [_tilt(power) for power in powers]
        flat = _white([t for t in tilts if t is not None])
        spread = _spread([p for p, t in zip(powers, tilts, strict=True) if t is not None])
        levels = [
            _level(power, tilt, share, spread)
            if flat and tilt is not None and _white([tilt])
            else None
            for power, tilt, share in zip(powers, tilts, shares, strict=True)
        ]
        by_joint.append(levels)
    return list(zip(*by_joint, strict=True))


def _above(
    recording: Recording, cutoff: float, moving: Bool[np.ndarray, "samples joints"]
) -> list[Float[np.ndarray, "windows bins"]]:
    """Spectrum by joint in windows without a reversal; without rows if it is not known."""
    import scipy

    grid = np.fft.rfftfreq(_WINDOW, recording.period)
    used = (grid >= _ABOVE * cutoff) & (grid < _UNTIL * recording.rate / 2)
    if used.sum() < _BINS or recording.samples < 4 * _WINDOW:
        return [np.zeros((0, 0))] * recording.joints
    # Otherwise the motion, a thousand times as strong, would leak into these frequencies.
    high = recording.tau - low_pass(recording.tau, recording.rate, cutoff)
    taper = np.asarray(scipy.signal.get_window("hann", _WINDOW))
    first = np.arange(0, recording.samples - _WINDOW + 1, _WINDOW // 2)
    rows = first[:, None] + np.arange(_WINDOW)
    power = np.abs(np.fft.rfft(high[rows] * taper[:, None], axis=1)) ** 2 / np.sum(taper**2)
    there = np.all(moving[rows], axis=1)
    return [power[there[:, j]][:, used, j] for j in range(recording.joints)]


def _tilt(power: Float[np.ndarray, "windows bins"]) -> tuple[float, float] | None:
    """Logarithm of the ratio of power in both halves of the frequencies, and its deviation."""
    if len(power) < _WINDOWS:
        return None
    lower, upper = (part.mean(axis=1) for part in np.array_split(power, 2, axis=1))
    if min(lower.min(), upper.min()) <= 0:
        return None
    # The median over windows is robust against a step in one of them.
    ratios = np.log(lower / upper)
    slope = float(np.median(ratios))
    spread = float(np.median(abs(ratios - slope)))
    return slope, 1.25 * spread / 0.674 / float(np.sqrt(0.6 * len(ratios)))


def _white(tilts: Sequence[tuple[float, float]]) -> bool:
    """Whether the mean of tilts, weighted by their precision, is that of white noise."""
    if not tilts:
        return False
    slopes, chances = np.array(tilts).T
    precision = 1 / np.maximum(chances, 1e-6) ** 2
    chance = 1 / np.sqrt(precision.sum())
    slope = abs(slopes @ precision) * chance**2
    return bool(chance <= _UNSURE and slope <= max(_COLOURED, _SURE * chance))


def _level(
    power: Float[np.ndarray, "windows bins"],
    tilt: tuple[float, float],
    share: float,
    spread: float,
) -> Level:
    """Level of white noise from its spectrum in windows.

    **Arguments:**

    - `spread`: relative deviation of the power of one window.
    """
    mean = share * power.mean()
    # Windows overlap by half.
    chance = spread / np.sqrt(0.6 * len(power))
    # Includes a possible slope of the spectrum that is too small to be detected.
    reach = 2 * np.hypot(chance, max(abs(tilt[0]), tilt[1]))
    value = np.sqrt(mean)
    return Level(value, value * np.exp(-reach / 2), value * np.exp(reach / 2), "above the motion")


def _spread(powers: Sequence[Float[np.ndarray, "_windows _bins"]]) -> float:
    """Relative deviation of the power of one window, from all recordings of a joint.

    A recording may have no burst in its few windows without a reversal, but many elsewhere; others
    of the robot then show that there are bursts.
    """
    means = [power.mean(axis=1) for power in powers]
    around = [np.square(x / x.mean() - 1) for x in means]
    return float(np.sqrt(np.mean(np.concatenate(around)))) if around else 0.0


def from_repeats(recordings: Recordings, compared: Compared) -> dict[str, tuple[Level | None, ...]]:
    """Noise by joint of recordings with the same reference, by name, from their difference.

    The part of the difference that is linear in the difference of the joint's motion is removed.
    Half of the remaining power is the noise of each recording. It includes all other behaviour
    that is not repeatable, which a model cannot distinguish from noise.

    **Arguments:**

    - `compared`: gives the compared part of signals of two recordings, zero elsewhere.
    """
    named = {r.name: r for r in recordings}
    found: dict[str, tuple[Level | None, ...]] = {}
    for one, other in repeats_of(recordings):
        length = min(named[one].samples, named[other].samples)
        pair = [_first(named[name], length) for name in (one, other)]
        # The recordings must have the same sample times relative to the start.
        if not np.allclose(*(r.time - r.time[0] for r in pair), rtol=0, atol=0.1 * pair[0].period):
            continue
        apart = []
        for both in zip(*((r.tau, *_motion(r)) for r in pair), strict=True):
            mine, its = compared(pair, both)
            apart.append(np.where((mine != 0) & (its != 0), mine - its, 0.0))
        torque, *motion = apart
        levels = tuple(
            _of_difference(torque[:, j], np.stack([x[:, j] for x in motion], axis=1))
            for j in range(recordings.joints)
        )
        for name in (one, other):
            found.setdefault(name, levels)
    return found


def _first(r: Recording, samples: int) -> Recording:
    return r if r.samples == samples else r.slice(None, r.time[samples])


def _motion(r: Recording) -> tuple[Float[np.ndarray, "samples joints"], ...]:
    """Position relative to the first sample, velocity and acceleration, with encoder noise."""
    q = r.q - r.q[:1]
    v = np.gradient(q, r.period, axis=0)
    return q, v, np.gradient(v, r.period, axis=0)


def _of_difference(
    torque: Float[np.ndarray, " rows"], motion: Float[np.ndarray, "rows signals"]
) -> Level | None:
    there = torque != 0
    x, y = motion[there], torque[there]
    # Copies of one recording carry no information.
    if len(y) < _ROWS:
        return None
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    value = float(np.sqrt(np.sum(rest**2) / (2 * (len(rest) - x.shape[1]))))
    # Effective number of frequencies: coloured noise has fewer than rows.
    power = np.abs(np.fft.rfft(rest)) ** 2
    freedom = max(2 * float(np.sum(power)) ** 2 / max(float(np.sum(power**2)), 1e-300), 1.0)
    reach = 1.96 / np.sqrt(2 * freedom)
    return Level(value, value * np.exp(-reach), value * np.exp(reach), "repeats")
