"""What to record next, and how far the recordings at hand have reached."""

import numpy as np

from ..discovery import Discovery, next_experiment
from ..discovery.diagnosis import Diagnosis, Verdict
from ..errors import JaxidError
from ..excitation import Limits
from ._html import Content, figure, number, table, tag


def recommended(story: Discovery) -> list[Content]:
    """A reference to record, with what it is good for; and the limits of what was seen."""
    pieces = _experiment(story)
    pieces += [tag("p", _weakest(story)), _reach(story.diagnosis)]
    return pieces


def _experiment(story: Discovery) -> list[Content]:
    asked, why = _question(story)
    if asked is None:
        return [tag("p", why)]
    diagnosis, effects = asked
    try:
        proposed = next_experiment(diagnosis, effects)
    except JaxidError as error:
        return [tag("p", f"No reference can be proposed: {error}.", class_="note")]
    unit = diagnosis.fit.loop.arm.units()[1]
    drawn = proposed.plot()
    for row, one in enumerate(unit, start=1):
        drawn.update_yaxes(title_text=f"reference of joint {row} ({one})", row=row, col=1)
    gain = "more" if proposed.then > 1.1 * proposed.now else "no more"
    caption = (
        f"A reference of {proposed.recording.duration:.0f} s within the positions, speeds, "
        f"accelerations and torques reached so far. Whitened squared error: "
        f"{number(proposed.then)}, where the recordings at hand give {number(proposed.now)}, so it "
        f"tells {gain} than they do. Ten is decisive."
    )
    return [tag("p", why), figure(drawn, caption)]


def _question(story: Discovery) -> tuple[tuple[Diagnosis, list[Verdict]] | None, str]:
    """Which effects the next recording should set apart, on which diagnosis; and why."""
    for before, step in zip(story.steps, story.steps[1:], strict=False):
        if not step.alike or step.added is None or before.diagnosis is None:
            continue
        key = (step.added.effect_name(), getattr(step.added, "joint", None))
        known = {v.key: v for v in before.diagnosis.ranking}
        others = [known[k] for k in step.alike if k in known]
        if key in known and others:
            said = " and ".join(v.hypothesis.effect.spoken() for v in others[:2])
            why = (
                f"{_upper(step.added.spoken())} and {said} look alike in these recordings. This "
                "reference sets them apart."
            )
            return (before.diagnosis, [known[key], *others[:2]]), why
    if story.verdict == "outside_catalogue" and story.diagnosis.where:
        leader = story.diagnosis.where[0]
        why = (
            "What is left is no effect of the catalogue. This reference shows most of the "
            "dependence that was found, so that its form can be read off."
        )
        return (story.diagnosis, [leader]), why
    if len(story.steps) == 1 and story.reason:
        return None, f"These recordings do not tell: {story.reason}."
    if len(story.steps) == 1:
        return None, "Nothing is missing, so there is nothing to tell apart."
    step = story.steps[-1]
    # The model before the last effect may never have been linearised.
    before = next(s for s in story.steps[-2::-1] if s.diagnosis is not None)
    assert step.added is not None
    assert before.diagnosis is not None
    key = (step.added.effect_name(), getattr(step.added, "joint", None))
    leader = next((v for v in before.diagnosis.ranking if v.key == key), None)
    if leader is None:
        return None, "Nothing is left that another recording would have to tell apart."
    why = (
        f"Nothing looks like {step.added.spoken()} in these recordings. To see it on a motion it "
        "was not found on, record this reference: of those tried it shows most of it."
    )
    return (before.diagnosis, [leader]), why


def _range(low: float, high: float, unit: str) -> str:
    return f"{number(float(f'{low:.3g}'))} … {number(float(f'{high:.3g}'))} {unit}".replace(
        " ", "\u00a0"
    )


def _upper(words: str) -> str:
    return words[:1].upper() + words[1:]


def _weakest(story: Discovery) -> str:
    """Which parameters another recording would do most for."""
    fit = story.fit
    known = {
        name: 100 * std / abs(value)
        for name, value, std in zip(fit.names, fit.theta.tolist(), fit.std.tolist(), strict=True)
        if value != 0 and np.isfinite(std) and std > 0.05 * abs(value)
    }
    if not known:
        return "Every parameter that is determined is known to better than 5 %."
    loose = sorted(known.items(), key=lambda item: -item[1])[:3]
    named = ", ".join(f"{name} (±{percent:.2g} %)" for name, percent in loose)
    return f"Least certain: {named}; motion that makes more of them narrows their intervals."


def _reach(diagnosis: Diagnosis) -> Content:
    limits = Limits.of(diagnosis.fit.recordings)
    torque, position = diagnosis.fit.loop.arm.units()
    rows = [
        [
            f"joint {j + 1}",
            _range(limits.low[j], limits.high[j], position[j]),
            f"{limits.speed[j]:.3g} {position[j]}/s",
            f"{limits.acceleration[j]:.3g} {position[j]}/s²",
            f"{limits.torque[j]:.3g} {torque[j]}",
        ]
        for j in range(len(limits.low))
    ]
    columns = ["", "position", "speed up to", "acceleration up to", "torque up to"]
    return table(columns, rows, "how far the recordings reach: beyond it nothing has been seen")
