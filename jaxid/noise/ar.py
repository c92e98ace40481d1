"""Autoregressive noise filters H = 1/A, one a joint."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float


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
    """The AR filter of one joint's residuals over several recordings, by Burg's method.

    Stable by construction, since every reflection coefficient is below one; never across the ends
    of recordings.

    **Arguments:**

    - `series`: residuals, `(samples,)` each.
    - `order`: number of coefficients; None to choose it by `criterion` over 0..`highest`.
    """
    count = sum(len(x) for x in series)
    most = highest if order is None else order
    most = max(0, min(most, min(len(x) for x in series) // 3))
    coefficients, variances = _burg(series, most)
    if variances[0] <= 0:
        return ARFilter(np.zeros(0), 0.0)
    if order is None:
        k = np.arange(most + 1)
        penalty = {
            "aic": 2.0 * (k + 1),
            "aicc": 2.0 * (k + 1) * count / np.maximum(count - k - 2, 1),
            "bic": np.log(count) * (k + 1),
        }[criterion]
        order = int(np.argmin(count * np.log(variances) + penalty))
    order = min(order, most)
    return ARFilter(coefficients[order], float(variances[order]))


def _burg(
    series: Sequence[Float[np.ndarray, " _"]], most: int
) -> tuple[list[np.ndarray], Float[np.ndarray, " orders"]]:
    """Coefficients and innovation variances of every order, pooled over series (Burg 1975).

    Yule and Walker's equations have a bias that near the unit circle makes the variance several
    times too large; no library pools several series.
    """
    forward = [np.asarray(x, dtype=float) for x in series]
    backward = list(forward)
    a = np.ones(1)
    variances = [sum(float(x @ x) for x in forward) / sum(len(x) for x in forward)]
    found = [np.zeros(0)]
    for _ in range(most):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True)]
        power = sum(float(f @ f + b @ b) for f, b in pairs)
        k = -2 * sum(float(f @ b) for f, b in pairs) / power if power > 0 else 0.0
        forward = [f + k * b for f, b in pairs]
        backward = [b + k * f for f, b in pairs]
        a = np.append(a, 0.0)
        a = a + k * a[::-1]
        found.append(a[1:])
        variances.append(variances[-1] * (1 - k**2))
    return found, np.array([variances[0], *np.maximum(variances[1:], 1e-300)])
