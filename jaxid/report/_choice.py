"""Why the model's effects were chosen and not their rivals, and what else was asked."""

from collections.abc import Sequence

import numpy as np

from ..discovery import Discovery
from ..discovery.diagnosis import Diagnosis, Verdict
from ..discovery.models import Model
from ..discovery.story import Step
from ._html import Content, Markup, details, figure, probability, section, table, tag


def choice(story: Discovery) -> Markup:
    """Why these effects and not their rivals, step by step."""
    pieces: list[Content] = []
    pairs = zip(story.steps, story.steps[1:], strict=False)
    for k, (before, step) in enumerate(pairs, start=1):
        assert step.added is not None
        pieces.append(tag("h3", step.label))
        if before.diagnosis is not None:
            pieces.append(tag("p", _reason(before.diagnosis, step)))
            pieces += _evidence(before.diagnosis)
        pieces += _rivals(step, story.contenders(k))
    if len(story.steps) == 1:
        pieces += _evidence(story.diagnosis)
    for name, joint in story.removed:
        where = "" if joint is None else f" on joint {joint}"
        pieces.append(tag("p", f"{name}{where} was added and later found not to be needed."))
    if story.considered:
        pieces.append(_models(story))
    title = "Why this effect and not its rivals" if len(story.steps) > 1 else "What was asked"
    return section(title, *pieces)


def _models(story: Discovery) -> Content:
    """The best of all models that were looked at, beside each other."""

    def percent(errors: np.ndarray | None) -> str:
        return "" if errors is None else ", ".join(f"{x:.2f}" for x in errors)

    best = story.considered[0].score
    rows = [
        [
            m.label,
            f"{m.score - best:.1f}",
            probability(m.weight),
            percent(m.left),
            percent(m.unseen_percent),
            m.status,
        ]
        for m in story.considered[:12]
    ]
    said = (
        "The weight of a model with score S is exp(-S/2), over the sum of that of all models. "
        "Recordings that were held out enter the last errors only."
    )
    columns = ["model", "behind the best", "weight", "fitted error, %", "held-out error, %", "fit"]
    shown = table(columns, rows, "the best models")
    return details("The models that were looked at", tag("p", said), shown)


def _reason(diagnosis: Diagnosis, step: Step) -> str:
    """The choice in words: what the effect explains, and how far behind the next one is."""
    assert step.added is not None
    key = (step.added.effect_name(), getattr(step.added, "joint", None))
    ranked = [v for v in diagnosis.ranking if v.possible]
    chosen = next((v for v in ranked if v.key == key), None)
    others = [v for v in ranked if v.key != key]
    if chosen is None or not others:
        return "It was chosen by its refit."
    next_one = others[0]
    ahead = chosen.evidence - next_one.evidence
    likeness = abs(diagnosis.correlation(chosen, next_one))
    said = (
        f"Noise accounts for {100 * diagnosis.gram.count / diagnosis.gram.rest:.3g} % of the "
        f"whitened residual, {_named(chosen)} for {_share(diagnosis, chosen)}. The nearest rival "
        f"is {_named(next_one)} with {_share(diagnosis, next_one)}; their signatures correlate by "
        f"{likeness:.2f}. "
    )
    if ahead > 0:
        return said + f"Its evidence is {ahead:.0f} behind, and ten is decisive."
    return said + "That rival was ahead before the refit, and behind after it."


def _named(verdict: Verdict) -> str:
    joint = verdict.hypothesis.joint
    return verdict.hypothesis.effect.spoken() + ("" if joint is None else f" on joint {joint}")


def _share(diagnosis: Diagnosis, verdict: Verdict) -> str:
    return f"{100 * verdict.explained / diagnosis.gram.rest:.3g} %" if diagnosis.gram.rest else "0"


def _evidence(diagnosis: Diagnosis) -> list[Content]:
    said = (
        f"Every effect of the catalogue at its best setting, from one fit. p-values are corrected "
        f"for {diagnosis.tests:.0f} independent tests; below {diagnosis.significance:g} something "
        "counts as missing. Evidence is the whitened squared error an effect takes away, less "
        "log(samples) for each amplitude. Likeness is the correlation of a signature with the "
        "leader's."
    )
    leader = diagnosis.ranking[0] if diagnosis.ranking else None
    rows = [
        [
            r["effect"],
            r["joint"],
            r["evidence"],
            probability(r["p_value"]),
            r["explained_percent"],
            _unbroken(r["amplitude"]),
            r["predicted_error_percent"],
            float(f"{abs(diagnosis.correlation(leader, v)):.2f}") if leader else None,
            "" if r["possible"] else "unphysical",
        ]
        for v, r in zip(diagnosis.ranking, diagnosis.table().head(15).to_dict("records"))  # noqa: B905
    ]
    columns = [
        "effect",
        "joint",
        "evidence",
        "corrected p",
        "residual explained, %",
        "predicted amplitude",
        "predicted error, %",
        "likeness",
        "",
    ]
    return [
        figure(diagnosis.plot(), "Share of the whitened residual that each entry explains.", True),
        details("The ranking in numbers", tag("p", said), table(columns, rows, "the catalogue")),
    ]


def _unbroken(amplitudes: str) -> str:
    """Amplitudes that a line breaks between, not within."""
    return ", ".join(one.replace(" ", "\u00a0") for one in amplitudes.split(", "))


def _rivals(step: Step, contenders: Sequence[Model]) -> list[Content]:
    pieces: list[Content] = []
    if contenders:
        best = contenders[0].score
        rows = [
            [
                *m.names[-1],
                type(m.effects[-1]).__name__,
                # Scores are large, and what tells them apart is behind the point.
                f"{m.score:.1f}",
                f"{m.score - best:.1f}",
                "" if m.left is None else ", ".join(f"{x:.2f}" for x in m.left),
            ]
            for m in contenders
        ]
        said = (
            "The sets of effects that promised most were fitted in full. The score is -2 log of "
            "the likelihood of the fitted recordings, plus the price of what was estimated and of "
            "the search; less is better, and a difference of ten is decisive. Held-out recordings "
            "do not enter it."
        )
        columns = ["effect", "joint", "form", "score", "behind the best", "fitted error, %"]
        pieces += [tag("p", said), table(columns, rows, "refitted contenders")]
    if step.alike:
        others = ", ".join(n + ("" if j is None else f" on joint {j}") for n, j in step.alike)
        said = f"These recordings cannot tell it from {others}."
        pieces.append(tag("p", said, class_="note"))
    else:
        pieces.append(tag("p", "Nothing else of the catalogue does as well on these recordings."))
    return pieces


def where_table(diagnosis: Diagnosis) -> Markup:
    rows = []
    shares = diagnosis.where_table()["explained_percent"]
    for verdict, share in list(zip(diagnosis.where, shares, strict=True))[:10]:
        curve = verdict.hypothesis.effect
        rows.append(
            [
                f"joint {verdict.hypothesis.joint}",
                curve.spoken_coordinate,  # type: ignore[attr-defined]
                "yes" if curve.signed else "",  # type: ignore[attr-defined]
                probability(verdict.p_value),
                float(share),
            ]
        )
    columns = [
        "torque of",
        "depends on",
        "and on direction",
        "corrected p",
        "residual explained, %",
    ]
    caption = "free-form curves: on what the torque of which joint depends beyond the model"
    return details("On what else it might depend", table(columns, rows, caption))
