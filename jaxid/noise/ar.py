"""Autoregressive noise filters H = 1/A, one for each joint."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..errors import NoiseError
from .stretches import depths, predictors, through
from .whiteness import levelled, ljung_box

if TYPE_CHECKING:
    import pandas as pd

Criterion = Literal["aic", "aicc", "bic"]


class ARFilter(eqx.Module):
    """Coloured noise: A(z) n = e, with A = 1 + a1 z^-1 + … and e white of variance `variance`."""

    coefficients: Float[np.ndarray, " order"]
    variance: float

    @classmethod
    def from_reflection(
        cls, reflection: Float[np.ndarray, " order"], variance: float = 1.0
    ) -> "ARFilter":
        """The stable filter with reflection coefficients of magnitude below one (Levinson 1947).

        **Raises:** `NoiseError` if one is not below one.
        """
        reflection = np.asarray(reflection, dtype=float)
        if not np.all(np.abs(reflection) < 1):
            raise NoiseError("reflection coefficients of a stable filter must be between -1 and 1")
        a = np.ones(1)
        for k in reflection:
            a = np.append(a, 0.0)
            a = a + k * a[::-1]
        return cls(a[1:], float(variance))

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return len(self.coefficients)

    @property
    def polynomial(self) -> Float[np.ndarray, " order_and_one"]:
        """1, a1, a2, …"""
        return np.concatenate([[1.0], self.coefficients])

    @property
    def reflection(self) -> Float[np.ndarray, " order"]:
        """Reflection coefficients; the filter is stable if all are between -1 and 1."""
        a, found = self.polynomial, []
        while len(a) > 1:
            k = a[-1]
            found.append(k)
            if abs(k) >= 1:
                # The recursion ends here: the filter is unstable.
                found += [np.inf] * (len(a) - 2)
                break
            a = ((a - k * a[::-1]) / (1 - k**2))[:-1]
        return np.array(found[::-1])

    @property
    def stable(self) -> bool:
        """Whether noise from this filter stays bounded."""
        return bool(np.all(np.abs(self.reflection) < 1))

    @property
    def gain(self) -> float:
        """Variance of the coloured noise over that of e; infinite if unstable."""
        reflection = self.reflection
        if not np.all(np.abs(reflection) < 1):
            return np.inf
        return float(1 / np.prod(1 - reflection**2))

    def spectrum(self, size: int) -> Float[np.ndarray, " size"]:
        """Power at the `size` frequencies of a discrete Fourier transform."""
        return self.variance / np.abs(np.fft.fft(self.polynomial, size)) ** 2

    def product_variance(self, x: Float[np.ndarray, " samples"]) -> float:
        """Variance of the scalar product of a series and this noise."""
        size = 2 * len(x)
        return float(np.sum(np.abs(np.fft.fft(x, size)) ** 2 * self.spectrum(size)) / size)

    def whiten(self, x: Float[np.ndarray, "samples *axes"]) -> Float[np.ndarray, "samples *axes"]:
        """A(z) x along the first axis; samples before the first count as zero."""
        import scipy

        return np.asarray(
            scipy.signal.lfilter(self.polynomial, [1.0], np.asarray(x, float), axis=0)
        )

    def innovations(
        self,
        x: Float[np.ndarray, "samples *axes"],
        there: Bool[np.ndarray, " samples"],
    ) -> Float[np.ndarray, "samples *axes"]:
        """Prediction errors of x within stretches, each in units of its deviation over that of e.

        The first samples of a stretch are predicted from those before them in the stretch, which
        are fewer than the order. Prediction errors of noise of this filter are therefore white from
        the first sample on.

        **Arguments:**

        - `there`: samples that are compared; the errors of others are zero.
        """
        taps, spread = predictors(self.stabilised().reflection)
        wide = x.reshape(len(x), -1)
        return through(taps / spread[:, None], wide, depths(there)).reshape(x.shape)

    def starts(self, there: Bool[np.ndarray, " samples"]) -> float:
        """Sum of the logarithms of the variances of `innovations` over that of e.

        Only the first samples of stretches contribute.
        """
        depth = depths(there)
        _, spread = predictors(self.stabilised().reflection)
        return float(2 * np.sum(np.log(spread[np.minimum(depth[depth >= 0], self.order)])))

    def stabilised(self) -> "ARFilter":
        """The stable filter with the same spectrum: poles are reflected into the unit circle."""
        if self.stable:
            return self
        poles = np.roots(self.polynomial)
        outside = np.abs(poles) >= 1
        inside = np.where(outside, 1 / np.conj(poles), poles)
        # Noise of a pole on the circle grows without bound, so poles are kept slightly inside.
        inside = inside * np.minimum(1.0, 0.999 / np.maximum(np.abs(inside), 1e-12))
        variance = self.variance / float(np.prod(np.abs(poles[outside]) ** 2))
        return ARFilter(np.real(np.poly(inside))[1:], variance)

    def simulate(
        self, shape: tuple[int, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "*shape"]:
        """Stationary noise from the first sample on, along the last axis of `shape`."""
        import scipy

        filt = self.stabilised()
        slowest = max(np.abs(np.roots(filt.polynomial)), default=0.0)
        # The transient from the start at zero has decayed to 1e-4.
        pole = np.clip(slowest, 1e-12, 0.9999)
        settle = min(50_000, int(np.ceil(np.log(1e-4) / np.log(pole)))) + 1
        lead = settle if filt.order else 0
        white = rng.standard_normal((*shape[:-1], shape[-1] + lead))
        noise = scipy.signal.lfilter([np.sqrt(filt.variance)], filt.polynomial, white, axis=-1)
        return np.asarray(noise)[..., lead:]

    def forgetting(self, samples: float, series: Sequence[Float[np.ndarray, " _"]]) -> "ARFilter":
        """The filter with its slowest poles moved inward, and the variance re-estimated.

        **Arguments:**

        - `samples`: longest time constant of a pole.
        - `series`: the series from which the filter was estimated.
        """
        poles = np.roots(self.polynomial)
        longest = np.exp(-1 / max(samples, 1e-3))
        if not np.any(np.abs(poles) > longest):
            return self
        inside = poles * np.minimum(1.0, longest / np.maximum(np.abs(poles), 1e-12))
        changed = ARFilter(np.real(np.poly(inside))[1:], self.variance)
        left = sum(float(np.sum(changed.innovations(x, x != 0) ** 2)) for x in series)
        count = max(sum(map(np.count_nonzero, series)), 1)
        return ARFilter(changed.coefficients, left / count)

    def taps(self, size: int) -> Float[np.ndarray, " size"]:
        """The polynomial padded with zeros."""
        return np.pad(self.polynomial, (0, size - self.order - 1))


def check_series(series: Sequence[Float[np.ndarray, " _"]], order: int, what: str) -> None:
    """Checks that a noise filter of an order can be estimated from residuals.

    **Arguments:**

    - `series`: residuals, one array for each recording.
    - `order`: the highest order.
    - `what`: the name of the output in messages.

    **Raises:** `NoiseError`.
    """
    if order < 0:
        raise NoiseError(f"the noise filter of {what} has order {order}: give 0 or more")
    for k, x in enumerate(series, start=1):
        if not np.isfinite(x).all():
            raise NoiseError(
                f"the residual of {what} in recording {k} is not finite, because the simulation "
                "failed: estimate the parameters first"
            )
    shortest = min(len(x) for x in series)
    if shortest <= order + 1:
        raise NoiseError(
            f"a recording has {shortest} samples, too few for the noise filter of {what} of order "
            f"{order}: leave it out, or lower the order"
        )
    total = sum(len(x) for x in series)
    if total - order * len(series) < 3 * (order + 1):
        raise NoiseError(
            f"{total} samples of {what} do not determine a noise filter of order {order}, which "
            "needs four for each coefficient: lower the order or record longer"
        )
    swing = max(float(np.ptp(x)) for x in series)
    if swing <= 1e-12 * max(float(np.abs(x).max()) for x in series):
        raise NoiseError(
            f"the residual of {what} is constant, so there is no noise to model: use OEM, or check "
            "whether its torque was recorded at all"
        )


def fit_ar(
    series: Sequence[Float[np.ndarray, " _"]],
    order: int | None = None,
    *,
    highest: int = 50,
    criterion: Criterion = "aic",
    white: float | None = None,
) -> ARFilter:
    """The AR filter of one joint's residuals over several recordings, by Burg's method.

    The filter is stable, because every reflection coefficient is below one. Products across the
    ends of recordings, and across samples that are not compared, are left out.

    **Arguments:**

    - `series`: residuals, `(samples,)` each; zero where they are not compared.
    - `order`: number of coefficients; None to choose it by `criterion` over 0..`highest`.
    - `white`: significance of Ljung and Box's test of the innovations, by which orders are
      rejected (see `orders`); None for no test.

    **Raises:** `NoiseError` for a given order that the data do not allow.
    """
    if order is not None:
        check_series(series, order, "this series")
    most = highest if order is None else order
    if order is None:
        most = min(most, _highest(series))
    burg = Burg.of(series, most)
    if burg.variances[0] <= 0:
        return ARFilter(np.zeros(0), 0.0)
    if order is None:
        table = burg.orders(white is not None)
        order = choose(table, criterion, white)
    return ARFilter(burg.coefficients[order], float(burg.variances[order]))


def orders(
    series: Sequence[Float[np.ndarray, " _"]], highest: int = 50, lags: int = 38
) -> "pd.DataFrame":
    """Innovation variance, AIC, AICc, BIC and whiteness of every order up to `highest`.

    **Arguments:**

    - `series`: residuals of one joint, `(samples,)` for each recording.
    - `lags`: of Ljung and Box's test; at least twenty beyond each order.
    """
    check_series(series, 0, "this series")
    return Burg.of(series, min(highest, _highest(series))).orders(True, lags)


# Smallest share of the samples that have as many before them in their stretch as the order.
_WITH_PAST = 2 / 3


def _highest(series: Sequence[Float[np.ndarray, " _"]]) -> int:
    """The highest order that enough samples of these series determine."""
    depth = np.concatenate([depths(x != 0) for x in series])
    depth = np.sort(depth[depth >= 0])
    return int(depth[int((1 - _WITH_PAST) * len(depth))]) if len(depth) else 0


def choose(table: "pd.DataFrame", criterion: Criterion, white: float | None = None) -> int:
    """The order with the lowest criterion, among those with white innovations if there are any.

    (As CAPTAIN's `aic` does, Young 2011.)

    **Arguments:**

    - `table`: from `orders`.
    - `white`: significance of the test; None for the criterion alone.
    """
    if white is not None:
        passing = table.loc[table["ljung_box_p"] > white]
        table = passing if len(passing) else table
    return int(table.index.to_numpy()[int(np.argmin(table[criterion].to_numpy()))])


class Burg(eqx.Module):
    """Filters of every order, pooled over series (Burg 1975).

    The Yule-Walker equations are biased: for poles near the unit circle their variance is several
    times too large. No library pools several series.
    """

    coefficients: list[np.ndarray]
    variances: Float[np.ndarray, " orders"]
    innovations: list[list[np.ndarray]]
    count: int

    @classmethod
    def of(cls, series: Sequence[Float[np.ndarray, " _"]], most: int) -> "Burg":
        """Filters of orders 0..`most`, each recording in units of its own noise level."""
        forward = levelled([np.asarray(x, dtype=float) for x in series])
        backward = list(forward)
        past = [depths(x != 0) for x in forward]
        a = np.ones(1)
        count = max(int(sum(map(np.count_nonzero, forward))), 1)
        variances = [sum(float(x @ x) for x in forward) / count]
        found, innovations = [np.zeros(0)], [list(forward)]
        for order in range(1, most + 1):
            # Errors of samples with fewer before them in their stretch do not enter the products.
            kept = [depth[order:] >= order for depth in past]
            pairs = [
                (f[1:] * there, b[:-1] * there)
                for f, b, there in zip(forward, backward, kept, strict=True)
            ]
            power = sum(float(f @ f + b @ b) for f, b in pairs)
            k = -2 * sum(float(f @ b) for f, b in pairs) / power if power > 0 else 0.0
            forward = [f + k * b for f, b in pairs]
            backward = [b + k * f for f, b in pairs]
            a = np.append(a, 0.0)
            a = a + k * a[::-1]
            found.append(a[1:])
            innovations.append(forward)
            variances.append(variances[-1] * (1 - k**2))
        floored = np.array([variances[0], *np.maximum(variances[1:], 1e-300)])
        return cls(found, floored, innovations, count)

    def orders(self, tested: bool, lags: int = 38) -> "pd.DataFrame":
        """One row for each order; whiteness only if `tested`, because the test is slow."""
        import pandas as pd

        k = np.arange(len(self.variances))
        level = self.count * np.log(self.variances)
        table = pd.DataFrame(
            {
                "variance": self.variances,
                "aic": level + 2.0 * (k + 1),
                "aicc": level + 2.0 * (k + 1) * self.count / np.maximum(self.count - k - 2, 1),
                "bic": level + np.log(self.count) * (k + 1),
            },
            index=pd.Index(k, name="order"),
        )
        if tested:
            table["ljung_box_p"] = [
                ljung_box(e, max(lags, order + 20), order).p_value
                for order, e in enumerate(self.innovations)
            ]
        return table
