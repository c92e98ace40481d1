"""Autoregressive noise of several joints, each depending on the past of all."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import NoiseError
from .ar import ARFilter, Criterion, check_series, choose
from .whiteness import levelled

if TYPE_CHECKING:
    import pandas as pd


class VectorAR(eqx.Module):
    """Coloured noise: n_k + A1 n_{k-1} + A2 n_{k-2} + … = e, with e white of a full covariance."""

    coefficients: Float[np.ndarray, "order outputs outputs"]
    covariance: Float[np.ndarray, "outputs outputs"]

    @property
    def order(self) -> int:
        """Number of matrices."""
        return len(self.coefficients)

    @property
    def outputs(self) -> int:
        """Number of joints."""
        return len(self.covariance)

    @property
    def companion(self) -> Float[np.ndarray, "states states"]:
        """Companion matrix: maps the last `order` values of the noise to the next sample."""
        n, m = self.outputs, self.order
        matrix = np.eye(n * m, k=-n)
        matrix[:n] = -np.concatenate(list(self.coefficients), axis=1) if m else 0.0
        return matrix

    @property
    def radius(self) -> float:
        """Largest modulus of a pole; noise stays bounded if it is below one."""
        return float(np.abs(np.linalg.eigvals(self.companion)).max()) if self.order else 0.0

    @property
    def stable(self) -> bool:
        """Whether noise from this filter stays bounded."""
        return self.radius < 1

    def taps(self, size: int) -> Float[np.ndarray, "outputs outputs size"]:
        """The matrices after a leading identity, padded with zeros."""
        taps = np.zeros((self.outputs, self.outputs, size))
        taps[..., 0] = np.eye(self.outputs)
        taps[..., 1 : self.order + 1] = np.moveaxis(self.coefficients, 0, -1)
        return taps

    def whiten(
        self, x: Float[np.ndarray, "samples outputs"]
    ) -> Float[np.ndarray, "samples outputs"]:
        """The innovations e of a noise; samples before the first count as zero."""
        import scipy

        taps = self.taps(self.order + 1)
        return np.stack(
            [
                sum(
                    np.asarray(scipy.signal.lfilter(b, [1.0], y))
                    for b, y in zip(a, x.T, strict=True)
                )
                for a in taps
            ],
            axis=1,
        )

    def simulate(
        self, shape: tuple[int, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "*shape outputs"]:
        """Stationary noise from the first sample on; samples are the last axis of `shape`.

        **Raises:** `NoiseError` if the filter is not stable.
        """
        if not self.stable:
            raise NoiseError(
                "this noise filter is not stable, so its noise cannot be simulated: estimate it by "
                "fit_var, which gives stable filters"
            )
        settle = min(50_000, int(np.ceil(np.log(1e-4) / np.log(max(self.radius, 1e-3))))) + 1
        *some, samples = shape
        root = np.linalg.cholesky(self.covariance)
        e = rng.standard_normal((samples + settle, *some, self.outputs)) @ root.T
        past = [np.zeros((*some, self.outputs))] * self.order
        out = np.empty((samples, *some, self.outputs))
        for k, now in enumerate(e):
            for a, before in zip(self.coefficients, past, strict=True):
                now = now - before @ a.T
            past = [now, *past][: self.order]
            if k >= settle:
                out[k - settle] = now
        return np.moveaxis(out, 0, -2)


def fit_var(
    series: Sequence[Float[np.ndarray, "_samples outputs"]],
    order: int | None = None,
    *,
    highest: int = 50,
    criterion: Criterion = "aic",
) -> VectorAR:
    """The vector AR filter of all joints' residuals, by Nuttall's and Strand's method.

    The multichannel form of Burg's method: stable, without products across the ends of recordings
    (Nuttall 1976, Strand 1977).

    **Arguments:**

    - `series`: residuals, `(samples, outputs)` for each recording.
    - `order`: number of matrices; None to choose it by `criterion` over 0..`highest`.

    **Raises:** `NoiseError` if the data do not allow it.
    """
    series = levelled([np.asarray(x, float) for x in series])
    n = series[0].shape[1]
    for output in range(n):
        check_series([x[:, output] for x in series], order or 0, f"joint {output + 1}")
    most = order
    if most is None:
        most = max(0, min(highest, min(len(x) for x in series) // (3 * n)))
    found = _nuttall_strand(series, most)
    if order is None:
        order = choose(_criteria(found, sum(len(x) for x in series)), criterion)
    return found[order]


def _criteria(found: Sequence[VectorAR], count: int) -> "pd.DataFrame":
    import pandas as pd

    k = np.array([f.coefficients.size + f.covariance.size for f in found])
    level = np.array([count * np.linalg.slogdet(f.covariance)[1] for f in found])
    room = np.maximum(count - k / found[0].outputs - 1, 1)
    table = {
        "aic": level + 2.0 * k,
        "aicc": level + 2.0 * k * count / room,
        "bic": level + np.log(count) * k,
    }
    return pd.DataFrame(table, index=pd.Index(range(len(found)), name="order"))


def _nuttall_strand(
    series: Sequence[Float[np.ndarray, "_samples outputs"]], most: int
) -> list[VectorAR]:
    """Filters of every order up to the highest."""
    import scipy

    forward = [x.T for x in series]
    backward = list(forward)
    power = sum(f @ f.T for f in forward) / sum(f.shape[1] for f in forward)
    ahead, behind = np.array(power), np.array(power)
    a: list[np.ndarray] = []
    b: list[np.ndarray] = []
    found = [VectorAR(np.zeros((0, *ahead.shape)), ahead)]
    for _ in range(most):
        pairs = [(f[:, 1:], g[:, :-1]) for f, g in zip(forward, backward, strict=True)]
        ff = np.array(sum(f @ f.T for f, _ in pairs))
        bb = np.array(sum(g @ g.T for _, g in pairs))
        fb = np.array(sum(f @ g.T for f, g in pairs))
        left, right = ff @ np.linalg.inv(ahead), np.linalg.inv(behind) @ bb
        cross = scipy.linalg.solve_sylvester(left, right, 2 * fb)
        k, back = -cross @ np.linalg.inv(behind), -cross.T @ np.linalg.inv(ahead)
        forward = [f + k @ g for f, g in pairs]
        backward = [g + back @ f for f, g in pairs]
        identity = np.eye(len(ahead))
        ahead, behind = (identity - k @ back) @ ahead, (identity - back @ k) @ behind
        ahead, behind = (ahead + ahead.T) / 2, (behind + behind.T) / 2
        a, b = (
            [*(x + k @ y for x, y in zip(a, reversed(b), strict=True)), k],
            [*(y + back @ x for y, x in zip(b, reversed(a), strict=True)), back],
        )
        found.append(VectorAR(np.stack(a), ahead))
    return found


# A filter per output, one filter of all outputs, or white noise.
Noise = Sequence[ARFilter] | VectorAR | None


def innovations(
    x: Float[np.ndarray, "samples outputs"], noise: Noise
) -> Float[np.ndarray, "samples outputs"]:
    """Residuals through the inverse of noise filters; rows with an unknown past are zero."""
    if noise is None:
        return x
    if isinstance(noise, VectorAR):
        white = noise.whiten(x)
        white[: noise.order] = 0.0
        return white
    white = np.stack([f.whiten(column) for f, column in zip(noise, x.T, strict=True)], axis=1)
    for column, filt in zip(white.T, noise, strict=True):
        column[: filt.order] = 0.0
    return white
