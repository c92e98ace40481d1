"""Detection of clocks in signals: held values, torque computed from readings, periods."""

import numpy as np
from jaxtyping import Float

# A clock is detected if this share of holds lasts as long as the usual one, or a multiple of it.
_REGULAR = 0.9
# Above this coherence, at frequencies above a quarter of the sample rate, torque was computed from
# the readings. With eight half-overlapping segments, unrelated signals have 0.15.
_COHERENT, _PIECES = 0.5, 8
# Largest decrease of an encoder's spectrum from a quarter to half of the sample rate.
_FALLS = 10.0
# Shares of a signal's variance: it may differ by the first after a period, and must differ by the
# second in between.
_SAME, _OTHER = 1e-4, 0.1


def held(x: Float[np.ndarray, " samples"]) -> int:
    """Number of samples for which each value of a signal is held; 1 if no clock is detected.

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
    torque was computed from these samples (Welch 1967). The result is None for recordings that are
    too short. It is also None for readings whose spectrum still falls at these frequencies, because
    the motion dominates them.

    **Arguments:**

    - `readings`: position, `(samples,)`, rad or m.
    - `tau`: torque, `(samples,)`, N·m or N.
    """
    import scipy

    length = min(256, len(readings) // _PIECES)
    if length < 16 or not np.ptp(readings) or not np.ptp(tau):
        return None
    # Side lobes of the motion, which is 10⁵ times larger, must be below the encoder's steps.
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
