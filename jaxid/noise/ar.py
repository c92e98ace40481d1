"""Autoregressive noise filters H = 1/A, one a joint."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .whiteness import autocovariance


class ARFilter(eqx.Module):
    """Coloured noise: A(z) n = e, with A = 1 + a1 z^-1 + … and e white of variance `variance`."""

    coefficients: Float[np.ndarray, " order"]
    variance: float

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return len(self.coefficients)

    @property
    def polynomial(self) -> Float[np.ndarray, " order_and_one"]:
        """1, a1, a2, …"""
        return np.concatenate([[1.0], self.coefficients])

    def spectrum(self, size: int) -> Float[np.ndarray, " size"]:
        """Power at the `size` frequencies of a discrete Fourier transform."""
        return self.variance / np.abs(np.fft.fft(self.polynomial, size)) ** 2

    def whiten(self, x: Float[np.ndarray, "samples *axes"]) -> Float[np.ndarray, "samples *axes"]:
        """A(z) x along the first axis; what came before the first sample counts as zero."""
        white = np.array(x, dtype=float)
        for k, a in enumerate(self.coefficients, start=1):
            white[k:] += a * x[:-k]
        return white


def fit_ar(
    series: Sequence[Float[np.ndarray, " _"]],
    order: int | None = None,
    *,
    highest: int = 50,
    criterion: Literal["aic", "aicc", "bic"] = "aic",
) -> ARFilter:
    """The AR filter of one joint's residuals over several recordings, by Levinson and Durbin.

    Stable by construction, since the pooled autocovariances are positive definite.

    **Arguments:**

    - `series`: residuals, `(samples,)` each.
    - `order`: number of coefficients; None to choose it by `criterion` over 0..`highest`.
    """
    count = sum(len(x) for x in series)
    most = highest if order is None else order
    most = max(0, min(most, min(len(x) for x in series) // 3))
    covariance = autocovariance(series, most + 1)
    if covariance[0] <= 0:
        return ARFilter(np.zeros(0), 0.0)
    coefficients, variances = _levinson(covariance[: most + 1])
    if order is None:
        k = np.arange(most + 1)
        penalty = {
            "aic": 2.0 * (k + 1),
            "aicc": 2.0 * (k + 1) * count / np.maximum(count - k - 2, 1),
            "bic": np.log(count) * (k + 1),
        }[criterion]
        order = int(np.argmin(count * np.log(variances) + penalty))
    order = min(order, most)
    return ARFilter(-coefficients[order], float(variances[order]))


def _levinson(
    covariance: Float[np.ndarray, " orders"],
) -> tuple[list[np.ndarray], Float[np.ndarray, " orders"]]:
    """Predictors and innovation variances of every order, from autocovariances."""
    # statsmodels takes half a second to import, which every command would wait for.
    from statsmodels.tsa.stattools import levinson_durbin

    most = len(covariance) - 1
    if most == 0:
        return [np.zeros(0)], covariance[:1]
    _, _, _, variances, phi = levinson_durbin(covariance, most, isacov=True)
    variances = np.asarray(variances).copy()
    variances[0] = covariance[0]
    predictors = [np.asarray(phi[1 : k + 1, k]) for k in range(most + 1)]
    return predictors, np.maximum(variances, 1e-300)
