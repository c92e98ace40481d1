"""What to record next, if that can change the verdict."""

from ..discovery import Discovery, next_experiment
from ..discovery.diagnosis import Diagnosis, Verdict
from ..discovery.explore import DECISIVE
from ..discovery.hypotheses import effect_on
from ..errors import JaxidError
from ._html import Content, Markup, figure, number, section, tag


def ahead(story: Discovery) -> Markup | None:
    """A reference to distinguish effects that look alike so far; None if there are none."""
    asked = _open_question(story)
    if asked is None:
        return None
    return section("What to record next", *_experiment(*asked))


def _open_question(story: Discovery) -> tuple[Diagnosis, list[Verdict], str] | None:
    """The diagnosis, the effects that the next recording should distinguish, and the reason."""
    diagnosis = None
    for before, step in zip(story.steps, story.steps[1:], strict=False):
        # An intermediate model may not have been linearised; the diagnosis before it is used then.
        diagnosis = before.diagnosis or diagnosis
        if not step.alike or step.added is None or diagnosis is None:
            continue
        key = (step.added.effect_name(), getattr(step.added, "joint", None))
        known = {v.key: v for v in diagnosis.ranking}
        others = [known[k] for k in step.alike if k in known][:2]
        if key not in known or not others:
            continue
        said = " or ".join(effect_on(v.hypothesis.effect.spoken(), v.key[1]) for v in others)
        name = effect_on(step.added.spoken(), key[1])
        why = f"These recordings cannot tell whether the model lacked {name} or {said}."
        return diagnosis, [known[key], *others], why
    return None


def _experiment(diagnosis: Diagnosis, effects: list[Verdict], why: str) -> list[Content]:
    try:
        proposed = next_experiment(diagnosis, effects)
    except JaxidError as error:
        return [tag("p", f"{why} No reference can be proposed: {error}.", class_="note")]
    if proposed.then < DECISIVE or proposed.then < proposed.now:
        # The recording would not change the verdict.
        said = f"{why} No reference within the limits reached so far would distinguish them."
        return [tag("p", said)]
    unit = diagnosis.fit.loop.arm.units()[1]
    drawn = proposed.plot()
    for row, one in enumerate(unit, start=1):
        drawn.update_yaxes(title_text=f"joint {row} ({one})", row=row, col=1)
    drawn.update_layout(showlegend=False)
    caption = (
        f"Reference of {proposed.recording.duration:.0f} s within the positions, speeds, "
        "accelerations and torques reached so far. The effects differ by "
        f"{number(proposed.then)} in whitened squared error on it, and by {number(proposed.now)} "
        f"on the present recordings; {DECISIVE:g} is decisive."
    )
    said = f"{why} Record this reference and fit it too: it distinguishes the effects."
    return [tag("p", said), figure(drawn, caption)]
