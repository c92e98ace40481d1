"""Autocorrelation of residuals."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def autocovariance(
    series: Sequence[Float[np.ndarray, " _"]], lags: int
) -> Float[np.ndarray, " lags_and_zero"]:
    """Autocovariance pooled over several series, never across their ends, from lag 0.

    **Arguments:**

    - `series`: residuals with mean zero, `(samples,)` each.
    - `lags`: how many beyond lag 0.
    """
    total = np.zeros(lags + 1)
    for x in series:
        size = 1 << int(np.ceil(np.log2(len(x) + lags + 1)))
        power = np.abs(np.fft.rfft(x, size)) ** 2
        total += np.fft.irfft(power, size)[: lags + 1]
    return total / sum(len(x) for x in series)


def autocorrelation(
    series: Sequence[Float[np.ndarray, " _"]], lags: int = 38
) -> tuple[Float[np.ndarray, " lags_and_zero"], float]:
    """Autocorrelation from lag 0, and the two-sigma bound that white residuals keep to.

    **Arguments:**

    - `series`: residuals, `(samples,)` each.
    - `lags`: how many beyond lag 0; 38 as in CAPTAIN's `acf` (Young 2011).
    """
    covariance = autocovariance(series, lags)
    bound = 2 / np.sqrt(sum(len(x) for x in series))
    level = covariance[0] if covariance[0] > 0 else 1.0
    return covariance / level, float(bound)
