"""Figures of signals over time."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from .look import (
    BLUE,
    DASHES,
    GREEN,
    MISFIT,
    NOISE,
    ORANGE,
    PALETTE,
    finish,
    with_unit,
)
from .panels import (
    MAX_GAPS,
    MAX_POINTS,
    ROLE_LINES,
    Trace,
    add_acf,
    add_panel,
    broken_at_gaps,
    decimated,
    shade_gaps,
)


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
        titles: Titles of the panels ("joint 1 torque"); the first trace's name if absent.
        title: Title of the whole figure.
    """
    if not panels or not all(panels):
        raise ValueError("signals() needs at least one trace in each panel; one is empty.")
    heights = [1.0 if any(t.role != "residual" for t in panel) else 0.5 for panel in panels]
    figure = go.Figure().set_subplots(
        rows=len(panels), cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=heights
    )
    names = titles or [panel[0].name for panel in panels]
    for row, (name, panel) in enumerate(zip(names, panels, strict=True), start=1):
        add_panel(figure, time, panel, row)
        figure.update_yaxes(title_text=with_unit(name, panel[0].unit), row=row, col=1)
    shade_gaps(figure, time, [trace for panel in panels for trace in panel])
    figure.update_xaxes(title_text="time (s)", row=len(panels), col=1)
    return finish(figure, title, height=round(140 + 190 * sum(heights)), legend=True)


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
    """Draw measured, simulated and residual signals and the residual's autocorrelation per joint.

    Arguments:
        time: Sampling times in s, shape `(samples,)`.
        measured: Measured signal in `unit`, shape `(samples, joints)`.
        simulated: Simulated signal in `unit`, shape `(samples, joints)`.
        residual: Their difference in `unit`, shape `(samples, joints)`.
        acf: Autocorrelation of the residual from lag 0 on, shape `(lags, joints)`.
        acf_bound: Two standard deviations of a white residual's autocorrelation.
        joint_names: As printed, one for each joint.
        unit: Unit of the signal, one for all joints or one for each.
        title: Title of the whole figure.
    """
    if len(acf) < 2 or np.any(np.abs(acf[0] - 1) > 1e-6):
        raise ValueError("comparison() needs the autocorrelation from lag 0 on, where it is 1.")
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
        add_panel(figure, time, upper, row)
        add_panel(figure, time, lower, row + 1)
        add_acf(figure, np.arange(1, len(acf)), acf[1:, joint], acf_bound, row, 2)
        figure.update_yaxes(title_text=with_unit(name, units[joint]), row=row, col=1)
        figure.update_yaxes(title_text=with_unit("residual", units[joint]), row=row + 1, col=1)
        figure.update_yaxes(title_text="autocorrelation", range=[-reach, reach], row=row, col=2)
        drawn += upper + lower
    shade_gaps(figure, time, drawn, "not compared")
    for row in range(1, 2 * joints + 1):
        # Plotly warns in the browser's console about an axis that matches itself.
        figure.update_xaxes(matches="x" if row > 1 else None, showticklabels=False, row=row, col=1)
    figure.update_xaxes(title_text="time (s)", showticklabels=True, row=2 * joints, col=1)
    figure.update_xaxes(showticklabels=False, col=2)
    last: dict[str, Any] = {"row": 2 * joints - 1, "col": 2}
    figure.update_xaxes(title_text="lag (samples)", showticklabels=True, **last)
    return finish(figure, title, height=140 + 290 * joints, legend=True)


def before_after(
    time: Float[np.ndarray, " samples"],
    measured: Float[np.ndarray, " samples"],
    simulated: Float[np.ndarray, " samples"],
    before: Float[np.ndarray, " samples"] | None,
    band: float,
    *,
    name: str = "torque",
    unit: str = "N·m",
    most: int = MAX_POINTS,
    title: str | None = None,
) -> go.Figure:
    """Draw a measured signal with simulations of one or two models, and the residuals below.

    Arguments:
        time: Sampling times in s, shape `(samples,)`.
        measured: In `unit`, shape `(samples,)`.
        simulated: By the model at the end, in `unit`, shape `(samples,)`.
        before: By the model at the start, if there is one, in `unit`, shape `(samples,)`.
        band: Half-width in `unit` of the band in which noise alone would lie.
        name: Name of the signal.
        unit: As printed.
        most: Maximum number of points of a line.
        title: Title of the whole figure.
    """
    figure = go.Figure().set_subplots(
        rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[1.0, 0.7]
    )
    # Each line is thinner than the one below it, so all are visible where they agree.
    lines = [("measured", measured, ROLE_LINES["measured"]["color"], 4.5)]
    if before is not None:
        lines.append(("before", before, ORANGE, 2.2))
    lines.append(("simulated" if before is None else "after", simulated, BLUE, 1.3))
    for label, signal, colour, width in lines:
        style: dict[str, Any] = {"line": {"color": colour, "width": width}, "mode": "lines"}
        x, y = decimated(*broken_at_gaps(time, signal), most)
        figure.add_scatter(x=x, y=y, name=label, legendgroup=label, row=1, col=1, **style)
        if signal is not measured:
            x, y = decimated(*broken_at_gaps(time, measured - signal), most)
            style |= {"name": label, "legendgroup": label, "showlegend": False}
            figure.add_scatter(x=x, y=y, row=2, col=1, **style)
    # Stretches without data are grey, too; the band of the noise has edges.
    dotted = {"color": GREEN, "width": 1, "dash": "dot"}
    edges: dict[str, Any] = {"line": dotted, "layer": "below", "row": 2, "col": 1}
    figure.add_hrect(y0=-band, y1=band, fillcolor=NOISE, **edges)
    square = {"symbol": "square", "size": 12, "color": NOISE}
    square["line"] = {"color": GREEN, "width": 1}
    figure.add_scatter(x=[None], y=[None], name="noise", mode="markers", marker=square)
    shade_gaps(figure, time, [Trace(name, measured, unit)], "not compared")
    figure.update_yaxes(title_text=with_unit(name, unit), row=1, col=1)
    figure.update_yaxes(title_text=with_unit("residual", unit), row=2, col=1)
    figure.update_xaxes(title_text="time (s)", row=2, col=1)
    return finish(figure, title, height=400, legend=True)


def mark_misfit(
    figure: go.Figure, joint: int, spans: Sequence[tuple[float, float]], name: str = "misfit"
) -> go.Figure:
    """Shade stretches of one joint in a comparison; the longest 40 are drawn.

    Arguments:
        figure: Figure made by `comparison`; it is modified.
        joint: Counted from 1.
        spans: Start and end of each stretch, s.
        name: Name of the stretches in the legend.
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


def shares_in_time(
    time: Float[np.ndarray, " samples"],
    residual: Float[np.ndarray, " samples"],
    shares: Mapping[str, Float[np.ndarray, " samples"]],
    *,
    unit: str = "N·m",
    title: str | None = None,
) -> go.Figure:
    """Draw a residual with the part that the first candidate explains, all shares, and the rest.

    Arguments:
        time: Sampling times in s, shape `(samples,)`.
        residual: In `unit`, shape `(samples,)`.
        shares: The part that each candidate explains on its own, in `unit`, shape `(samples,)`,
            by name; the leading candidate is first.
        unit: As printed.
        title: Title of the whole figure.
    """
    # The candidates are alternatives: their sum would count the same part twice.
    leading, explained = next(iter(shares.items()), ("nothing", np.zeros_like(residual)))
    figure = go.Figure().set_subplots(
        rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=[1.0, 1.0, 0.6]
    )
    whole = [
        Trace("residual", residual, unit, "measured"),
        Trace(f"explained by {leading}", explained, unit, "simulated"),
    ]
    add_panel(figure, time, whole, 1)
    for (name, share), colour, dash in zip(shares.items(), cycle(PALETTE[2:]), cycle(DASHES)):
        x, y = decimated(*broken_at_gaps(time, share))
        line = {"color": colour, "dash": dash, "width": 1.6}
        figure.add_scatter(x=x, y=y, name=name, mode="lines", line=line, row=2, col=1)
    rest = Trace("rest", residual - explained, unit, "residual")
    add_panel(figure, time, [rest], 3)
    for row, name in enumerate(("residual", "share", "rest"), start=1):
        figure.update_yaxes(title_text=with_unit(name, unit), row=row, col=1)
    # One scale for all three, so that a share can be compared with the whole.
    figure.update_yaxes(matches="y")
    shade_gaps(figure, time, whole)
    figure.update_xaxes(title_text="time (s)", row=3, col=1)
    return finish(figure, title, height=590, legend=True)


def _comparison_grid(joints: int) -> go.Figure:
    """Give each joint a high and a low panel on the left, and one panel beside both."""
    return go.Figure().set_subplots(
        rows=2 * joints,
        cols=2,
        specs=[[{}, {"rowspan": 2}], [{}, None]] * joints,
        column_widths=[0.72, 0.28],
        row_heights=[1.0, 0.5] * joints,
        horizontal_spacing=0.11,
        vertical_spacing=0.14 / (2 * joints),
    )
