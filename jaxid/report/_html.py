"""Generation of HTML in which all text from files and users is escaped."""

import html
import math
from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go


class Markup(str):
    """Text that is already HTML; every other string is escaped when it is inserted."""


class Cell(Markup):
    """A cell of a table, with the value by which its column sorts."""


Content = str | int | float | None
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def tag(name: str, *content: Content, **attributes: Content) -> Markup:
    """An element; a trailing underscore in an attribute's name is dropped (`class_`)."""
    words = [name]
    for key, value in attributes.items():
        if value is not None:
            words.append(f'{key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"')
    return Markup(f"<{' '.join(words)}>{join(*content)}</{name}>")


def join(*content: Content) -> Markup:
    """Concatenated pieces, escaped unless they are markup; None is left out."""
    return Markup(
        "".join(
            piece if isinstance(piece, Markup) else html.escape(str(piece))
            for piece in content
            if piece is not None
        )
    )


def table(
    columns: Sequence[Content], rows: Sequence[Sequence[Content]], caption: str | None = None
) -> Markup:
    """A table whose columns sort on a click, by the numbers before rounding."""
    buttons = (tag("button", name, type="button") for name in columns)
    head = tag("tr", *(tag("th", button, scope="col") for button in buttons))
    body = [tag("tr", *(_cell(value) for value in row)) for row in rows]
    title = None if caption is None else tag("caption", caption)
    whole = tag("table", title, tag("thead", head), tag("tbody", *body))
    # A wide table scrolls in its own box instead of the page; the box can have the focus.
    return tag("div", whole, class_="scroll", tabindex="0", role="region", aria_label=caption)


def _cell(value: Content) -> Markup:
    if isinstance(value, Cell):
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return tag("td", value if value is not None else "")
    return cell(number(value), value)


def cell(shown: Content, value: float, class_: str = "number") -> Cell:
    """A number shown as a given text and sorted by its value."""
    return Cell(tag("td", shown, class_=class_, data_value=repr(float(value))))


def bar(shown: Content, value: float, share: float) -> Cell:
    """A number with a bar below it; the length of the bar is between 0 and 1."""
    width = 100 * min(max(share, 0.0), 1.0) if math.isfinite(share) else 0.0
    drawn = tag("span", class_="bar", style=f"width:{width:.1f}%")
    return cell(join(shown, drawn), value, "number barred")


def number(value: float) -> str:
    """A number formatted with four digits, a count with all; a dash for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    shown = f"{value:.4g}"
    if 1e4 <= abs(value) < 1e6:
        shown = f"{value if isinstance(value, int) else float(shown):.0f}"
    return shown.replace("-", "−")


def with_deviation(value: float, std: float | None) -> str:
    """A value and its standard deviation, which has two digits, to the same decimal place."""
    if std is None or not math.isfinite(std) or std <= 0:
        return number(value)
    digits = 1 - math.floor(math.log10(std))
    if digits > 6:
        power = math.floor(math.log10(max(abs(value), std)))
        places = max(digits + power, 0)
        pair = "\u00a0±\u00a0".join(f"{x / 10.0**power:.{places}f}" for x in (value, std))
        return f"({pair})·10{str(power).translate(SUPERSCRIPTS)}".replace("-", "−")
    if digits < 0:
        return f"{number(value)}\u00a0±\u00a0{number(float(f'{std:.2g}'))}"
    return f"{value:.{digits}f}\u00a0±\u00a0{std:.{digits}f}".replace("-", "−")


def percent(share: float) -> str:
    """A percentage with three digits."""
    return f"{share:.{2 if share < 10 else 1 if share < 100 else 0}f}"


def breakable(name: str) -> Markup:
    """A name whose lines may break after an underscore, but not before a joint's number."""
    parts = name.replace("joint ", "joint\u00a0").replace("+ ", "+\u00a0").split("_")
    return Markup("_<wbr>".join(join(part) for part in parts))


def probability(p: float) -> str:
    """A p-value; one that underflows float64 is given as small, not as zero."""
    return "< 1e−300" if p < 1e-300 else number(float(f"{p:.2g}"))


def details(summary: Content, *content: Content, class_: str | None = None) -> Markup:
    """Content that is collapsed on the screen; it is printed unless its class is `raw`."""
    return tag("details", tag("summary", summary), *content, class_=class_)


def choose(name: str, title: str, labels: Sequence[Content], first: int) -> Markup:
    """A choice between labelled options; the page's script shows the panel of the chosen one."""
    options = [
        tag(
            "label",
            Markup(
                f'<input type="radio" name="{name}" value="{k + 1}"{" checked" * (k == first)}>'
            ),
            label,
            class_="card",
        )
        for k, label in enumerate(labels)
    ]
    return tag("fieldset", tag("legend", title, class_="unseen"), *options, class_="cards")


def link(text: Content, anchor: str) -> Markup:
    """A link to an anchor on the page."""
    return tag("a", text, href=f"#{anchor}")


def figure(drawn: go.Figure, caption: Content, linked: bool = False) -> Markup:
    """A figure with its caption, drawn by the page's script.

    **Arguments:**

    - `linked`: whether it shares its time range, set by keys and buttons, with other figures.
    """
    layout: Any = drawn.layout
    height = int(layout.height or 400)
    keys = " Plus and minus zoom, arrows move, 0 shows all."
    box = tag(
        "div",
        style=f"height:{height}px",
        data_figure="",
        data_linked="" if linked else None,
        tabindex="0" if linked else None,
        role="group",
        aria_label=f"{caption}{keys if linked else ''}",
    )
    # Escaped, so that no text in a figure can end the script early.
    data = Markup((drawn.to_json() or "").replace("<", "\\u003c"))
    script = tag("script", data, type="application/json")
    return tag("figure", box, script, tag("figcaption", caption))


def section(title: str, *content: Content) -> Markup:
    """A section with its heading."""
    return tag("section", tag("h2", title), *content, id=anchor(title))


def anchor(title: str) -> str:
    """The anchor of a section, made from its title."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())
