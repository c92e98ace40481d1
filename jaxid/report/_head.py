"""The head of the page: the verdict, the question, and the effects that were found."""

from collections.abc import Sequence

from ..discovery import Discovery
from ._html import Markup, join, tag, with_deviation

WORDS = {
    "adequate": "adequate",
    "explained": "explained",
    "outside_catalogue": "outside the catalogue",
    "undetermined": "undetermined",
}


def head(story: Discovery) -> Markup:
    """The verdict, the question, and the effects that were found."""
    badge = tag("span", WORDS[story.verdict], class_=f"badge {story.verdict}")
    kicker = tag("p", "jaxid discover: ", tag("b", story.loop.name), " ", badge, class_="kicker")
    # A reason is too long for a headline.
    said, _, why = story.sentence.partition(": ") if story.reason else (story.sentence, "", "")
    reason = tag("p", f"{why[:1].upper()}{why[1:]}") if why else None
    notes = [tag("p", note, class_="note") for note in story.notes]
    title = tag("h1", f"{said.rstrip('.')}.")
    return tag("header", kicker, title, reason, _asked(story), _found(story), *notes)


def _asked(story: Discovery) -> Markup:
    first = story.steps[0]
    fitted = _listed(first.fit.recordings.names)
    judged = (
        "no recording was held out"
        if first.held_out is None
        else f"tested on held-out {_listed(first.held_out.recordings.names)}"
    )
    said = f"Question: which physical effect does this model lack? Fitted to {fitted}; {judged}."
    return tag("p", said, class_="lead")


def _listed(names: Sequence[str]) -> str:
    if len(names) > 3:
        return f"{', '.join(names[:2])} and {len(names) - 2} more recordings"
    return " and ".join(names) if len(names) < 3 else f"{names[0]}, {names[1]} and {names[2]}"


def _found(story: Discovery) -> Markup | None:
    """Each added effect with its values."""
    lines = []
    steps = [step for step in story.steps if step.added is not None]
    for step, entry in zip(steps, story.to_dict()["added"], strict=True):
        assert step.added is not None
        where = "" if entry["joint"] is None else f" on joint {entry['joint']}"
        values = ", ".join(_value(name, **p) for name, p in entry["parameters"].items())
        name = step.added.spoken()
        title = tag("b", f"{name[:1].upper()}{name[1:]}{where}")
        lines.append(tag("li", join(title, f": {values}")))
    return tag("ul", *lines, class_="found") if lines else None


def _value(name: str, value: float, std: float | None, unit: str) -> str:
    end = "" if unit == "1" else f"\u00a0{unit}"
    return f"{name}\u00a0{with_deviation(value, std)}{end}"
