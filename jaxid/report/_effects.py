"""The curve of each effect that was found."""

import numpy as np

from ..discovery import Discovery
from ..discovery.text import capitalised
from ..effects import AbstractEffect
from ..errors import JaxidError
from ._head import effects_title, values_below
from ._html import Content, Markup, figure, section, tag


def effects(story: Discovery) -> Markup | None:
    """The torque of each added effect over what it depends on; None if no effect was added."""
    count = len(story.steps) - 1
    if not count:
        return None
    # Added effects are the last ones of the loop.
    drawn = [_curve(story, effect) for effect in story.loop.effects[-count:]]
    return section(effects_title(story), values_below(story), *drawn)


def _curve(story: Discovery, effect: AbstractEffect) -> Content:
    try:
        curve = story.curve(effect)
    except JaxidError as error:
        return tag("p", f"No curve of {effect.spoken()} can be drawn: {error}.")
    times = ", times the sign of velocity," if curve.signed else ""
    part = (
        f" The curve shows {100 * curve.share:.0f} % of it; the rest depends on other coordinates."
    )
    band = ", with its 95 % band" if np.isfinite(curve.std).all() else ""
    unsure = "" if band else " There is no band, because the recordings do not determine it."
    cloud = "" if curve.cloud is None else ", over the residual of the model without the effect"
    shown = "its change of the position reading" if curve.sensed else "its torque"
    caption = (
        f"{capitalised(curve.name)}: {shown}{times} against the {curve.coordinate}{band}{cloud}."
        f"{part * (curve.share < 0.98)}{unsure}"
    )
    return figure(curve.plot(), caption)
