"""Parameters of the starting and the final model, and their changes."""

import math

from ..discovery import Discovery
from ..estimate import Fit
from ._html import Content, Markup, bar, cell, join, number, section, table, tag, with_deviation


def parameters(story: Discovery) -> Markup:
    """All parameters before and after, with their shifts in standard deviations."""
    first, last = story.steps[0].fit, story.fit
    several = len(story.steps) > 1
    before, after = _values(first), _values(last)
    shifts = {
        name: (after[name][0] - value) / max(std, after[name][1])
        for name, (value, std) in before.items()
        if name in after and 0 < std < math.inf and 0 < after[name][1] < math.inf
    }
    most = max((abs(x) for x in shifts.values()), default=1.0) or 1.0
    units = dict(zip((*last.names, *first.names), (*last.units, *first.units), strict=True))
    rows: list[list[Content]] = []
    for name in (*last.names, *(n for n in first.names if n not in after)):
        unit = None if units[name] == "1" else tag("small", f"\u00a0{units[name]}")
        shown: list[Content] = [join(name, unit)]
        if several:
            shown += [_shown(before.get(name), "added"), _shown(after.get(name), "removed")]
            shift = shifts.get(name)
            shown.append(cell("", math.nan) if shift is None else _shift(shift, most))
        else:
            shown.append(_shown(after.get(name), ""))
        rows.append([*shown, _interval(after.get(name))])
    columns = ["parameter", "value", "95 % interval"]
    if several:
        columns[1:2] = ["before", "after", "shift, std"]
    said = tag(
        "p",
        "Each value is given with its standard deviation (std). A shift is given in units of the "
        "larger of the two. A shift of more than three means that the parameter had absorbed a "
        "part of the missing effect.",
    )
    remarks = [tag("p", s, class_="note") for s in (*last.undetermined, *last.notes)]
    deviations = tag("p", f"Deviations: {last.deviations}.") if last.deviations else None
    title = "parameters before and after" if several else "parameters"
    values = table(columns, rows, title)
    return section("Parameters", said if several else None, values, deviations, *remarks)


def _values(fit: Fit) -> dict[str, tuple[float, float]]:
    return {
        name: (float(value), float(std))
        for name, value, std in zip(fit.names, fit.theta, fit.std, strict=True)
    }


def _shown(known: tuple[float, float] | None, absent: str) -> Content:
    if known is None:
        return cell(absent, math.nan)
    return cell(with_deviation(*known), known[0])


def _shift(shift: float, most: float) -> Content:
    # Square root, so that a shift of three is still visible next to one of three hundred.
    return bar(f"{shift:+.1f}".replace("-", "−"), shift, math.sqrt(abs(shift) / most))


def _interval(known: tuple[float, float] | None) -> str:
    if known is None:
        return ""
    value, std = known
    if not math.isfinite(std):
        return "not determined"
    return f"{number(value - 1.96 * std)}\u00a0…\u00a0{number(value + 1.96 * std)}"
