"""Power curves: share of named effects over the size that the rigid robot cannot absorb."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from jaxid.display import figures

from ._evidence_tables import NAMELESS, Line, interval, share

# Bounds of the size of an effect's residual torque, in units of the noise.
SIZES = (0.0, 1.0, 2.0, 4.0, 8.0, float("inf"))
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
MARKERS = ("circle", "square", "diamond", "triangle-up", "cross", "x")


@dataclass(frozen=True)
class Trial:
    """One effect or case given to a tool: its size over the noise, and the answer."""

    tool: str
    size: float
    right: bool


def sizes(lines: Iterable[Line]) -> dict[int, list[float]]:
    """Residual size of each effect, by the case's seed; the baselines measure it."""
    return {x["seed"]: x["visible"] for x in lines if "visible" in x}


def named(lines: Sequence[Line]) -> list[Trial]:
    """Each effect of the catalogue that was hidden, and whether it was named."""
    known = sizes(lines)
    return [
        Trial(x["tool"], size, right)
        for x in _asked(lines)
        for size, right in zip(known[x["seed"]], x["marks"]["named"], strict=True)
    ]


def alone(lines: Sequence[Line]) -> list[Trial]:
    """Each case, by its smallest effect, and whether exactly its effects were named."""
    known = sizes(lines)
    return [
        Trial(x["tool"], min(known[x["seed"]]), x["marks"]["right"] and not x["marks"]["extra"])
        for x in _asked(lines)
    ]


def _asked(lines: Sequence[Line]) -> list[Line]:
    known = sizes(lines)
    return [
        x
        for x in lines
        if x["kind"] in ("single", "double")
        and "marks" in x
        and x["seed"] in known
        and x["tool"] not in NAMELESS
    ]


def _within(trials: Sequence[Trial], low: float, high: float) -> list[Trial]:
    return [t for t in trials if low <= t.size < high]


def power_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """Number of correct answers by size, with a column for each tool."""
    rows = {}
    for low, high in pairwise(SIZES):
        label = f"above {low:g}" if np.isinf(high) else f"{low:g} to {high:g}"
        some = _within(trials, low, high)
        rows[label] = {
            tool: share((sum(t.right for t in own), len(own)))
            for tool in dict.fromkeys(t.tool for t in trials)
            for own in [[t for t in some if t.tool == tool]]
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def power_figure(lines: Sequence[Line]) -> go.Figure:
    """Named, and named with nothing else, over size, for each tool that names; 95 % intervals."""
    panels = {"effect named": named(lines), "all named, and nothing else": alone(lines)}
    figure = make_subplots(rows=1, cols=2, subplot_titles=list(panels), horizontal_spacing=0.1)
    tools = list(dict.fromkeys(t.tool for trials in panels.values() for t in trials))
    for column, trials in enumerate(panels.values(), start=1):
        for k, tool in enumerate(tools):
            own = [t for t in trials if t.tool == tool]
            groups = [g for low, high in pairwise(SIZES) if (g := _within(own, low, high))]
            # Tools are drawn side by side, so their intervals do not overlap.
            shift = 1.03 ** (k - len(tools) / 2)
            x = [shift * float(np.exp(np.mean([np.log(t.size) for t in g]))) for g in groups]
            right = [sum(t.right for t in g) for g in groups]
            y = [100 * r / len(g) for r, g in zip(right, groups, strict=True)]
            bounds = [interval(r, len(g)) for r, g in zip(right, groups, strict=True)]
            colour = figures.PALETTE[k % len(figures.PALETTE)]
            figure.add_scatter(
                x=x,
                y=y,
                name=tool,
                legendgroup=tool,
                showlegend=column == 1,
                mode="lines+markers",
                line={"color": colour, "dash": DASHES[k % len(DASHES)], "width": 1.8},
                marker={"color": colour, "symbol": MARKERS[k % len(MARKERS)], "size": 8},
                error_y={
                    "symmetric": False,
                    "array": [high - v for v, (_, high) in zip(y, bounds, strict=True)],
                    "arrayminus": [v - low for v, (low, _) in zip(y, bounds, strict=True)],
                    "thickness": 1,
                    "width": 2,
                },
                row=1,
                col=column,
            )
    figure.update_layout(template=figures.theme())
    figure.update_layout(margin={"l": 60, "r": 15, "t": 40, "b": 95}, legend={"y": -0.42})
    figure.update_xaxes(type="log", title_text="size of the effect over the noise", dtick=0.30103)
    figure.update_yaxes(range=[-3, 103])
    figure.update_yaxes(title_text="cases, %", row=1, col=1)
    return figure
