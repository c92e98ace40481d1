"""The head of the page: the verdict, the question, and the effects that were found."""

from collections.abc import Sequence

from ..discovery import Discovery
from ..discovery.hypotheses import effect_on
from ..discovery.step import Step
from ..discovery.text import capitalised, in_brackets
from ._html import Markup, anchor, join, link, section, tag, with_deviation

# Characters above which the headline is smaller.
LONG = 110
# Effects whose values are shown in the head.
MOST = 2
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
    # A reason is too long for a headline, and the effects follow it.
    said = story.sentence.partition(": ")[0] if story.reason else story.headline
    said = f"{said.rstrip('.')}.".replace("joint ", "joint\u00a0")
    title = tag("h1", said, class_="long" if len(said) > LONG else None)
    found = _names(story) if _many(story) else values(story)
    return tag("header", kicker, title, _reason(story), _asked(story), found)


def notes(story: Discovery) -> Markup | None:
    """The notes of a story; None if there are none."""
    if not story.notes:
        return None
    return section("Notes", *(tag("p", _sentence(note), class_="note") for note in story.notes))


def _reason(story: Discovery) -> Markup | None:
    if not story.reason:
        return None
    best = "The best model adds the effects below, but " if len(story.steps) > 1 else ""
    return tag("p", _sentence(f"{best}{story.reason}"))


def _sentence(words: str) -> str:
    # A name in a program begins with a small letter.
    first = words.split(" ")[0]
    said = capitalised(words) if first.isalpha() else words
    return f"{said.rstrip('.')}.".replace("\u00a0%", " %").replace(" %", "\u00a0%")


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


def _many(story: Discovery) -> bool:
    """Whether the values of all effects would move the first figure off the first screen."""
    return sum(step.added is not None for step in story.steps) > MOST


def _names(story: Discovery) -> Markup:
    """The added effects, without their values."""
    names = [_name(step) for step in story.steps if step.added is not None]
    where = link("values", anchor(effects_title(story)))
    return tag("p", tag("b", "Added: "), f"{', '.join(names)} (", where, ").", class_="added")


def values_below(story: Discovery) -> Markup | None:
    """Each added effect with its values, if they are too many for the head."""
    return values(story) if _many(story) else None


def values(story: Discovery) -> Markup | None:
    """Each added effect with its probability and its values."""
    lines = []
    steps = [step for step in story.steps if step.added is not None]
    for step, entry in zip(steps, story.to_dict()["added"], strict=True):
        shown = "; ".join(_value(name, **p) for name, p in entry["parameters"].items())
        name = _name(step)
        title = tag("b", capitalised(name))
        # A number stays with its sign.
        sure = step.belief().replace("> ", ">\u00a0").replace("< ", "<\u00a0")
        lines.append(tag("li", join(title, f"{in_brackets(sure)}: {shown}")))
    return tag("ul", *lines, class_="found") if lines else None


def _name(step: Step) -> str:
    assert step.added is not None
    joint = getattr(step.added, "joint", None)
    return effect_on(step.added.spoken(), joint).replace("joint ", "joint\u00a0")


def effects_title(story: Discovery) -> str:
    """The title of the section that shows the effects."""
    return "Effect that was found" if len(story.steps) == 2 else "Effects that were found"


def _value(name: str, value: float, std: float | None, unit: str) -> str:
    end = "" if unit == "1" else f"\u00a0{unit}"
    spoken = name.replace("_", "\u00a0")
    return f"{spoken}\u00a0{with_deviation(value, std)}{end}"
