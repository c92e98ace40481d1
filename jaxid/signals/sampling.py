"""Detection of clocks in signals: held values, torque computed from readings, periods."""

import numpy as np
from jaxtyping import Float

# Share of holds that must last as long as the usual one, or a multiple of it, for a clock.
_REGULAR = 0.9
# Coherence above a quarter of the sample rate at which torque counts as computed from the readings.
# With eight half-overlapping segments, unrelated signals have 0.15.
_COHERENT, _PIECES = 0.5, 8
# Largest decrease of an encoder's spectrum from a quarter to half of the sample rate.
_FALLS = 10.0
# Share of a signal's variance by which it may differ from itself a period later, and by which it
# has to differ in between.
_SAME, _OTHER = 1e-4, 0.1


def held(x: Float[np.ndarray, " samples"]) -> int:
    """Number of samples for which a signal holds each value; 1 if no clock is detected.

    **Arguments:**

    - `x`: samples of any unit.
    """
    lasting = np.diff(np.flatnonzero(np.diff(x)))
    usual = int(np.median(lasting)) if len(lasting) >= 20 else 1
    if usual < 2 or np.mean(lasting % usual == 0) < _REGULAR:
        return 1
    return usual


def follows(
    readings: Float[np.ndarray, " samples"], tau: Float[np.ndarray, " samples"]
) -> float | None:
    """Coherence of torque with readings above a quarter of the sample rate, by its median.

    At these frequencies the robot's motion is smaller than the encoder's noise, so a coherent
    torque was computed from these samples (Welch 1967). None for recordings that are too short, and
    for readings whose spectrum still falls at these frequencies, since they show the motion rather
    than the encoder.

    **Arguments:**

    - `readings`: position, `(samples,)`, rad or m.
    - `tau`: torque, `(samples,)`, N·m or N.
    """
    import scipy

    length = min(256, len(readings) // _PIECES)
    if length < 16 or not np.ptp(readings) or not np.ptp(tau):
        return None
    # The side lobes must be below the encoder's steps, and the motion is 10⁵ times as large.
    how = {"nperseg": length, "window": "blackmanharris", "detrend": "linear"}
    frequency, power = scipy.signal.welch(readings, **how)
    lower, upper = (power[(frequency > f) & (frequency < f + 0.1)].mean() for f in (0.25, 0.38))
    if not upper > lower / _FALLS:
        return None
    with np.errstate(all="ignore"):
        frequency, coherence = scipy.signal.coherence(readings, tau, **how)
    found = float(np.median(coherence[frequency > 0.25]))
    return found if np.isfinite(found) else None


def is_followed(coherence: float | None) -> bool:
    """Whether a coherence from `follows` shows that torque was computed from the readings."""
    return coherence is not None and coherence > _COHERENT


def period(x: Float[np.ndarray, "samples columns"]) -> int | None:
    """Number of samples after which signals repeat; None if that exceeds half of their length.

    **Arguments:**

    - `x`: samples at even times, in any unit, `(samples, columns)`.
    """
    n = len(x)
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-300)
    x = x[:, x.std(axis=0) > 0.5]
    if not x.size:
        return None
    size = 2 ** int(np.ceil(np.log2(2 * n)))
    power = (np.abs(np.fft.rfft(x, size, axis=0)) ** 2).sum(axis=1)
    lags = np.arange(n // 2 + 1)
    products = np.fft.irfft(power, size)[lags]
    # Squares of the samples that have a partner at each lag, and of those partners.
    sums = np.concatenate([[0.0], np.cumsum((x**2).sum(axis=1))])
    squares = sums[n - lags] + sums[n] - sums[lags]
    apart = (squares - 2 * products) / (2 * x.shape[1] * (n - lags))
    far = np.flatnonzero(apart > _OTHER)
    again = np.flatnonzero(apart < _SAME)
    again = again[again > far[0]] if len(far) else again[:0]
    if not len(again):
        return None
    # Lags close to a period agree almost as well as the period itself.
    near = again[again < again[0] + max(2, again[0] // 20)]
    return int(near[np.argmin(apart[near])])
