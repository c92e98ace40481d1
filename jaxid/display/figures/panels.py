"""Lines, bands and stems in the panels of a figure, and the gaps between samples."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from .look import BLUE, DASHES, GREEN, INK, ORANGE, SHADE

Role = Literal["measured", "simulated", "residual", "reference", "band"]
MAX_POINTS = 4000
MAX_GAPS = 40

# The measured line is wide and pale so that the thin simulated one is visible on top of it.
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
        name: Name in the legend.
        values: Samples in `unit`; for the role "band" two columns, lower and upper.
        unit: Unit, as printed.
        role: Role of the line, which determines its style.
    """

    name: str
    values: Float[np.ndarray, " samples"] | Float[np.ndarray, "samples 2"]
    unit: str
    role: Role = "measured"


def add_panel(figure: go.Figure, time: np.ndarray, traces: Sequence[Trace], row: int) -> None:
    """Add traces to the panel of the left column; each name is in the legend once."""
    present: Any = figure.data
    seen = {trace.name for trace in present}
    roles: list[str] = []
    for trace in traces:
        x, y = broken_at_gaps(time, trace.values)
        if trace.role == "band":
            drawn = band_trace(trace.name, x, y[:, 0], y[:, 1])
        else:
            x, y = decimated(x, y)
            line = dict(ROLE_LINES[trace.role])
            # A second line of the same role in one panel has another dash pattern.
            line.setdefault("dash", DASHES[roles.count(trace.role) % len(DASHES)])
            drawn = go.Scatter(x=x, y=y, name=trace.name, mode="lines", line=line)
        drawn.update(legendgroup=trace.name, showlegend=trace.name not in seen)
        figure.add_trace(drawn, row=row, col=1)
        roles.append(trace.role)
        seen.add(trace.name)


def add_acf(
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


def band_trace(name: str, x: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> go.Scatter:
    """Give a band as one outline for each stretch without missing values."""
    every = -(-len(x) // MAX_POINTS)
    # Missing samples must remain after thinning, or the outline would close over the gap.
    whole = np.isfinite(lower) & np.isfinite(upper)
    kept = np.unique(np.concatenate([np.arange(0, len(x), every), np.flatnonzero(~whole)]))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], whole[kept], [False]]).astype(int)))
    outlines: list[list[np.ndarray]] = [[], []]
    for start, end in edges.reshape(-1, 2):
        run = kept[start:end]
        outlines[0] += [x[run], x[run][::-1], np.array([np.nan])]
        outlines[1] += [upper[run], lower[run][::-1], np.array([np.nan])]
    around_x, around_y = (small(np.concatenate([*parts, []])) for parts in outlines)
    line = {"color": BLUE, "width": 0.8, "dash": "dot"}
    fill = {"fill": "toself", "fillcolor": "rgba(47,134,221,0.22)", "hoverinfo": "skip"}
    return go.Scatter(x=around_x, y=around_y, name=name, mode="lines", line=line, **fill)


def shade_gaps(
    figure: go.Figure, time: np.ndarray, traces: Sequence[Trace], name: str = "no data"
) -> None:
    """Shade times at which all measured signals are missing (all signals if none is measured)."""
    measured = [trace for trace in traces if trace.role == "measured"] or traces
    missing = np.ones(len(time), dtype=bool)
    for trace in measured:
        missing &= np.isnan(trace.values.reshape(len(time), -1)).any(axis=1)
    gaps = sorted(_gaps(time, missing), key=lambda gap: gap[0] - gap[1])[:MAX_GAPS]
    column: dict[str, Any] = {"row": "all", "col": 1}
    for start, end in gaps:
        edges = {"x0": start, "x1": end, "line": {"width": 0}}
        figure.add_vrect(fillcolor=SHADE, layer="below", **edges, **column)
    if gaps:
        square = {"symbol": "square", "size": 12, "color": SHADE}
        figure.add_scatter(x=[None], y=[None], name=name, mode="markers", marker=square)


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


def broken_at_gaps(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put a NaN into every jump in time, so that no line is drawn across it."""
    after = _jumps(time) + 1
    return np.insert(time, after, time[after]), np.insert(values, after, np.nan, axis=0)


def decimated(
    x: np.ndarray, y: np.ndarray, most: int = MAX_POINTS
) -> tuple[np.ndarray, np.ndarray]:
    """Thin a long series: keep minimum, maximum and a missing value of each stretch."""
    if len(y) <= most:
        return small(x), small(y)
    width = -(-len(y) // (most // 3))
    filled = np.append(y, np.full(-len(y) % width, np.nan)).reshape(-1, width)
    hole = np.isnan(filled)
    kept = [
        np.argmin(np.where(hole, np.inf, filled), axis=1),
        np.argmax(np.where(hole, -np.inf, filled), axis=1),
        # Without the missing value, a line would connect the stretch to the next.
        np.argmax(hole, axis=1),
    ]
    start = np.arange(len(filled)) * width
    index = np.unique(np.concatenate([start + k for k in kept] + [[0, len(y) - 1]]))
    index = index[index < len(y)]
    return small(x[index]), small(y[index])


def small(values: np.ndarray) -> np.ndarray:
    """Give single precision, which suffices for any screen and halves the size of a page."""
    return values.astype(np.float32)
