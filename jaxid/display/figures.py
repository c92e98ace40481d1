"""Drawings of plain arrays with names and units; every function returns a plotly figure.

Colours and text are of middle luminance and the page shows through, so one figure reads on a light
page and on a dark one; what differs in colour also differs in width, dash, marker or pattern, so
it reads in grey as well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import cycle
from textwrap import wrap
from typing import Any, Literal

import numpy as np
import plotly
import plotly.graph_objects as go
from jaxtyping import Bool, Float, Real

Role = Literal["measured", "simulated", "residual", "reference", "band"]

MAX_POINTS = 4000
MAX_DOTS = 2000
MAX_GAPS = 40
MAX_LEGEND = 9

INK = "#7b818b"
GRID = "rgba(128,134,145,0.22)"
SHADE = "rgba(128,134,145,0.20)"
MISFIT = "rgba(216,69,90,0.20)"
BLUE, ORANGE, GREEN, PURPLE, RED = "#2f86dd", "#dd7320", "#219b73", "#9a66d8", "#d8455a"
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, RED, "#96891c", "#c458a6", INK)
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
MARKERS = ("circle", "square", "diamond", "triangle-up", "cross", "x", "star", "pentagon")
PATTERNS = ("", "/", "x", ".", "\\", "-", "|", "+")

# The measured line is wide and pale so that the thin simulated one is seen on top of it.
ROLE_LINES: dict[str, dict] = {
    "measured": {"color": "rgba(128,134,145,0.75)", "width": 3.2},
    "simulated": {"color": BLUE, "width": 1.4},
    "residual": {"color": ORANGE, "width": 1.1},
    "reference": {"color": GREEN, "width": 1.4, "dash": "dot"},
}


@dataclass(frozen=True)
class Trace:
    """One line of a panel, or a band between two lines.

    Arguments:
        name: What the legend calls it.
        values: Samples in `unit`; for the role "band" two columns, lower and upper.
        unit: Unit, as printed.
        role: What it is, which decides how it is drawn.
    """

    name: str
    values: Float[np.ndarray, " samples"] | Float[np.ndarray, "samples 2"]
    unit: str
    role: Role = "measured"


@cache
def theme() -> go.layout.Template:
    """Give the template of all figures, registered in plotly as `jaxid`."""
    axis = {
        "gridcolor": GRID,
        "zerolinecolor": "rgba(128,134,145,0.45)",
        "zerolinewidth": 1,
        "linecolor": INK,
        "showline": True,
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": INK,
        "automargin": True,
        "title": {"standoff": 8, "font": {"size": 13}},
        "hoverformat": ".4~g",
    }
    template = go.layout.Template(
        layout={
            "font": {
                "family": "Inter, system-ui, 'Segoe UI', Roboto, Helvetica, Arial, sans-serif",
                "size": 12.5,
                "color": INK,
            },
            "title": {"x": 0.0, "xref": "paper", "font": {"size": 17}, "yref": "container"},
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "colorway": list(PALETTE),
            "xaxis": axis,
            "yaxis": axis,
            "legend": {
                "orientation": "h",
                "x": 0.0,
                "xanchor": "left",
                "y": 1.0,
                "yanchor": "bottom",
                "bgcolor": "rgba(0,0,0,0)",
            },
            "margin": {"l": 70, "r": 20, "t": 50, "b": 50},
            "hovermode": "closest",
            "bargap": 0.3,
            "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": INK, "activecolor": BLUE},
        }
    )
    plotly.io.templates["jaxid"] = template
    return template


def signals(
    time: Float[np.ndarray, " samples"],
    panels: Sequence[Sequence[Trace]],
    *,
    titles: Sequence[str] | None = None,
    title: str | None = None,
) -> go.Figure:
    """Draw stacked panels over one time axis; jumps in time and missing samples are shaded.

    Arguments:
        time: Sampling times in s, shape `(samples,)`.
        panels: Top to bottom, the traces of each panel; a panel of residuals only is half as high.
        titles: What each panel shows ("joint 1 torque"); the first trace's name if absent.
        title: Of the whole figure.
    """
    if not panels or not all(panels):
        raise ValueError("signals() draws panels of at least one trace each; one is empty.")
    heights = [1.0 if any(t.role != "residual" for t in panel) else 0.5 for panel in panels]
    figure = go.Figure().set_subplots(
        rows=len(panels), cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=heights
    )
    names = titles or [panel[0].name for panel in panels]
    for row, (name, panel) in enumerate(zip(names, panels, strict=True), start=1):
        _add_panel(figure, time, panel, row)
        figure.update_yaxes(title_text=_with_unit(name, panel[0].unit), row=row, col=1)
    _shade_gaps(figure, time, [trace for panel in panels for trace in panel])
    figure.update_xaxes(title_text="time (s)", row=len(panels), col=1)
    return _finish(figure, title, height=round(140 + 190 * sum(heights)), legend=True)


def comparison(
    time: Float[np.ndarray, " samples"],
    measured: Float[np.ndarray, "samples joints"],
    simulated: Float[np.ndarray, "samples joints"],
    residual: Float[np.ndarray, "samples joints"],
    acf: Float[np.ndarray, "lags joints"],
    acf_bound: float,
    joint_names: Sequence[str],
    unit: str | Sequence[str],
    title: str | None = None,
) -> go.Figure:
    """Draw per joint measured, simulated and residual, and the residual's autocorrelation.

    Arguments:
        time: Sampling times in s, shape `(samples,)`.
        measured: Measured signal in `unit`, shape `(samples, joints)`.
        simulated: Simulated signal in `unit`, shape `(samples, joints)`.
        residual: Their difference in `unit`, shape `(samples, joints)`.
        acf: Autocorrelation of the residual from lag 0 on, shape `(lags, joints)`.
        acf_bound: Two standard deviations of a white residual's autocorrelation.
        joint_names: As printed, one for each joint.
        unit: Of the signal, one for all joints or one for each.
        title: Of the whole figure.
    """
    if len(acf) < 2 or np.any(np.abs(acf[0] - 1) > 1e-6):
        raise ValueError("comparison() takes the autocorrelation from lag 0, where it is 1.")
    joints = len(joint_names)
    units = [unit] * joints if isinstance(unit, str) else list(unit)
    figure = _comparison_grid(joints)
    reach = max(1.1 * float(np.nanmax(np.abs(acf[1:]), initial=0.0)), 4 * acf_bound)
    drawn = []
    for joint, name in enumerate(joint_names):
        upper = [
            Trace("measured", measured[:, joint], units[joint], "measured"),
            Trace("simulated", simulated[:, joint], units[joint], "simulated"),
        ]
        lower = [Trace("residual", residual[:, joint], units[joint], "residual")]
        row = 2 * joint + 1
        _add_panel(figure, time, upper, row)
        _add_panel(figure, time, lower, row + 1)
        _add_acf(figure, np.arange(1, len(acf)), acf[1:, joint], acf_bound, row, 2)
        figure.update_yaxes(title_text=_with_unit(name, units[joint]), row=row, col=1)
        figure.update_yaxes(title_text=_with_unit("residual", units[joint]), row=row + 1, col=1)
        figure.update_yaxes(title_text="autocorrelation", range=[-reach, reach], row=row, col=2)
        drawn += upper + lower
    _shade_gaps(figure, time, drawn)
    for row in range(1, 2 * joints + 1):
        # An axis that matches itself is what plotly warns of in a browser's console.
        figure.update_xaxes(matches="x" if row > 1 else None, showticklabels=False, row=row, col=1)
    figure.update_xaxes(title_text="time (s)", showticklabels=True, row=2 * joints, col=1)
    figure.update_xaxes(showticklabels=False, col=2)
    last: dict[str, Any] = {"row": 2 * joints - 1, "col": 2}
    figure.update_xaxes(title_text="lag (samples)", showticklabels=True, **last)
    return _finish(figure, title, height=140 + 290 * joints, legend=True)


def mark_misfit(
    figure: go.Figure, joint: int, spans: Sequence[tuple[float, float]], name: str = "misfit"
) -> go.Figure:
    """Shade stretches of one joint in a comparison; the longest 40 are drawn.

    Arguments:
        figure: What `comparison` gave; it is changed.
        joint: Counted from 1.
        spans: Start and end of each stretch, s.
        name: What the legend calls them.
    """
    longest = sorted(spans, key=lambda span: span[0] - span[1])[:MAX_GAPS]
    for row in (2 * joint - 1, 2 * joint):
        cell: dict[str, Any] = {"row": row, "col": 1}
        for start, end in longest:
            edges = {"x0": float(start), "x1": float(end), "line": {"width": 0}}
            figure.add_vrect(fillcolor=MISFIT, layer="below", **edges, **cell)
    present: Any = figure.data
    if longest and all(trace.name != name for trace in present):
        square = {"symbol": "square", "size": 12, "color": MISFIT}
        figure.add_scatter(x=[None], y=[None], name=name, mode="markers", marker=square)
    return figure


def error_bars(
    labels: Sequence[str],
    groups: Sequence[str],
    values: Float[np.ndarray, "groups labels"],
    floor: Float[np.ndarray, " labels"] | None = None,
    *,
    x_name: str = "joint",
    title: str | None = None,
) -> go.Figure:
    """Draw the relative error as grouped bars, with the noise floor as a line across each group.

    Arguments:
        labels: One for each group of bars, such as joints.
        groups: One for each bar of a group, such as recordings.
        values: Relative error in %, shape `(groups, labels)`.
        floor: Error in % that noise alone leaves, shape `(labels,)`.
        x_name: What the labels are.
        title: Of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(labels), dtype=float)
    styles = zip(cycle(PALETTE), cycle(PATTERNS))
    for group, row, (colour, pattern) in zip(groups, values, styles, strict=False):
        marker = _bar(colour, pattern)
        hover = f"{group}, %{{x}}: %{{y:.3~g}} %<extra></extra>"
        figure.add_bar(x=place, y=row, name=group, marker=marker, hovertemplate=hover)
    if floor is not None:
        half = 0.42
        x = np.stack([place - half, place + half, np.full_like(place, np.nan)], axis=1).ravel()
        figure.add_scatter(x=x, y=np.repeat(floor, 3), **_floor_line())
    figure.update_xaxes(
        title_text=x_name, tickvals=place, ticktext=list(labels), showgrid=False, zeroline=False
    )
    figure.update_yaxes(title_text=_with_unit("relative error", "%"), rangemode="tozero")
    figure.update_layout(barmode="group")
    return _finish(figure, title, height=380, legend=True)


def error_falling(
    steps: Sequence[str],
    series: Mapping[str, Float[np.ndarray, "steps joints"]],
    floor: Float[np.ndarray, " joints"] | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    title: str | None = None,
) -> go.Figure:
    """Draw the relative error of each joint, step by step.

    Arguments:
        steps: What each step added, the start first.
        series: Relative error in %, shape `(steps, joints)`, by the name of the recordings it was
            taken on: the first is drawn solid (fitted), the next dashed (held out).
        floor: Error in % that noise alone leaves, shape `(joints,)`; dotted.
        joint_names: As printed; "joint 1" and so on if absent.
        title: Of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(steps), dtype=float)
    joints = max((values.shape[1] for values in series.values()), default=0)
    names = joint_names or [f"joint {joint + 1}" for joint in range(joints)]
    for joint, (name, colour, marker) in enumerate(zip(names, cycle(PALETTE), cycle(MARKERS))):
        for (kind, values), dash in zip(series.items(), cycle(DASHES)):
            open_marker = marker if dash == "solid" else f"{marker}-open"
            figure.add_scatter(
                x=place,
                y=values[:, joint],
                name=f"{name}, {kind}",
                mode="lines+markers",
                line={"color": colour, "dash": dash, "width": 2},
                marker={"symbol": open_marker, "size": 9},
            )
        if floor is not None:
            line = _floor_line(f"{name}, noise floor", colour)
            figure.add_scatter(x=place[[0, -1]], y=np.full(2, floor[joint]), **line)
    figure.update_xaxes(
        title_text="step",
        tickvals=place,
        ticktext=["<br>".join(wrap(step, 16)) for step in steps],
        range=[-0.35, len(steps) - 0.65],
        showgrid=False,
        zeroline=False,
    )
    figure.update_yaxes(title_text=_with_unit("relative error", "%"), rangemode="tozero")
    return _finish(figure, title, height=430, legend=True)


def autocorrelation(
    lags: Real[np.ndarray, " lags"],
    acf: Float[np.ndarray, " lags"],
    bound: float,
    *,
    title: str | None = None,
) -> go.Figure:
    """Draw an autocorrelation with the band in which a white residual's would lie.

    Arguments:
        lags: In samples, shape `(lags,)`.
        acf: Autocorrelation, shape `(lags,)`.
        bound: Two standard deviations of a white residual's autocorrelation.
        title: Of the whole figure.
    """
    figure = go.Figure().set_subplots(rows=1, cols=1)
    _add_acf(figure, lags, acf, bound, 1, 1)
    figure.update_xaxes(title_text="lag (samples)")
    figure.update_yaxes(title_text="autocorrelation")
    return _finish(figure, title, height=340, legend=False)


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
        y: Residual in `y_unit`, shape `(samples,)`; at most 2000 samples are drawn.
        x_name: What the coordinate is, such as "velocity of joint 2".
        x_unit: Unit, as printed.
        y_unit: Unit, as printed.
        curve_x: Where the curve is given, in `x_unit`, ascending, shape `(points,)`.
        curve: Fitted curve in `y_unit`, shape `(points,)`.
        band: Half-width of the confidence band in `y_unit`, shape `(points,)`.
        y_name: What is drawn upwards.
        curve_name: What the legend calls the curve.
        title: Of the whole figure.
    """
    figure = go.Figure()
    # Every k-th sample would beat with a periodic motion; a drawn sample does not.
    few = np.sort(np.random.default_rng(0).permutation(len(x))[:MAX_DOTS])
    name = y_name if len(few) == len(x) else f"{y_name} ({len(few)} of {len(x)} samples)"
    dots = {"color": INK, "size": 3.5, "opacity": 0.6}
    figure.add_scatter(x=_small(x[few]), y=_small(y[few]), name=name, mode="markers", marker=dots)
    if band is not None:
        figure.add_trace(_band_trace("confidence band", curve_x, curve - band, curve + band))
    line = {"color": BLUE, "width": 2.6}
    figure.add_scatter(x=curve_x, y=curve, name=curve_name, mode="lines", line=line)
    figure.update_xaxes(title_text=_with_unit(x_name, x_unit))
    figure.update_yaxes(title_text=_with_unit(y_name, y_unit))
    return _finish(figure, title, height=400, legend=True)


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
    """Draw a residual against a coordinate, with its mean in stretches of equal count.

    The band is two standard errors either side, as of independent samples.

    Arguments:
        x: Coordinate in `x_unit`, shape `(samples,)`.
        y: Residual in `y_unit`, shape `(samples,)`.
        x_name: What the coordinate is, such as "velocity of joint 2".
        x_unit: Unit, as printed.
        y_unit: Unit, as printed.
        y_name: What is drawn upwards.
        title: Of the whole figure.
    """
    order = np.array_split(np.argsort(x, kind="stable"), max(2, min(30, len(x) // 20)))
    middle = np.array([np.median(x[k]) for k in order])
    mean = np.array([np.mean(y[k]) for k in order])
    error = np.array([2 * np.std(y[k]) / np.sqrt(len(k)) for k in order])
    # A coordinate that stands still gives several stretches one place, which a line cannot have.
    distinct = np.append(True, np.diff(middle) > 0)
    line = middle[distinct], mean[distinct], error[distinct]
    names = {"y_name": y_name, "curve_name": "mean", "title": title}
    return curve_fit(x, y, x_name, x_unit, y_unit, *line, **names)


def parameters(
    names: Sequence[str],
    values: Float[np.ndarray, " parameters"],
    stds: Float[np.ndarray, " parameters"],
    units: Sequence[str],
    truth: Float[np.ndarray, " parameters"] | None = None,
    *,
    title: str | None = None,
) -> go.Figure:
    """Draw one row a parameter: two standard deviations either side, relative to the value.

    Arguments:
        names: Symbols, one for each parameter.
        values: Estimates in `units`, shape `(parameters,)`.
        stds: Standard deviations in `units`, shape `(parameters,)`.
        units: Unit of each parameter, as printed.
        truth: Known or published values in `units`, shape `(parameters,)`.
        title: Of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(names), dtype=float)
    # A value of zero has no relative deviation; its own standard deviation is the next best scale.
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
    figure.update_xaxes(title_text=_with_unit("deviation from the estimate", "%"))
    return _finish(figure, title, height=130 + 30 * len(names), legend=True)


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
    """Draw a likelihood profile beside the parabola that its deviation promises.

    Arguments:
        values: At which the parameter was held, shape `(points,)`, in `unit`.
        lost: Deviance there, shape `(points,)`.
        centre: The estimate, in `unit`.
        std: Its standard deviation, in `unit`.
        name: Of the parameter.
        unit: Of the parameter.
        title: Of the whole figure.
    """
    figure = go.Figure()
    x = np.linspace(min(values[0], centre - 3 * std), values[-1], 121)
    line = {"color": ORANGE, "dash": "dash"}
    parabola = ((x - centre) / std) ** 2
    figure.add_scatter(x=x, y=parabola, name="as the deviation has it", mode="lines", line=line)
    marker = {"color": BLUE, "size": 9}
    figure.add_scatter(x=values, y=lost, name="profile", mode="markers", marker=marker)
    figure.add_hline(y=3.84, line={"color": INK, "dash": "dot"}, annotation_text="95 %")
    figure.update_xaxes(title_text=_with_unit(name, unit))
    figure.update_yaxes(title_text="deviance", range=[0, 10])
    return _finish(figure, title, height=360, legend=True)


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
        explained: What each explains, in `x_unit`, shape `(candidates,)`.
        significant: Whether that is more than chance, shape `(candidates,)`.
        x_name: What the bars measure.
        x_unit: Unit, as printed.
        title: Of the whole figure.
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
            marker=_bar(colour, pattern),
        )
    figure.update_yaxes(
        title_text="candidate",
        tickvals=place,
        ticktext=list(labels),
        range=[len(labels) - 0.4, -0.6],
        showgrid=False,
    )
    figure.update_xaxes(title_text=_with_unit(x_name, x_unit), rangemode="tozero")
    figure.update_layout(barmode="overlay")
    return _finish(figure, title, height=130 + 28 * len(labels), legend=True)


def shares_in_time(
    time: Float[np.ndarray, " samples"],
    residual: Float[np.ndarray, " samples"],
    shares: Mapping[str, Float[np.ndarray, " samples"]],
    *,
    unit: str = "N·m",
    title: str | None = None,
) -> go.Figure:
    """Draw a residual with what the first rival explains of it, each rival's share, and the rest.

    Arguments:
        time: Sampling times in s, shape `(samples,)`.
        residual: In `unit`, shape `(samples,)`.
        shares: What each rival alone explains of it, in `unit`, shape `(samples,)`, by its name,
            the leading one first.
        unit: As printed.
        title: Of the whole figure.
    """
    # Rivals stand in for each other: to add them up would explain the same thing twice.
    leading, explained = next(iter(shares.items()), ("nothing", np.zeros_like(residual)))
    figure = go.Figure().set_subplots(
        rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=[1.0, 1.0, 0.6]
    )
    whole = [
        Trace("residual", residual, unit, "measured"),
        Trace(f"explained by {leading}", explained, unit, "simulated"),
    ]
    _add_panel(figure, time, whole, 1)
    for (name, share), colour, dash in zip(shares.items(), cycle(PALETTE[2:]), cycle(DASHES)):
        x, y = _decimated(*_broken_at_gaps(time, share))
        line = {"color": colour, "dash": dash, "width": 1.6}
        figure.add_scatter(x=x, y=y, name=name, mode="lines", line=line, row=2, col=1)
    rest = Trace("rest", residual - explained, unit, "residual")
    _add_panel(figure, time, [rest], 3)
    for row, name in enumerate(("residual", "share", "rest"), start=1):
        figure.update_yaxes(title_text=_with_unit(name, unit), row=row, col=1)
    # One scale for all three, so that a share is seen against the whole.
    figure.update_yaxes(matches="y")
    _shade_gaps(figure, time, whole)
    figure.update_xaxes(title_text="time (s)", row=3, col=1)
    return _finish(figure, title, height=590, legend=True)


def _comparison_grid(joints: int) -> go.Figure:
    """Give for each joint a high and a low panel on the left, and one beside both."""
    return go.Figure().set_subplots(
        rows=2 * joints,
        cols=2,
        specs=[[{}, {"rowspan": 2}], [{}, None]] * joints,
        column_widths=[0.72, 0.28],
        row_heights=[1.0, 0.5] * joints,
        horizontal_spacing=0.11,
        vertical_spacing=0.14 / (2 * joints),
    )


def _add_panel(figure: go.Figure, time: np.ndarray, traces: Sequence[Trace], row: int) -> None:
    """Add traces to the left column's panel, once to the legend for each name."""
    present: Any = figure.data
    seen = {trace.name for trace in present}
    roles: list[str] = []
    for trace in traces:
        x, y = _broken_at_gaps(time, trace.values)
        if trace.role == "band":
            drawn = _band_trace(trace.name, x, y[:, 0], y[:, 1])
        else:
            x, y = _decimated(x, y)
            line = dict(ROLE_LINES[trace.role])
            # A second line of the same role in one panel differs by its dash.
            line.setdefault("dash", DASHES[roles.count(trace.role) % len(DASHES)])
            drawn = go.Scatter(x=x, y=y, name=trace.name, mode="lines", line=line)
        drawn.update(legendgroup=trace.name, showlegend=trace.name not in seen)
        figure.add_trace(drawn, row=row, col=1)
        roles.append(trace.role)
        seen.add(trace.name)


def _add_acf(
    figure: go.Figure, lags: np.ndarray, acf: np.ndarray, bound: float, row: int, col: int
) -> None:
    """Add stems, those outside the band in the residual's colour, and the band."""
    outside = np.abs(acf) > bound
    outside[np.asarray(lags) == 0] = False
    colours = np.where(outside, ORANGE, INK).tolist()
    figure.add_bar(
        x=lags,
        y=acf,
        name="autocorrelation",
        width=np.where(outside, 0.6, 0.35),
        marker={"color": colours},
        showlegend=False,
        row=row,
        col=col,
    )
    cell: dict[str, Any] = {"row": row, "col": col}
    figure.add_hrect(y0=-bound, y1=bound, fillcolor=SHADE, line={"width": 0}, layer="below", **cell)
    for level in (-bound, bound):
        figure.add_hline(y=level, line={"color": INK, "width": 1, "dash": "dash"}, **cell)


def _band_trace(name: str, x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> go.Scatter:
    """Give a band as one outline for each stretch without missing values."""
    every = -(-len(x) // MAX_POINTS)
    # A missing sample must survive the thinning, or the outline would close over the gap.
    whole = np.isfinite(lower) & np.isfinite(upper)
    kept = np.unique(np.concatenate([np.arange(0, len(x), every), np.flatnonzero(~whole)]))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], whole[kept], [False]]).astype(int)))
    outlines: list[list[np.ndarray]] = [[], []]
    for start, end in edges.reshape(-1, 2):
        run = kept[start:end]
        outlines[0] += [x[run], x[run][::-1], np.array([np.nan])]
        outlines[1] += [upper[run], lower[run][::-1], np.array([np.nan])]
    around_x, around_y = (_small(np.concatenate([*parts, []])) for parts in outlines)
    line = {"color": BLUE, "width": 0.8, "dash": "dot"}
    fill = {"fill": "toself", "fillcolor": "rgba(47,134,221,0.22)", "hoverinfo": "skip"}
    return go.Scatter(x=around_x, y=around_y, name=name, mode="lines", line=line, **fill)


def _shade_gaps(figure: go.Figure, time: np.ndarray, traces: Sequence[Trace]) -> None:
    """Shade in the left column where the measured signals (or all, if none is) are missing."""
    measured = [trace for trace in traces if trace.role == "measured"] or traces
    missing = np.zeros(len(time), dtype=bool)
    for trace in measured:
        missing |= np.isnan(trace.values.reshape(len(time), -1)).any(axis=1)
    gaps = sorted(_gaps(time, missing), key=lambda gap: gap[0] - gap[1])[:MAX_GAPS]
    column: dict[str, Any] = {"row": "all", "col": 1}
    for start, end in gaps:
        edges = {"x0": start, "x1": end, "line": {"width": 0}}
        figure.add_vrect(fillcolor=SHADE, layer="below", **edges, **column)
    if gaps:
        square = {"symbol": "square", "size": 12, "color": SHADE}
        figure.add_scatter(x=[None], y=[None], name="no data", mode="markers", marker=square)


def _jumps(time: np.ndarray) -> np.ndarray:
    """Give the samples after which time steps by more than one and a half usual steps."""
    step = np.diff(time)
    return np.flatnonzero(step > 1.5 * np.median(step)) if len(step) else np.empty(0, dtype=int)


def _gaps(time: np.ndarray, missing: np.ndarray) -> list[tuple[float, float]]:
    """Give start and end of every run of missing samples and every jump in time, in s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(int)))
    runs = edges.reshape(-1, 2)
    starts = np.concatenate([np.maximum(runs[:, 0] - 1, 0), _jumps(time)])
    ends = np.concatenate([np.minimum(runs[:, 1], len(time) - 1), _jumps(time) + 1])
    return [(float(time[i]), float(time[j])) for i, j in zip(starts, ends, strict=True)]


def _broken_at_gaps(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put a NaN into every jump in time, so that no line is drawn across it."""
    after = _jumps(time) + 1
    return np.insert(time, after, time[after]), np.insert(values, after, np.nan, axis=0)


def _decimated(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep of a long series the least, the greatest and a missing value of each stretch."""
    if len(y) <= MAX_POINTS:
        return _small(x), _small(y)
    width = -(-len(y) // (MAX_POINTS // 3))
    filled = np.append(y, np.full(-len(y) % width, np.nan)).reshape(-1, width)
    hole = np.isnan(filled)
    kept = [
        np.argmin(np.where(hole, np.inf, filled), axis=1),
        np.argmax(np.where(hole, -np.inf, filled), axis=1),
        # Without its hole the stretch would be joined to the next by a line.
        np.argmax(hole, axis=1),
    ]
    start = np.arange(len(filled)) * width
    index = np.unique(np.concatenate([start + k for k in kept] + [[0, len(y) - 1]]))
    index = index[index < len(y)]
    return _small(x[index]), _small(y[index])


def _small(values: np.ndarray) -> np.ndarray:
    """Give single precision, which no screen outresolves and which halves a page's size."""
    return values.astype(np.float32)


def _finish(figure: go.Figure, title: str | None, *, height: int, legend: bool) -> go.Figure:
    """Apply the theme; leave room above the axes for a title and a legend."""
    top = 24 + (34 if title else 0) + (30 if legend else 0)
    figure.update_layout(template=theme(), height=height, showlegend=legend)
    figure.update_layout(margin={"t": top})
    if title:
        figure.update_layout(title={"text": title, "y": 1 - 22 / height, "yanchor": "middle"})
    traces: Any = figure.data
    if sum(trace.showlegend is not False for trace in traces) > MAX_LEGEND:
        # A legend of many lines above the axes would cover the title.
        beside = {"orientation": "v", "x": 1.02, "y": 1.0, "yanchor": "top"}
        figure.update_layout(legend=beside)
    return figure


def _floor_line(name: str = "noise floor", colour: str = INK) -> dict:
    """Give how a noise floor is drawn."""
    return {
        "name": name,
        "mode": "lines",
        "line": {"color": colour, "dash": "dot", "width": 2},
        "hovertemplate": "noise floor: %{y:.3~g} %<extra></extra>",
    }


def _bar(colour: str, pattern: str) -> dict:
    """Give a bar its colour at edge and hatching, pale inside so that a line across it is seen."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return {
        "color": f"rgba({red},{green},{blue},{0.15 if pattern else 0.4})",
        "line": {"color": colour, "width": 1.5},
        "pattern": {"shape": pattern, "fgcolor": colour, "fillmode": "replace", "solidity": 0.25},
    }


def _with_unit(name: str, unit: str) -> str:
    """Give an axis title; a pure number has no unit to print."""
    return f"{name} ({unit})" if unit and unit != "1" else name


def _value(value: float, std: float, unit: str) -> str:
    """Give a value with its standard deviation to two digits, and the unit."""
    if not np.isfinite(std) or std <= 0:
        return f"{value:.4g} {unit}".strip()
    digits = max(0, 1 - int(np.floor(np.log10(std))))
    if digits > 6 or abs(value) >= 1e5:
        return f"{value:.3g} ± {std:.2g} {unit}".strip()
    return f"{value:.{digits}f} ± {std:.{digits}f} {unit}".strip()
