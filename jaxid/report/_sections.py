"""The sections of the page, each from what the results can show."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from ..discovery import Discovery
from ..display import figures
from ._again import settings
from ._choice import choice, where_table
from ._head import head
from ._html import Content, Markup, anchor, figure, join, link, number, section, table, tag
from ._next import recommended
from ._signals import against, along, compared, whiteness


def contents(sections: Sequence[Markup]) -> Markup:
    """Links to the sections."""
    titles = [piece.split("<h2>")[1].split("</h2>")[0] for piece in sections]
    return tag("nav", *(link(Markup(t), anchor(t)) for t in titles), aria_label="sections")


def error(story: Discovery) -> Markup:
    """The error falling, as a figure and a table."""
    rows = story.table()
    if len(story.steps) > 1:
        drawn, caption = story.plot(), "Relative error by step, and the error that noise leaves."
    else:
        drawn, caption = _bars(story), "Relative error, and the error that noise alone leaves."
    values = [
        [str(step), *map(float, row)] for step, row in zip(rows.index, rows.to_numpy(), strict=True)
    ]
    return section(
        "The error" if len(rows) == 1 else "The error falling",
        figure(drawn, caption),
        table(["step", *(f"{c}, %" for c in rows.columns)], values, "relative error by step"),
    )


def _bars(story: Discovery) -> go.Figure:
    rows = story.table()
    joints = [c.removeprefix("fit, ") for c in rows.columns if c.startswith("fit, ")]
    values = rows.to_numpy().reshape(-1, len(joints))
    groups = ["fitted", "held out"][: len(values)]
    return figures.error_bars(joints, groups, values, story.noise_floor_percent())


def failure(story: Discovery) -> Markup:
    """Where the starting model fails."""
    step = story.steps[0]
    held = compared(step)
    name = held.recordings.names[0]
    caption = (
        f"The starting model along {name}: {held.signal}, what is left of it, and the "
        "autocorrelation of what is left. Drag to zoom, double-click to see all."
    )
    if len(story.steps) > 1:
        caption += " The figure of the final model, below, shows the same stretch."
    pieces: list[Content] = [along(story, held, 0, caption)]
    if story.first_diagnosis.depends_on():
        pieces.append(against(held, story.first_diagnosis.where[0], "the starting model"))
    pieces.append(where_table(story.first_diagnosis))
    title = "Where the starting model failed" if len(story.steps) > 1 else "The model beside data"
    return section(title, *pieces)


def parameters(story: Discovery) -> Markup:
    """Every parameter of the final model with its interval."""
    first, last = story.steps[0].fit, story.fit
    start = dict(zip(first.names, first.theta.tolist(), strict=True))
    rows: list[Sequence[Content]] = []
    for name, value, std, unit in zip(last.names, last.theta, last.std, last.units, strict=True):
        low, high = float(value - 1.96 * std), float(value + 1.96 * std)
        known = bool(np.isfinite(std))
        interval = f"{number(low)}\u00a0…\u00a0{number(high)}" if known else "not determined"
        before = start.get(name)
        rows.append(
            [
                name,
                float(value),
                float(std),
                interval,
                unit,
                before if before is not None else "added",
            ]
        )
    columns = ["parameter", "value", "std", "95 % interval", "unit", "in the starting model"]
    remarks = [tag("p", s, class_="note") for s in (*last.undetermined, *last.notes)]
    deviations = tag("p", f"Deviations: {last.deviations}.") if last.deviations else None
    return section(
        "Parameters",
        table(columns, rows, "parameters of the final model"),
        deviations,
        *remarks,
        figure(last.plot(), "Two standard deviations either side, relative to each value.", True),
    )


def rest(story: Discovery) -> Markup:
    """What the final model leaves, and whether that is noise."""
    step = story.steps[-1]
    held = compared(step)
    pieces: list[Content] = []
    if len(story.steps) > 1:
        caption = f"The final model along {held.recordings.names[0]}."
        pieces.append(along(story, held, 0, caption))
    if story.verdict == "outside_catalogue" and story.diagnosis.depends_on():
        pieces.append(tag("h3", "What no entry explains"))
        pieces.append(against(held, story.diagnosis.where[0], "the final model"))
        if len(story.steps) > 1:
            pieces.append(where_table(story.diagnosis))
    elif len(story.steps) > 1 and story.first_diagnosis.depends_on():
        pieces.append(against(held, story.first_diagnosis.where[0], "the final model"))
    pieces.append(tag("h3", "Is it noise?"))
    pieces.append(tag("div", *whiteness(story, held, 0), class_="pair"))
    return section("What is left", *pieces)


def ahead(story: Discovery) -> Markup:
    """What to record next."""
    return section("What to record next", *recommended(story))


def body(story: Discovery) -> Markup:
    """All sections in reading order."""
    parts = (error, failure, choice, parameters, rest, ahead, settings)
    sections = [part(story) for part in parts]
    return join(head(story), contents(sections), *sections)
