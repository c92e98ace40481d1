"""The models that were compared, and what the effects of the catalogue would explain."""

import numpy as np

from ..discovery import Discovery
from ..discovery.diagnosis import Diagnosis, Verdict
from ..discovery.hypotheses import effect_on
from ..discovery.models import listed
from ..discovery.step import Step, odds, step_name
from ..discovery.text import capitalised
from ._html import (
    Content,
    Markup,
    bar,
    breakable,
    cell,
    details,
    join,
    probability,
    section,
    table,
    tag,
)

SHOWN = 12


def models(story: Discovery) -> Markup:
    """The models with their weights, and why each effect was chosen over its alternatives."""
    pieces: list[Content] = []
    if story.considered:
        pieces.append(_weights(story))
    for before, step in zip(story.steps, story.steps[1:], strict=False):
        pieces += [tag("h3", step.label), tag("p", _reason(before.diagnosis, step))]
        pieces.append(_alike(step))
    for name, joint in story.removed:
        said = f"{effect_on(name, joint)} was added and removed later, because it is not needed."
        pieces.append(tag("p", said))
    for step in story.steps:
        if step.diagnosis is not None:
            pieces.append(_screened(step.diagnosis, step))
    return section("Models that were compared", *pieces)


def _weights(story: Discovery) -> Markup:
    best = story.considered[0].score
    final = [step.added for step in story.steps if step.added is not None]
    rows = [
        [
            breakable(m.label_beside(final)),
            bar(odds(m.weight).replace(" ", "\u00a0"), m.weight, m.weight),
            cell(f"{m.score - best:.1f}", m.score - best),
            _percent(m.left),
            _percent(m.unseen_percent),
            m.status,
        ]
        for m in story.considered[:SHOWN]
    ]
    said = (
        "The weight is the probability of a model among all that were examined: exp(-score/2), "
        "divided by the sum over all models. Held-out recordings do not enter the score. A "
        "difference of ten in score is decisive."
    )
    if len(final) > 1:
        said += f" “final” stands for {listed(final)}."
    curves = [m.curve for m in story.considered[:SHOWN] if m.curve is not None]
    if curves:
        words = "; ".join(dict.fromkeys(f"{c.label} is the {c.spoken_coordinate}" for c in curves))
        said += f" A curve is a free-form function of a coordinate: {words}."
    columns = ["model", "weight", "score above the best", "fitted, %", "held out, %", "fit"]
    more = len(story.considered) - SHOWN
    which = "all of them" if more <= 0 else f"the best {SHOWN} of {len(story.considered)}"
    shown = table(columns, rows, f"models by weight ({which}); errors in % by joint")
    return Markup(tag("p", said) + shown)


def _percent(errors: np.ndarray | None) -> str:
    # Lines may break between joints but not within a number.
    return "" if errors is None else ", ".join(f"{x:.2f}" for x in errors)


def _reason(diagnosis: Diagnosis | None, step: Step) -> str:
    """The choice in words: what the effect explains, and the distance to the next effect."""
    if diagnosis is None or step.added is None:
        return "It was added together with the effect before it."
    key = (step.added.effect_name(), getattr(step.added, "joint", None))
    ranked = [v for v in diagnosis.ranking if v.possible]
    chosen = next((v for v in ranked if v.key == key), None)
    others = [v for v in ranked if v.key != key]
    if chosen is None or not others:
        return "It was chosen by the score of its refit."
    rival = others[0]
    said = (
        f"{capitalised(effect_on(chosen.hypothesis.effect.spoken(), key[1]))} explains "
        f"{_share(diagnosis, chosen)} of the whitened residual of the previous model; noise is "
        f"{100 * diagnosis.gram.count / diagnosis.gram.rest:.3g} % of it. The best other effect, "
        f"{effect_on(rival.hypothesis.effect.spoken(), rival.hypothesis.joint)}, explains "
        f"{_share(diagnosis, rival)}. The torques of the two have a correlation of "
        f"{abs(diagnosis.correlation(chosen, rival)):.2f}."
    )
    if chosen.evidence > rival.evidence:
        return said
    return f"{said} The other effect was ahead before both were fitted, and behind afterwards."


def _share(diagnosis: Diagnosis, verdict: Verdict) -> str:
    return f"{100 * verdict.explained / diagnosis.gram.rest:.3g} %" if diagnosis.gram.rest else "0"


def _alike(step: Step) -> Markup:
    if step.alike:
        others = ", ".join(effect_on(n, j) for n, j in step.alike)
        return tag("p", f"These recordings cannot distinguish it from {others}.", class_="note")
    return tag("p", "No other effect of the catalogue describes these recordings equally well.")


def _screened(diagnosis: Diagnosis, step: Step) -> Markup:
    """What each effect of the catalogue would explain in addition to a step's model."""
    leader = diagnosis.ranking[0] if diagnosis.ranking else None
    top = diagnosis.ranking[:15]
    told = diagnosis.table().head(len(top)).to_dict("records")
    rows = [
        [
            join(breakable(r["effect"]), tag("small", "" if r["possible"] else " unphysical")),
            r["joint"] if isinstance(r["joint"], int) else cell(r["joint"], 0.0),
            bar(f"{share:.3g}", share, share / 100),
            r["evidence"],
            cell(probability(r["p_value"]), r["p_value"]),
            _unbroken(r["amplitude"]),
            r["predicted_error_percent"],
            float(f"{abs(diagnosis.correlation(leader, v)):.2f}") if leader else None,
        ]
        for v, r in zip(top, told, strict=True)
        for share in (r["explained_percent"],)
    ]
    columns = [
        "effect",
        "joint",
        "residual explained, %",
        "evidence",
        "corrected p",
        "predicted amplitude",
        "predicted error, %",
        "likeness",
    ]
    said = (
        f"The first {len(top)} of {len(diagnosis.ranking)} entries of the catalogue, each at its "
        "best setting, predicted from one fit. p-values are "
        f"corrected for {diagnosis.tests:.0f} independent tests; an effect counts as missing below "
        f"{diagnosis.significance:g}. Evidence is the whitened squared error that an effect "
        "explains, minus log(samples) for each amplitude. Likeness is the correlation of its "
        "torque with that of the first effect of the list. An unphysical effect would need "
        "values that its law forbids, such as negative friction. “setting” is the multiple of the "
        "change by which an effect without an amplitude was simulated."
    )
    title = "What each effect would explain beyond " + (
        "the starting model" if step.added is None else f"the model with {step_name(step)}"
    )
    return details(title, tag("p", said), table(columns, rows, title))


def _unbroken(amplitudes: str) -> str:
    """Amplitudes; lines may break between them but not within one."""
    signed = amplitudes.replace("-", "−")
    return ", ".join(one.replace(" ", "\u00a0") for one in signed.split(", "))


def where_table(diagnosis: Diagnosis) -> Markup:
    """Free-form curves: the coordinates on which each joint's unexplained torque depends."""
    rows = []
    shares = diagnosis.where_table()["explained_percent"]
    for verdict, share in list(zip(diagnosis.where, shares, strict=True))[:10]:
        curve = verdict.hypothesis.effect
        rows.append(
            [
                f"joint {verdict.hypothesis.joint}",
                curve.spoken_coordinate,  # type: ignore[attr-defined]
                "yes" if curve.signed else "",  # type: ignore[attr-defined]
                cell(probability(verdict.p_value), verdict.p_value),
                bar(f"{float(share):.3g}", float(share), float(share) / 100),
            ]
        )
    columns = [
        "torque of",
        "depends on",
        "and on direction",
        "corrected p",
        "residual explained, %",
    ]
    caption = "free-form curves: coordinates on which the residual of the final model depends"
    return details("Other coordinates that may matter", table(columns, rows, caption))
