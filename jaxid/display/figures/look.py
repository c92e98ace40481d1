"""Common style of all figures: colours, the theme, axis titles, bars and legends."""

from functools import cache
from typing import Any

import plotly
import plotly.graph_objects as go

INK = "#7b818b"
GRID = "rgba(128,134,145,0.22)"
SHADE = "rgba(128,134,145,0.20)"
MISFIT = "rgba(216,69,90,0.20)"
NOISE = "rgba(33,155,115,0.22)"
BLUE, ORANGE, GREEN, PURPLE, RED = "#2f86dd", "#dd7320", "#219b73", "#9a66d8", "#d8455a"
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, RED, "#96891c", "#c458a6", INK)
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
MARKERS = ("circle", "square", "diamond", "triangle-up", "cross", "x", "star", "pentagon")
PATTERNS = ("", "/", "x", ".", "\\", "-", "|", "+")
MAX_LEGEND = 9


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


def finish(figure: go.Figure, title: str | None, *, height: int, legend: bool) -> go.Figure:
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


def with_unit(name: str, unit: str) -> str:
    """Give an axis title; the unit of a dimensionless quantity is not printed."""
    return f"{name} ({unit})" if unit and unit != "1" else name


def bar(colour: str, pattern: str) -> dict:
    """Give a bar coloured edges and hatching; the fill is pale, so lines across it are visible."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return {
        "color": f"rgba({red},{green},{blue},{0.15 if pattern else 0.4})",
        "line": {"color": colour, "width": 1.5},
        "pattern": {"shape": pattern, "fgcolor": colour, "fillmode": "replace", "solidity": 0.25},
    }


def floor_line(name: str = "noise floor", colour: str = INK) -> dict:
    """Give the line style of a noise floor."""
    return {
        "name": name,
        "mode": "lines",
        "line": {"color": colour, "dash": "dot", "width": 2},
        "hovertemplate": "noise floor: %{y:.3~g} %<extra></extra>",
    }
