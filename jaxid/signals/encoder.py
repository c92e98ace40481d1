"""Noise of recorded positions."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..recording import Recording
from .smoothing import even_times, resampled

# Frequencies at which a recorded position has no motion, as shares of the sample rate. They are
# above those of `Tracking.known`, and below those that filters of loggers remove.
_ABOVE, _UNTIL = 0.25, 0.45
# Smallest number of samples of a spectrum.
_SAMPLES = 64


def position_noise(recording: Recording) -> Float[np.ndarray, " joints"]:
    """Standard deviation of white noise in the recorded positions, rad or m; zero if too short.

    It follows from the median of the spectrum at frequencies without motion, which single
    disturbances hardly change. Steps of an encoder are such noise if the joint passes many of them.

    **Arguments:**

    - `recording`: with any number of joints.
    """
    import scipy

    n, rate = recording.samples, recording.rate
    if n < _SAMPLES:
        return np.zeros(recording.joints)
    q = scipy.signal.detrend(resampled(recording.time, recording.q, even_times(recording)), axis=0)
    # The side lobes of the window are below the noise.
    window = np.asarray(scipy.signal.get_window("blackmanharris", n))
    power = np.abs(np.fft.rfft(q * window[:, None], axis=0)) ** 2 / np.sum(window**2)
    f = np.fft.rfftfreq(n, 1 / rate)
    there = (f > _ABOVE * rate) & (f < _UNTIL * rate)
    # The median of an exponential distribution is log(2) times its mean.
    return np.sqrt(np.median(power[there], axis=0) / np.log(2))


def position_errors(
    recordings: Sequence[Recording], draws: int
) -> list[list[Float[np.ndarray, "_samples joints"]]]:
    """Errors as strong as the noise of the recorded positions, rad or m; the same in each call.

    **Arguments:**

    - `draws`: number of independent draws.

    **Returns:** for each draw the errors of each recording; empty if no recording has noise.
    """
    levels, rng = [position_noise(r) for r in recordings], np.random.default_rng(0)
    if not any(np.any(level > 0) for level in levels):
        return []
    return [
        [
            level * rng.standard_normal(r.q.shape)
            for r, level in zip(recordings, levels, strict=True)
        ]
        for _ in range(draws)
    ]
