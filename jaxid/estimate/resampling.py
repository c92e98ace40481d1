"""Parametric bootstrap: fits of recordings simulated with the fitted model and its noise."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from ..display.progress import working
from ..display.shown import AbstractShown
from ..errors import FitError
from ..noise import ARFilter, VectorAR, centred, fit_ar
from .covariance import optimum_of
from .refit import drawn_noise, noise_strengths, redrawn, refit_signals
from .result import Fit

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


class Bootstrap(AbstractShown):
    """Estimates from simulated recordings, `(draws, parameters)`, with the original fit.

    `settled` marks draws that ended within a tenth of a deviation of their minimum.
    """

    fit: Fit
    theta: Float[np.ndarray, "draws parameters"]
    settled: Bool[np.ndarray, " draws"]

    @property
    def std(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviation over the draws."""
        return self.theta.std(axis=0, ddof=1)

    def interval(self, level: float = 0.95) -> Float[np.ndarray, "parameters 2"]:
        """Basic bootstrap intervals: draws scatter around the fit like the fit around the truth."""
        tail = (1 - level) / 2
        low, high = np.quantile(self.theta, [tail, 1 - tail], axis=0)
        return np.stack([2 * self.fit.theta - high, 2 * self.fit.theta - low], axis=1)

    def table(self, level: float = 0.95) -> "pd.DataFrame":
        """Value, bias, deviation, interval and unit of each parameter."""
        import pandas as pd

        low, high = self.interval(level).T
        return pd.DataFrame(
            {
                "value": self.fit.theta,
                "bias": self.theta.mean(axis=0) - self.fit.theta,
                "std": self.std,
                "low": low,
                "high": high,
                "unit": list(self.fit.units),
            },
            index=pd.Index(self.fit.names, name="parameter"),
        )

    def shown(self) -> Fit:
        """The fit with these deviations."""
        covariance = np.atleast_2d(np.cov(self.theta, rowvar=False))
        said = f"parametric bootstrap of {len(self.theta)} draws"
        return dataclasses.replace(self.fit, covariance=covariance, deviations=said)

    def plot(self) -> "go.Figure":
        """The parameters with the deviations of the draws."""
        from ..display import figures

        names, units = list(self.fit.names), list(self.fit.units)
        return figures.parameters(names, self.fit.theta, self.std, units)

    def __repr__(self) -> str:
        return f"{self._head()}\n{self.table().to_string(float_format=lambda x: f'{x:.4g}')}"

    def _repr_html_(self) -> str:
        return f"<p>{self._head()}</p>{self.table().to_html(float_format=lambda x: f'{x:.4g}')}"

    def _head(self) -> str:
        return f"{len(self.theta)} draws, {int(self.settled.sum())} settled"


def bootstrap(fit: Fit, draws: int = 200, *, seed: int = 0, progress: bool = True) -> Bootstrap:
    """Fits recordings simulated with the fitted model and new noise, vmapped.

    Noise comes from the fit's filters; for a fit by `OEM`, which has none, filters are estimated
    from its residuals (Burg, AIC). Each draw takes a few Gauss-Newton steps from the estimate. For
    `SeparablePEM` the filters are estimated again for each draw; for `JointPEM` their coefficients
    are among the parameters.

    **Arguments:**

    - `fit`: by `OEM`, `SeparablePEM` or `JointPEM`.
    - `draws`: number of simulated sets of recordings.
    - `seed`: of the noise. `progress`: whether to show progress on a terminal.

    **Raises:** `FitError` for a fit by regression, with `Tracking()`, or that did not succeed.
    """
    problem = optimum_of(fit, "bootstrap").problem
    if not fit.succeeded or not np.isfinite(problem.weights).all():
        raise FitError(f"a fit that {fit.status.value} has no bootstrap: make it converge first")
    if draws < 2:
        raise FitError(f"{draws} draws give no deviation: use at least 2, or 200 for intervals")
    noise = fit.noise
    if noise is None:
        noise = residual_filters(fit)
    lengths = [len(r) for r in fit.residuals]
    if len(lengths) != problem.batch.q.shape[0]:
        raise FitError("bootstrap needs whole recordings: fit without window")
    strengths = noise_strengths(fit.residuals, noise)
    made = drawn_noise(noise, lengths, draws, np.random.default_rng(seed), strengths)
    with working(f"bootstrap of {fit.loop.name}", progress) as say:
        found = refit_signals(fit, redrawn(fit, made), say=say)
    p = len(fit.names)
    # 0.01 is the squared length: a tenth of a deviation.
    return Bootstrap(fit, np.asarray(found.theta)[:, :p], np.asarray(found.last) < 1e-2)


def residual_filters(fit: Fit) -> tuple[ARFilter, ...] | VectorAR:
    """AR filters of a fit's residuals."""
    series = [[centred(r[:, j]) for r in fit.residuals] for j in range(fit.loop.joints)]
    if fit.optimum.problem.weights.shape[0] != fit.loop.joints:
        raise FitError("bootstrap needs one output per joint: fit torque or position, not both")
    return tuple(fit_ar(x) for x in series)
