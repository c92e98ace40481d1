"""What signals show of clocks: values that are held, readings that are followed, periods."""

import numpy as np
from jaxtyping import Float

# Share of holds that last as long as the usual one, or a multiple of it, where a clock holds.
_REGULAR = 0.9
# Coherence above a quarter of the sample rate from which torque is computed from those readings. Of
# eight half-overlapping pieces, unrelated signals have 0.15.
_COHERENT, _PIECES = 0.5, 8
# How much lower an encoder's spectrum is near half the sample rate than near a quarter, at most.
_FALLS = 10.0
# Share of a signal's variance by which it may differ from itself a period later, and by which it
# has to differ in between.
_SAME, _OTHER = 1e-4, 0.1


def held(x: Float[np.ndarray, " samples"]) -> int:
    """For how many samples a signal keeps each value, 1 where no clock is seen in it.

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

    What a robot does up there is less than what its encoder adds, so a torque that follows was
    computed from these very samples (Welch 1967). None for recordings that are too short, and for
    readings whose spectrum still falls up there, which show the motion and no encoder.

    **Arguments:**

    - `readings`: position, `(samples,)`, rad or m.
    - `tau`: torque, `(samples,)`, N·m or N.
    """
    import scipy

    length = min(256, len(readings) // _PIECES)
    if length < 16 or not np.ptp(readings) or not np.ptp(tau):
        return None
    # Side lobes below the encoder's steps, for the motion is 10⁵ times as large as these.
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
    """Whether a coherence of `follows` says that torque was computed from the readings."""
    return coherence is not None and coherence > _COHERENT


def period(x: Float[np.ndarray, "samples columns"]) -> int | None:
    """After how many samples signals repeat themselves, None where they do not within half of them.

    **Arguments:**

    - `x`: samples at even times, of any unit, `(samples, columns)`.
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
    # Squares of the samples that have a partner so much later, and of those partners.
    sums = np.concatenate([[0.0], np.cumsum((x**2).sum(axis=1))])
    squares = sums[n - lags] + sums[n] - sums[lags]
    apart = (squares - 2 * products) / (2 * x.shape[1] * (n - lags))
    far = np.flatnonzero(apart > _OTHER)
    again = np.flatnonzero(apart < _SAME)
    again = again[again > far[0]] if len(far) else again[:0]
    if not len(again):
        return None
    # Beside a period, lags that are nearly one are nearly as close.
    near = again[again < again[0] + max(2, again[0] // 20)]
    return int(near[np.argmin(apart[near])])
