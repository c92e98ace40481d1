"""The page's head: the verdict, what it did to the error, and what was found."""

from ..discovery import Discovery
from ..discovery.story import odds
from ._html import Markup, number, tag

WORDS = {
    "adequate": "adequate",
    "explained": "explained",
    "outside_catalogue": "outside the catalogue",
    "undetermined": "undetermined",
}


def head(story: Discovery) -> Markup:
    """The verdict, what it did to the error, and what was found."""
    badge = tag("span", WORDS[story.verdict], class_=f"badge {story.verdict}")
    kicker = tag("p", "jaxid discover: ", tag("b", story.loop.name), " ", badge, class_="kicker")
    notes = [tag("p", note, class_="note") for note in story.notes]
    # A reason is too long for a headline.
    said, _, why = story.sentence.partition(": ") if story.reason else (story.sentence, "", "")
    pieces = [kicker, tag("h1", f"{said.rstrip('.')}.")]
    if why:
        pieces.append(tag("p", f"{why[:1].upper()}{why[1:]}"))
    pieces.append(tag("p", _lead(story), class_="lead"))
    return tag("header", *pieces, tag("div", *_cards(story), class_="cards"), _found(story), *notes)


def _judged(story: Discovery) -> tuple[list[str], str]:
    """The columns by which the story is judged, and what they were taken on."""
    held = [c for c in story.table().columns if c.startswith("held out")]
    if held:
        return held, "recordings that no fit has seen"
    return list(story.table().columns), "the fitted recordings; none were held out"


def _lead(story: Discovery) -> str:
    _, where = _judged(story)
    return (
        "Relative error of the torque (norm of measured less simulated over norm of measured) on "
        f"{where}, and what noise alone would leave of it:"
    )


def _cards(story: Discovery) -> list[Markup]:
    rows = story.table()
    cards = []
    for place, name in enumerate(_judged(story)[0]):
        first, last = float(rows[name].iloc[0]), float(rows[name].iloc[-1])
        change = f"{first:.2f} → {last:.2f} %" if len(rows) > 1 else f"{last:.2f} %"
        floor = f"noise floor {story.noise_floor_percent()[place]:.2f} %"
        title = name.removeprefix("held out, ")
        cards.append(
            tag("div", tag("span", title), tag("b", change), tag("small", floor), class_="card")
        )
    return cards


def _found(story: Discovery) -> Markup | None:
    """Each added effect with its values."""
    lines = []
    steps = [step for step in story.steps if step.added is not None]
    for step, entry in zip(steps, story.to_dict()["added"], strict=True):
        assert step.added is not None
        where = "" if entry["joint"] is None else f" on joint {entry['joint']}"
        values = ", ".join(_value(name, **p) for name, p in entry["parameters"].items())
        sure = f" (probability {odds(step.probability)})"
        lines.append(tag("li", tag("b", f"{step.added.spoken()}{where}"), f"{sure}: {values}"))
    return tag("ul", *lines, class_="found") if lines else None


def _value(name: str, value: float, std: float | None, unit: str) -> str:
    deviation = "" if std is None else f" ± {number(float(f'{std:.2g}'))}"
    return f"{name} {number(value)}{deviation}{'' if unit == '1' else f' {unit}'}"
