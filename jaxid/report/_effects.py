"""The curve of each effect that was found."""

from ..discovery import Discovery
from ..effects import AbstractEffect
from ..errors import JaxidError
from ._html import Content, Markup, figure, section, tag


def effects(story: Discovery) -> Markup | None:
    """The torque of each added effect over what it depends on; None if no effect was added."""
    count = len(story.steps) - 1
    if not count:
        return None
    # Added effects are the last ones of the loop.
    drawn = [_curve(story, effect) for effect in story.loop.effects[-count:]]
    return section("Effect that was found" if count == 1 else "Effects that were found", *drawn)


def _curve(story: Discovery, effect: AbstractEffect) -> Content:
    try:
        curve = story.curve(effect)
    except JaxidError as error:
        return tag("p", f"No curve of {effect.spoken()} can be drawn: {error}.")
    times = ", times the sign of velocity," if curve.signed else ""
    part = f" It shows {100 * curve.share:.0f} % of the effect's torque." * (curve.share < 0.98)
    cloud = "" if curve.cloud is None else " over the residual of the model without it"
    caption = (
        f"{_upper(curve.name)}: its torque{times} against the {curve.coordinate}, with its 95 % "
        f"band{cloud}.{part}"
    )
    return figure(curve.plot(), caption)


def _upper(words: str) -> str:
    return words[:1].upper() + words[1:]
