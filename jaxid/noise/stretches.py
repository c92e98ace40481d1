"""Prediction within stretches of a series: samples in between are not compared."""

import numpy as np
from jaxtyping import Bool, Float, Int

# Rows of the matrix of a filter that are multiplied at once.
_ROWS = 32


def depths(there: Bool[np.ndarray, " samples"]) -> Int[np.ndarray, " samples"]:
    """The number of samples of its stretch before each sample; -1 for samples that are not there.

    **Arguments:**

    - `there`: whether a sample is compared.
    """
    number = np.arange(len(there))
    last = np.maximum.accumulate(np.where(there, -1, number))
    return number - last - 1


def predictors(
    reflection: Float[np.ndarray, " order"],
) -> tuple[Float[np.ndarray, "depths lags"], Float[np.ndarray, " depths"]]:
    """Prediction errors from 0, 1, … past samples of stationary noise (Levinson 1947).

    **Arguments:**

    - `reflection`: reflection coefficients of the filter.

    **Returns:** for each number of past samples the coefficients of the prediction error, and its
    deviation over that of the whole filter.
    """
    order = len(reflection)
    taps, a = np.zeros((order + 1, order + 1)), np.ones(1)
    taps[0, 0] = 1.0
    for depth, k in enumerate(reflection, start=1):
        a = np.append(a, 0.0)
        a = a + k * a[::-1]
        taps[depth, : depth + 1] = a
    left = np.append(np.cumprod((1 - reflection**2)[::-1])[::-1], 1.0)
    return taps, 1 / np.sqrt(left)


def through(
    taps: Float[np.ndarray, "depths lags"],
    x: Float[np.ndarray, "samples columns"],
    depth: Int[np.ndarray, " samples"],
) -> Float[np.ndarray, "samples columns"]:
    """Moving averages along the samples, with the coefficients of the depth of each.

    They are products with a banded matrix. SciPy's `lfilter` has the same coefficients for all
    samples, needs one convolution per column, and is five times as slow for a thousand.
    """
    taps, reach = taps.astype(x.dtype), taps.shape[1] - 1
    if reach == 0:
        return np.where(depth[:, None] >= 0, taps[0] * x, 0)
    out = np.zeros_like(x)
    # Of a band as wide as it is high half is zeros; a lower one would be too many products.
    size = max(_ROWS, reach)
    whole = _band(np.broadcast_to(taps[-1], (size, reach + 1)))
    for at in range(0, len(x), size):
        own = depth[at : at + size] >= reach
        if own.any():
            first = max(at - reach, 0)
            band = whole[: len(own), first - at + reach : len(own) + reach]
            out[at : at + size] = (band @ x[first : at + size]) * own[:, None]
    # The first samples of a stretch are predicted from those before them in it.
    early = _band(taps[:reach])[:, reach:]
    for first in np.flatnonzero(depth == 0):
        left = min(reach, len(x) - first)
        count = int(np.sum(depth[first : first + left] == np.arange(left)))
        out[first : first + count] = early[:count, :count] @ x[first : first + count]
    return out


def _band(taps: Float[np.ndarray, "rows lags"]) -> Float[np.ndarray, "rows columns"]:
    """The matrix from some rows, and as many before them as the order, to the predictions.

    **Arguments:**

    - `taps`: coefficients of each row's prediction, from its own sample backward.
    """
    rows, reach = len(taps), taps.shape[1] - 1
    lag = np.arange(rows)[:, None] + reach - np.arange(rows + reach)
    chosen = taps[np.arange(rows)[:, None], np.clip(lag, 0, reach)]
    return np.where((lag >= 0) & (lag <= reach), chosen, 0)
