"""Figures of residuals: autocorrelation, and dependence on a coordinate."""

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float, Real

from .look import BLUE, INK, finish, with_unit
from .panels import add_acf, band_trace, small

MAX_DOTS = 2000


def autocorrelation(
    lags: Real[np.ndarray, " lags"],
    acf: Float[np.ndarray, " lags"],
    bound: float,
    *,
    title: str | None = None,
) -> go.Figure:
    """Draw an autocorrelation with the band expected for a white residual.

    Arguments:
        lags: In samples, shape `(lags,)`.
        acf: Autocorrelation, shape `(lags,)`.
        bound: Two standard deviations of a white residual's autocorrelation.
        title: Title of the whole figure.
    """
    figure = go.Figure().set_subplots(rows=1, cols=1)
    add_acf(figure, lags, acf, bound, 1, 1)
    figure.update_xaxes(title_text="lag (samples)")
    figure.update_yaxes(title_text="autocorrelation")
    return finish(figure, title, height=340, legend=False)


def curve_fit(
    x: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " samples"],
    x_name: str,
    x_unit: str,
    y_unit: str,
    curve_x: Float[np.ndarray, " points"],
    curve: Float[np.ndarray, " points"],
    band: Float[np.ndarray, " points"] | None = None,
    *,
    y_name: str = "residual",
    curve_name: str = "fitted curve",
    title: str | None = None,
) -> go.Figure:
    """Draw a residual against a coordinate, with a fitted curve and its confidence band.

    Arguments:
        x: Coordinate in `x_unit`, shape `(samples,)`.
        y: Residual in `y_unit`, shape `(samples,)`; of many samples, 2000 are drawn.
        x_name: Name of the coordinate, such as "velocity of joint 2".
        x_unit: Unit, as printed.
        y_unit: Unit, as printed.
        curve_x: Coordinates of the curve, in `x_unit`, ascending, shape `(points,)`.
        curve: Fitted curve in `y_unit`, shape `(points,)`.
        band: Half-width of the confidence band in `y_unit`, shape `(points,)`.
        y_name: Name of the vertical axis.
        curve_name: Name of the curve in the legend.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    # Every k-th sample would alias with a periodic motion; a random sample does not.
    most = len(x) if len(x) < 1.25 * MAX_DOTS else MAX_DOTS
    few = np.sort(np.random.default_rng(0).permutation(len(x))[:most])
    name = y_name if len(few) == len(x) else f"{y_name} ({len(few)} of {len(x)} samples)"
    dots = {"color": INK, "size": 3.5, "opacity": 0.6}
    if len(x):
        figure.add_scatter(x=small(x[few]), y=small(y[few]), name=name, mode="markers", marker=dots)
    if band is not None:
        figure.add_trace(band_trace("95 % band", curve_x, curve - band, curve + band))
    line = {"color": BLUE, "width": 2.6}
    figure.add_scatter(x=curve_x, y=curve, name=curve_name, mode="lines", line=line)
    figure.update_xaxes(title_text=with_unit(x_name, x_unit))
    figure.update_yaxes(title_text=with_unit(y_name, y_unit))
    # The dots are too small for a legend.
    figure.update_layout(legend={"itemsizing": "constant"})
    return finish(figure, title, height=400, legend=True)


def dependence(
    x: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " samples"],
    x_name: str,
    x_unit: str,
    y_unit: str,
    *,
    y_name: str = "residual",
    title: str | None = None,
) -> go.Figure:
    """Draw a residual against a coordinate, with its mean in bins of equal count.

    The band is two standard errors on either side, for independent samples.

    Arguments:
        x: Coordinate in `x_unit`, shape `(samples,)`.
        y: Residual in `y_unit`, shape `(samples,)`.
        x_name: Name of the coordinate, such as "velocity of joint 2".
        x_unit: Unit, as printed.
        y_unit: Unit, as printed.
        y_name: Name of the vertical axis.
        title: Title of the whole figure.
    """
    order = np.array_split(np.argsort(x, kind="stable"), max(2, min(30, len(x) // 20)))
    middle = np.array([np.median(x[k]) for k in order])
    mean = np.array([np.mean(y[k]) for k in order])
    error = np.array([2 * np.std(y[k]) / np.sqrt(len(k)) for k in order])
    # If the coordinate is constant for a while, several bins have the same position; a line needs
    # distinct ones.
    distinct = np.append(True, np.diff(middle) > 0)
    line = middle[distinct], mean[distinct], error[distinct]
    names = {"y_name": y_name, "curve_name": "mean", "title": title}
    return curve_fit(x, y, x_name, x_unit, y_unit, *line, **names)
