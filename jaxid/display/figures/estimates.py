"""Figures of estimates: parameters with deviations, likelihood profiles, candidates."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float

from .look import BLUE, INK, ORANGE, bar, finish, with_unit


def parameters(
    names: Sequence[str],
    values: Float[np.ndarray, " parameters"],
    stds: Float[np.ndarray, " parameters"],
    units: Sequence[str],
    truth: Float[np.ndarray, " parameters"] | None = None,
    *,
    title: str | None = None,
) -> go.Figure:
    """Draw one row per parameter: two standard deviations on either side, relative to the value.

    Arguments:
        names: Symbols, one for each parameter.
        values: Estimates in `units`, shape `(parameters,)`.
        stds: Standard deviations in `units`, shape `(parameters,)`.
        units: Unit of each parameter, as printed.
        truth: Known or published values in `units`, shape `(parameters,)`.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(names), dtype=float)
    # A value of zero has no relative deviation, so it is scaled by its standard deviation.
    scale = np.where(values != 0, np.abs(values), np.where(stds > 0, stds, 1.0)) / 100
    figure.add_scatter(
        x=np.zeros(len(names)),
        y=place,
        name="estimate ± 2σ",
        mode="markers",
        marker={"color": BLUE, "size": 9},
        error_x={"array": 2 * stds / scale, "color": BLUE, "thickness": 2, "width": 5},
    )
    if truth is not None:
        marker = {"symbol": "diamond-open", "color": ORANGE, "size": 11, "line": {"width": 2}}
        away = (truth - values) / scale
        figure.add_scatter(x=away, y=place, name="reference", mode="markers", marker=marker)
    rows = zip(names, values, stds, units, strict=True)
    labels = [f"<b>{name}</b>  {_value(value, std, unit)}" for name, value, std, unit in rows]
    figure.update_yaxes(
        title_text="parameter",
        tickvals=place,
        ticktext=labels,
        range=[len(names) - 0.4, -0.6],
        zeroline=False,
    )
    figure.update_xaxes(title_text=with_unit("deviation from the estimate", "%"))
    return finish(figure, title, height=130 + 30 * len(names), legend=True)


def deviance(
    values: Float[np.ndarray, " points"],
    lost: Float[np.ndarray, " points"],
    centre: float,
    std: float,
    name: str,
    unit: str,
    *,
    title: str | None = None,
) -> go.Figure:
    """Draw a likelihood profile with the parabola predicted by the standard deviation.

    Arguments:
        values: Fixed values of the parameter, shape `(points,)`, in `unit`.
        lost: Deviance at these values, shape `(points,)`.
        centre: The estimate, in `unit`.
        std: Its standard deviation, in `unit`.
        name: Name of the parameter.
        unit: Unit of the parameter.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    x = np.linspace(min(values[0], centre - 3 * std), values[-1], 121)
    line = {"color": ORANGE, "dash": "dash"}
    parabola = ((x - centre) / std) ** 2
    figure.add_scatter(x=x, y=parabola, name="from the deviation", mode="lines", line=line)
    marker = {"color": BLUE, "size": 9}
    figure.add_scatter(x=values, y=lost, name="profile", mode="markers", marker=marker)
    figure.add_hline(y=3.84, line={"color": INK, "dash": "dot"}, annotation_text="95 %")
    figure.update_xaxes(title_text=with_unit(name, unit))
    figure.update_yaxes(title_text="deviance", range=[0, 10])
    return finish(figure, title, height=360, legend=True)


def differences(
    labels: Sequence[str],
    values: Float[np.ndarray, " rows"],
    half: Float[np.ndarray, " rows"],
    *,
    x_name: str,
    x_unit: str,
    title: str | None = None,
) -> go.Figure:
    """Draw differences with their intervals, one row each, and a line at no difference.

    Arguments:
        labels: One for each row.
        values: Differences in `x_unit`, shape `(rows,)`.
        half: Half-widths of their intervals in `x_unit`, shape `(rows,)`.
        x_name: Name of the quantity whose differences are drawn.
        x_unit: Unit, as printed.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(labels), dtype=float)
    figure.add_scatter(
        x=values,
        y=place,
        name="difference, 95 % interval",
        mode="markers",
        marker={"color": BLUE, "size": 9},
        error_x={"array": half, "color": BLUE, "thickness": 2, "width": 5},
    )
    figure.add_vline(x=0, line={"color": INK, "dash": "dot"})
    figure.update_yaxes(
        tickvals=place, ticktext=list(labels), range=[len(labels) - 0.4, -0.6], zeroline=False
    )
    figure.update_xaxes(title_text=with_unit(x_name, x_unit))
    return finish(figure, title, height=140 + 34 * len(labels), legend=True)


def ranking(
    labels: Sequence[str],
    explained: Float[np.ndarray, " candidates"],
    significant: Bool[np.ndarray, " candidates"],
    *,
    x_name: str = "share of the residual explained",
    x_unit: str = "%",
    title: str | None = None,
) -> go.Figure:
    """Draw candidates as horizontal bars in the order given, the first on top.

    Arguments:
        labels: One for each candidate.
        explained: Amount that each explains, in `x_unit`, shape `(candidates,)`.
        significant: Whether that amount is significant, shape `(candidates,)`.
        x_name: Name of the quantity that the bars show.
        x_unit: Unit, as printed.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(labels), dtype=float)
    styles = (("significant", significant, BLUE, ""), ("not significant", ~significant, INK, "/"))
    for name, chosen, colour, pattern in styles:
        figure.add_bar(
            x=explained[chosen],
            y=place[chosen],
            name=name,
            orientation="h",
            width=0.66,
            text=[f"{value:.3g}" for value in explained[chosen]],
            textposition="outside",
            cliponaxis=False,
            marker=bar(colour, pattern),
        )
    figure.update_yaxes(
        title_text="candidate",
        tickvals=place,
        ticktext=list(labels),
        range=[len(labels) - 0.4, -0.6],
        showgrid=False,
    )
    figure.update_xaxes(title_text=with_unit(x_name, x_unit), rangemode="tozero")
    figure.update_layout(barmode="overlay")
    return finish(figure, title, height=130 + 28 * len(labels), legend=True)


def _value(value: float, std: float, unit: str) -> str:
    """Give a value with its standard deviation to two digits, and the unit."""
    if not np.isfinite(std) or std <= 0:
        return f"{value:.4g} {unit}".strip()
    digits = max(0, 1 - int(np.floor(np.log10(std))))
    if digits > 6 or abs(value) >= 1e5:
        return f"{value:.3g} ± {std:.2g} {unit}".strip()
    return f"{value:.{digits}f} ± {std:.{digits}f} {unit}".strip()
