"""HTML put together so that nothing from a file or a user gets in unescaped."""

import html
import math
from collections.abc import Sequence

import plotly.graph_objects as go


class Markup(str):
    """Text that is HTML already; every other string is escaped on its way in."""


Content = str | int | float | None


def tag(name: str, *content: Content, **attributes: Content) -> Markup:
    """An element; a trailing underscore in an attribute's name is dropped (`class_`)."""
    words = [name]
    for key, value in attributes.items():
        if value is not None:
            words.append(f'{key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"')
    return Markup(f"<{' '.join(words)}>{join(*content)}</{name}>")


def join(*content: Content) -> Markup:
    """Pieces one after the other, escaped unless they are markup; None is left out."""
    return Markup(
        "".join(
            piece if isinstance(piece, Markup) else html.escape(str(piece))
            for piece in content
            if piece is not None
        )
    )


def table(
    columns: Sequence[str], rows: Sequence[Sequence[Content]], caption: str | None = None
) -> Markup:
    """A table whose columns sort on a click; numbers are shown short and sorted in full."""
    buttons = (tag("button", name, type="button") for name in columns)
    head = tag("tr", *(tag("th", button, scope="col") for button in buttons))
    body = [tag("tr", *(_cell(value) for value in row)) for row in rows]
    title = None if caption is None else tag("caption", caption)
    whole = tag("table", title, tag("thead", head), tag("tbody", *body))
    # A wide table scrolls in its own box, so that a narrow page does not; the keyboard reaches it.
    return tag("div", whole, class_="scroll", tabindex="0", role="region", aria_label=caption)


def _cell(value: Content) -> Markup:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return tag("td", value if value is not None else "")
    return tag("td", number(value), class_="number", data_value=repr(float(value)))


def number(value: float) -> str:
    """A number as one reads it: four digits, and a dash where there is none."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return f"{value:.4g}".replace("-", "−")


def probability(p: float) -> str:
    """A p-value; one below what float64 holds is said to be small, not zero."""
    return "< 1e−300" if p < 1e-300 else number(float(f"{p:.2g}"))


def details(summary: Content, *content: Content, class_: str | None = None) -> Markup:
    """What only some readers want, folded away; printed nevertheless, unless it is `raw`."""
    return tag("details", tag("summary", summary), *content, class_=class_)


def link(text: Content, anchor: str) -> Markup:
    """A link to a place on the page."""
    return tag("a", text, href=f"#{anchor}")


def figure(
    drawn: go.Figure, caption: Content, wide: bool = False, linked: str | None = None
) -> Markup:
    """A figure with its caption, drawn by the page's script once it comes into sight.

    **Arguments:**

    - `wide`: scrolls on a narrow page.
    - `linked`: figures of the same word share their zoom in time.
    """
    height = int(drawn.layout.height or 400)
    box = tag(
        "div",
        class_="wide" if wide else "plot",
        style=f"height:{height}px",
        data_figure="",
        data_linked=linked,
        tabindex="0" if linked else None,
        role="group" if linked else "img",
        aria_label=f"{caption} Plus and minus zoom, arrows move, 0 resets." if linked else caption,
    )
    # Nothing that a figure holds can end the script early.
    data = Markup((drawn.to_json() or "").replace("<", "\\u003c"))
    script = tag("script", data, type="application/json")
    return tag("figure", tag("div", box, script, class_="scroll"), tag("figcaption", caption))


def section(title: str, *content: Content) -> Markup:
    """A section under its heading."""
    return tag("section", tag("h2", title), *content, id=anchor(title))


def anchor(title: str) -> str:
    """What a link to a section calls it."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())
