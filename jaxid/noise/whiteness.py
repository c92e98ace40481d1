"""Autocorrelation of residuals."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float


def autocovariance(
    series: Sequence[Float[np.ndarray, " _"]], lags: int
) -> Float[np.ndarray, " lags_and_zero"]:
    """Autocovariance pooled over several series, without products across their ends, from lag 0.

    **Arguments:**

    - `series`: residuals with mean zero, `(samples,)` each.
    - `lags`: number of lags beyond 0.
    """
    total = np.zeros(lags + 1)
    for x in series:
        size = 1 << int(np.ceil(np.log2(len(x) + lags + 1)))
        power = np.abs(np.fft.rfft(x, size)) ** 2
        total += np.fft.irfft(power, size)[: lags + 1]
    return total / sum(len(x) for x in series)


def centred(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """A residual without its mean. Samples that are not compared are zero, and stay zero."""
    there = x != 0
    return np.where(there, x - x.sum() / max(np.count_nonzero(there), 1), 0.0)


def levelled(series: Sequence[Float[np.ndarray, "_ *axes"]]) -> list[np.ndarray]:
    """Several series scaled to a common noise level.

    Without scaling, a recording with more noise would dominate.

    **Arguments:**

    - `series`: residuals with mean zero, `(samples,)` or `(samples, outputs)` each.
    """
    return [x / ratio for x, ratio in zip(series, levels(series), strict=True)]


def levels(series: Sequence[Float[np.ndarray, "_ *axes"]]) -> list[np.ndarray]:
    """Noise level of each series relative to the overall level; one for a series of zeros.

    Samples that are not compared are zero, and do not count.
    """
    sizes = [np.maximum(np.count_nonzero(x, axis=0), 1) for x in series]
    # The residual of a fit that diverges may overflow.
    with np.errstate(over="ignore", invalid="ignore"):
        power = [
            np.asarray(np.sum(np.square(x), axis=0) / size)
            for x, size in zip(series, sizes, strict=True)
        ]
        pooled = sum(s * p for s, p in zip(sizes, power, strict=True)) / sum(sizes)
        ratio = [np.where(p > 0, p, 1.0) / np.where(p > 0, pooled, 1.0) for p in power]
    return [np.asarray(np.sqrt(r)) for r in ratio]


def autocorrelation(
    series: Sequence[Float[np.ndarray, " _"]], lags: int = 38
) -> tuple[Float[np.ndarray, " lags_and_zero"], float]:
    """Autocorrelation from lag 0, and the two-sigma bound for white residuals.

    **Arguments:**

    - `series`: residuals, `(samples,)` each.
    - `lags`: number of lags beyond 0; 38 as in CAPTAIN's `acf` (Young 2011).
    """
    covariance = autocovariance(series, lags)
    bound = 2 / np.sqrt(sum(len(x) for x in series))
    level = covariance[0] if covariance[0] > 0 else 1.0
    return covariance / level, float(bound)


class LjungBox(eqx.Module):
    """A test of whiteness: statistic, degrees of freedom, p-value."""

    statistic: float
    freedom: int
    p_value: float


def ljung_box(
    series: Sequence[Float[np.ndarray, " _"]], lags: int = 38, fitted: int = 0
) -> LjungBox:
    """Whether residuals are white, over several recordings at once (Ljung and Box 1978).

    statsmodels has the test for one series. Here each lag pools the pairs within recordings, each
    scaled to its own noise level.

    **Arguments:**

    - `series`: residuals with mean zero, `(samples,)` each.
    - `lags`: number of lags.
    - `fitted`: number of coefficients that were estimated from the residuals.
    """
    import scipy

    covariance = autocovariance(levelled(series), lags)
    total = sum(len(x) for x in series)
    if covariance[0] <= 0:
        return LjungBox(0.0, max(lags - fitted, 1), 1.0)
    at = np.arange(1, lags + 1)
    pairs = np.array([sum(max(len(x) - k, 0) for x in series) for k in at])
    correlation = covariance[1:] / covariance[0]
    weight = np.divide(total * (total + 2.0), pairs, where=pairs > 0, out=0.0 * at)
    statistic = float(np.sum(weight * correlation**2))
    freedom = max(lags - fitted, 1)
    return LjungBox(statistic, freedom, float(scipy.stats.chi2.sf(statistic, freedom)))
