"""Likelihood profiles: the increase of the error if one parameter is held at other values."""

import dataclasses
import html
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..display.progress import working
from ..display.shown import AbstractShown
from ..errors import FitError
from .covariance import Reduced, covariance_of, optimum_of
from .refit import Lanes, refit
from .result import Fit

if TYPE_CHECKING:
    import plotly.graph_objects as go

# Points in deviations: dense enough for a cubic, wide enough for intervals of 99.7 %.
REACH = np.array([-4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0])


class Profile(AbstractShown):
    """Deviance of one parameter: twice the decrease of log likelihood if it is held at a value.

    `values` and `deviance` are along the profile; `others` are the values of other parameters.
    """

    fit: Fit
    name: str = eqx.field(static=True)
    values: Float[np.ndarray, " points"]
    deviance: Float[np.ndarray, " points"]
    others: Float[np.ndarray, "points parameters"]

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of a level from the deviance.

        An end beyond the profile, such as at a bound, is the last value of the profile.
        """
        import scipy

        centre = self.fit.theta[self.fit.names.index(self.name)]
        root = np.sign(self.values - centre) * np.sqrt(self.deviance)
        along = scipy.interpolate.PchipInterpolator(self.values, root)
        reach = float(np.sqrt(scipy.stats.chi2.ppf(level, 1)))
        ends = []
        for sign, end in ((-1, self.values[0]), (1, self.values[-1])):
            if sign * float(along(end)) <= reach:
                ends.append(float(end))
                continue
            goal = sign * reach
            found = scipy.optimize.root_scalar(
                lambda x, g=goal: float(along(x)) - g, bracket=(float(centre), float(end))
            )
            ends.append(float(found.root))
        return ends[0], ends[1]

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return self.fit.units[self.fit.names.index(self.name)]

    def plot(self) -> "go.Figure":
        """Deviance along the profile, and the parabola that follows from the fit's deviation."""
        from ..display import figures

        k = self.fit.names.index(self.name)
        centre, std = float(self.fit.theta[k]), float(self.fit.std[k])
        return figures.deviance(self.values, self.deviance, centre, std, self.name, self.unit)

    def __repr__(self) -> str:
        low, high = self.interval()
        return f"{self.name}: 95 % from {low:.4g} to {high:.4g} {self.unit} by likelihood profile"

    def _repr_html_(self) -> str:
        import pandas as pd

        shares = (0.68, 0.95, 0.997)
        rows = [self.interval(share) for share in shares]
        table = pd.DataFrame(rows, index=[f"{100 * x:g} %" for x in shares])
        table.columns = [f"{end} ({self.unit})" for end in ("low", "high")]
        head = f"<p>{html.escape(self.name)}: intervals by likelihood profile</p>"
        return head + table.to_html(float_format=lambda x: f"{x:.4g}")


def profile(fit: Fit, *names: str, progress: bool = True) -> dict[str, Profile]:
    """Likelihood profiles; all points of all profiles are fitted at once, vmapped.

    For a fit with sandwich deviations the error is not white, and the deviance is scaled by the
    ratio of the variance by (A.1) to that of the sandwich (Pace, Salvan, Sartori 2011).

    **Arguments:**

    - `fit`: by `OEM`, `SeparablePEM` or `JointPEM`; the noise filters of the former two are kept.
    - `names`: names of parameters; by default all.
    - `progress`: whether to show progress on a terminal.

    **Raises:** `FitError` for a fit by regression, or a parameter that it does not determine.
    """
    optimum = optimum_of(fit, "profile")
    names = names or fit.names
    places = [_place(fit, name) for name in names]
    white, _ = covariance_of(optimum, "white")
    width = np.sqrt(np.diag(white))
    low, high = np.asarray(optimum.problem.lower), np.asarray(optimum.problem.upper)
    theta = np.asarray(optimum.theta)
    scaled = "sandwich" in fit.deviations
    points = {
        k: np.unique(np.clip(theta[k] + width[k] * REACH * _stretch(fit, width, k, scaled),
                             low[k], high[k]))
        for k in places
    }  # fmt: skip
    lanes = Lanes.around(optimum, sum(len(x) for x in points.values()))
    held_low, held_high, start = (np.array(x) for x in (lanes.lower, lanes.upper, lanes.theta))
    row = 0
    for k, values in points.items():
        for value in values:
            held_low[row, k] = held_high[row, k] = start[row, k] = value
            row += 1
    lanes = dataclasses.replace(
        lanes,
        lower=jnp.asarray(held_low),
        upper=jnp.asarray(held_high),
        theta=jnp.asarray(start),
    )
    with working(f"profile of {fit.loop.name}", progress) as say:
        found = refit(optimum, lanes, say=say)
    loss, ended = np.asarray(found.loss), np.asarray(found.theta)[:, : len(theta)]
    base, variance = _loss_and_variance(optimum)
    profiles, row = {}, 0
    for name, (k, values) in zip(names, points.items(), strict=True):
        rows = slice(row, row + len(values))
        row += len(values)
        share = 1 / _stretch(fit, width, k, scaled) ** 2
        deviance = np.maximum(loss[rows] - base, 0.0) / variance * share
        # The estimate is a point of its profile, possibly already present at a bound.
        apart = values != theta[k]
        order = np.argsort(np.append(values[apart], theta[k]))
        p = len(fit.names)
        profiles[name] = Profile(
            fit,
            name,
            np.append(values[apart], theta[k])[order],
            np.append(deviance[apart], 0.0)[order],
            np.vstack([ended[rows][apart, :p], theta[None, :p]])[order],
        )
    return profiles


def _place(fit: Fit, name: str) -> int:
    if name not in fit.names:
        raise FitError(f"{name!r} was not estimated: this fit has {', '.join(fit.names)}")
    k = fit.names.index(name)
    if not np.isfinite(fit.std[k]):
        raise FitError(f"{name} has no profile: these recordings do not determine it")
    return k


def _stretch(fit: Fit, white: Float[np.ndarray, " parameters"], k: int, scaled: bool) -> float:
    """Factor by which the profile is wider than according to (A.1)."""
    return float(fit.std[k] / white[k]) if scaled else 1.0


def _loss_and_variance(optimum) -> tuple[float, float]:
    """Squared error at the minimum, and the variance of one filtered residual, its unit."""
    reduced = Reduced.of(optimum)
    loss = sum(float(np.sum(r**2)) for r in reduced.residuals)
    rows = float(sum(np.sum(f) for f in reduced.filled()))
    return loss, loss / (rows - float(np.sum(reduced.spent)))
