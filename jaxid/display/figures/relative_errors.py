"""Figures of relative errors, by recording and by step."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import wrap

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from .look import (
    DASHES,
    INK,
    MARKERS,
    MAX_LEGEND,
    PALETTE,
    PATTERNS,
    bar,
    finish,
    floor_line,
    with_unit,
)


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
        floor: Error in % due to noise alone, shape `(labels,)`.
        x_name: Name of what the labels denote.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(labels), dtype=float)
    styles = zip(cycle(PALETTE), cycle(PATTERNS))
    for group, row, (colour, pattern) in zip(groups, values, styles, strict=False):
        marker = bar(colour, pattern)
        hover = f"{group}, %{{x}}: %{{y:.3~g}} %<extra></extra>"
        figure.add_bar(x=place, y=row, name=group, marker=marker, hovertemplate=hover)
    if floor is not None:
        half = 0.42
        x = np.stack([place - half, place + half, np.full_like(place, np.nan)], axis=1).ravel()
        figure.add_scatter(x=x, y=np.repeat(floor, 3), **floor_line())
    figure.update_xaxes(
        title_text=x_name, tickvals=place, ticktext=list(labels), showgrid=False, zeroline=False
    )
    figure.update_yaxes(title_text=with_unit("relative error", "%"), rangemode="tozero")
    figure.update_layout(barmode="group")
    return finish(figure, title, height=380, legend=True)


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
        steps: Effect that each step added; the starting model is first.
        series: Relative error in %, shape `(steps, joints)`, by the name of the recordings: the
            first is drawn solid (fitted), the next dashed (held out).
        floor: Error in % due to noise alone, shape `(joints,)`; dotted.
        joint_names: As printed; "joint 1" and so on if absent.
        title: Title of the whole figure.
    """
    figure = go.Figure()
    place = np.arange(len(steps), dtype=float)
    joints = max((values.shape[1] for values in series.values()), default=0)
    names = joint_names or [f"joint {joint + 1}" for joint in range(joints)]
    # A legend entry per joint and kind of recording would make the legend taller than the figure.
    short = joints * (len(series) + 1) > MAX_LEGEND
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
                showlegend=not short,
            )
        if floor is not None:
            line = floor_line(f"{name}, noise floor", colour)
            figure.add_scatter(
                x=place[[0, -1]], y=np.full(2, floor[joint]), showlegend=not short, **line
            )
    if short:
        _short_legend(figure, names, [*series, *(["noise floor"] if floor is not None else [])])
    figure.update_xaxes(
        title_text="step",
        tickvals=place,
        # Names of effects are too long for one line here.
        ticktext=[
            "<br>".join(wrap(step.replace("_", " "), 16, break_long_words=False)) for step in steps
        ],
        range=[-0.35, len(steps) - 0.65],
        showgrid=False,
        zeroline=False,
    )
    figure.update_yaxes(title_text=with_unit("relative error", "%"), rangemode="tozero")
    return finish(figure, title, height=430, legend=True)


def _short_legend(figure: go.Figure, names: Sequence[str], kinds: Sequence[str]) -> None:
    """Name colours and markers once, and dashes once."""
    for name, colour, marker in zip(names, cycle(PALETTE), cycle(MARKERS)):
        look = {"color": colour, "symbol": marker, "size": 9}
        figure.add_scatter(x=[None], y=[None], name=name, mode="markers", marker=look)
    dashes = dict(zip(kinds, cycle(DASHES))) | {"noise floor": "dot"}
    for kind in kinds:
        line = {"color": INK, "dash": dashes[kind], "width": 2}
        figure.add_scatter(x=[None], y=[None], name=kind, mode="lines", line=line)
