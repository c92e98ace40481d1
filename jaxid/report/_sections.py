"""The sections of the page, each from what the results can show."""

import hashlib
import json
import platform
from collections.abc import Sequence
from importlib import metadata

import numpy as np
import plotly.graph_objects as go

from ..discovery import Discovery
from ..discovery.diagnosis import Diagnosis, Verdict
from ..discovery.story import Contender, Step
from ..display import figures
from ..recording import Recording
from ._html import Content, Markup, details, figure, join, link, number, probability, table, tag
from ._next import recommended
from ._signals import against, along, compared, whiteness

WORDS = {
    "adequate": "adequate",
    "explained": "explained",
    "outside_catalogue": "outside the catalogue",
}


def section(title: str, *content: Content) -> Markup:
    """A section under its heading."""
    return tag("section", tag("h2", title), *content, id=anchor(title))


def anchor(title: str) -> str:
    """What a link to a section calls it."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())


def head(story: Discovery) -> Markup:
    """The verdict, what it did to the error, and what was found."""
    badge = tag("span", WORDS[story.verdict], class_=f"badge {story.verdict}")
    kicker = tag("p", "jaxid discover: ", tag("b", story.loop.name), " ", badge, class_="kicker")
    notes = [tag("p", note, class_="note") for note in story.notes]
    pieces = [kicker, tag("h1", story.sentence), tag("p", _lead(story), class_="lead")]
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
        lines.append(tag("li", tag("b", f"{step.added.spoken()}{where}"), f": {values}"))
    return tag("ul", *lines, class_="found") if lines else None


def _value(name: str, value: float, std: float | None, unit: str) -> str:
    deviation = "" if std is None else f" ± {number(float(f'{std:.2g}'))}"
    return f"{name} {number(value)}{deviation}{'' if unit == '1' else f' {unit}'}"


def contents(sections: Sequence[Markup]) -> Markup:
    """Links to the sections."""
    titles = [piece.split("<h2>")[1].split("</h2>")[0] for piece in sections]
    return tag("nav", *(link(Markup(t), anchor(t)) for t in titles), aria_label="sections")


def error(story: Discovery) -> Markup:
    """The error falling, as a figure and a table."""
    rows = story.table()
    if len(story.steps) > 1:
        drawn, caption = story.plot(), "Relative error by step, and the error that noise leaves."
    else:
        drawn, caption = _bars(story), "Relative error, and the error that noise alone leaves."
    values = [
        [str(step), *map(float, row)] for step, row in zip(rows.index, rows.to_numpy(), strict=True)
    ]
    return section(
        "The error" if len(rows) == 1 else "The error falling",
        figure(drawn, caption),
        table(["step", *(f"{c}, %" for c in rows.columns)], values, "relative error by step"),
    )


def _bars(story: Discovery) -> go.Figure:
    rows = story.table()
    joints = [c.removeprefix("fit, ") for c in rows.columns if c.startswith("fit, ")]
    values = rows.to_numpy().reshape(-1, len(joints))
    groups = ["fitted", "held out"][: len(values)]
    return figures.error_bars(joints, groups, values, story.noise_floor_percent())


def failure(story: Discovery) -> Markup:
    """Where the starting model fails."""
    step = story.steps[0]
    held = compared(step)
    name = held.recordings.names[0]
    caption = (
        f"The starting model along {name}: {held.signal}, what is left of it, and the "
        "autocorrelation of what is left. Drag to zoom, double-click to see all."
    )
    if len(story.steps) > 1:
        caption += " The figure of the final model, below, shows the same stretch."
    pieces: list[Content] = [along(story, held, 0, caption)]
    if step.diagnosis.depends_on():
        pieces.append(against(held, step.diagnosis.where[0], "the starting model"))
    pieces.append(_where_table(step.diagnosis))
    title = "Where the starting model failed" if len(story.steps) > 1 else "The model beside data"
    return section(title, *pieces)


def _where_table(diagnosis: Diagnosis) -> Markup:
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


def choice(story: Discovery) -> Markup:
    """Why these effects and not their rivals, step by step."""
    pieces: list[Content] = []
    for before, step in zip(story.steps, story.steps[1:], strict=False):
        assert step.added is not None
        pieces.append(tag("h3", step.label))
        pieces.append(tag("p", _reason(before.diagnosis, step)))
        pieces += _evidence(before.diagnosis)
        pieces += _rivals(step)
    if len(story.steps) == 1:
        pieces += _evidence(story.diagnosis)
    for name, joint in story.removed:
        where = "" if joint is None else f" on joint {joint}"
        pieces.append(tag("p", f"{name}{where} was added and later found not to be needed."))
    title = "Why this effect and not its rivals" if len(story.steps) > 1 else "What was asked"
    return section(title, *pieces)


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


def _rivals(step: Step) -> list[Content]:
    pieces: list[Content] = []
    if step.contenders:
        best = step.contenders[0].criterion
        rows = [
            [
                c.name,
                c.joint,
                type(c.fit.loop.effects[-1]).__name__,
                c.criterion,
                c.criterion - best,
                ", ".join(f"{x:.2f}" for x in _rms(c)),
            ]
            for c in step.contenders
        ]
        said = (
            "The leading entries were added and refitted in full. The criterion is the whitened "
            "squared error on fitted and held-out recordings plus BIC's price; less is better, "
            "and a difference of ten is decisive."
        )
        columns = ["effect", "joint", "form", "criterion", "behind the best", "fitted error, %"]
        pieces += [tag("p", said), table(columns, rows, "refitted contenders")]
    if step.alike:
        others = ", ".join(n + ("" if j is None else f" on joint {j}") for n, j in step.alike)
        said = f"These recordings cannot tell it from {others}."
        pieces.append(tag("p", said, class_="note"))
    else:
        pieces.append(tag("p", "Nothing else of the catalogue does as well on these recordings."))
    return pieces


def _rms(contender: Contender) -> np.ndarray:
    return np.sqrt(np.mean(contender.fit.error_percent.to_numpy() ** 2, axis=0))


def parameters(story: Discovery) -> Markup:
    """Every parameter of the final model with its interval."""
    first, last = story.steps[0].fit, story.fit
    start = dict(zip(first.names, first.theta.tolist(), strict=True))
    rows: list[Sequence[Content]] = []
    for name, value, std, unit in zip(last.names, last.theta, last.std, last.units, strict=True):
        low, high = float(value - 1.96 * std), float(value + 1.96 * std)
        known = bool(np.isfinite(std))
        interval = f"{number(low)}\u00a0…\u00a0{number(high)}" if known else "not determined"
        before = start.get(name)
        rows.append(
            [
                name,
                float(value),
                float(std),
                interval,
                unit,
                before if before is not None else "added",
            ]
        )
    columns = ["parameter", "value", "std", "95 % interval", "unit", "in the starting model"]
    remarks = [tag("p", s, class_="note") for s in (*last.undetermined, *last.notes)]
    deviations = tag("p", f"Deviations: {last.deviations}.") if last.deviations else None
    return section(
        "Parameters",
        table(columns, rows, "parameters of the final model"),
        deviations,
        *remarks,
        figure(last.plot(), "Two standard deviations either side, relative to each value.", True),
    )


def rest(story: Discovery) -> Markup:
    """What the final model leaves, and whether that is noise."""
    step = story.steps[-1]
    held = compared(step)
    pieces: list[Content] = []
    if len(story.steps) > 1:
        caption = f"The final model along {held.recordings.names[0]}."
        pieces.append(along(story, held, 0, caption))
    if story.verdict == "outside_catalogue" and story.diagnosis.depends_on():
        pieces.append(tag("h3", "What no entry explains"))
        pieces.append(against(held, story.diagnosis.where[0], "the final model"))
        if len(story.steps) > 1:
            pieces.append(_where_table(story.diagnosis))
    elif len(story.steps) > 1 and story.steps[0].diagnosis.depends_on():
        pieces.append(against(held, story.steps[0].diagnosis.where[0], "the final model"))
    pieces.append(tag("h3", "Is it noise?"))
    pieces.append(tag("div", *whiteness(story, held, 0), class_="pair"))
    return section("What is left", *pieces)


def ahead(story: Discovery) -> Markup:
    """What to record next."""
    return section("What to record next", *recommended(story))


def settings(story: Discovery) -> Markup:
    """Versions, recordings and settings, so that another can do it again."""
    fit = story.steps[0].fit
    packages = ("jaxid-robotics", "jax", "jaxlib", "diffrax", "equinox", "numpy", "scipy")
    facts = [
        ("robot", repr(fit.loop)),
        ("effects at the end", ", ".join(_effects(story)) or "none"),
        ("method of the last fit", repr(story.fit.method)),
        ("significance", f"{story.diagnosis.significance:g}"),
        ("took", f"{story.seconds:.0f} s"),
        ("machine", platform.platform()),
        ("Python", platform.python_version()),
        *((package, _version(package)) for package in packages),
    ]
    rows = [[name, value] for name, value in facts]
    recordings = [["fitted", *_recording(r)] for r in fit.recordings]
    held = story.steps[0].held_out
    if held is not None:
        recordings += [["held out", *_recording(r)] for r in held.recordings]
    columns = ["used", "recording", "samples", "duration, s", "rate, Hz", "SHA-256 of its numbers"]
    whole = tag("pre", json.dumps(_plain(story.to_dict()), indent=1, ensure_ascii=False))
    said = join("The story as ", tag("code", "jaxid discover --json"), " writes it")
    return section(
        "To do it again",
        table(columns, recordings, "recordings"),
        table(["setting", "value"], rows, "settings and versions"),
        details(said, whole, class_="raw"),
    )


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _effects(story: Discovery) -> list[str]:
    named = ((e.effect_name(), getattr(e, "joint", None)) for e in story.loop.effects)
    return [name if joint is None else f"{name}({joint})" for name, joint in named]


def _recording(recording: Recording) -> list[Content]:
    digest = hashlib.sha256()
    for signal in (recording.time, recording.q, recording.tau, recording.q_ref, recording.v):
        if signal is not None:
            digest.update(np.ascontiguousarray(signal, dtype="<f8").tobytes())
    size = [recording.samples, recording.duration, recording.rate]
    return [recording.name, *size, digest.hexdigest()[:16]]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed as a package"


def body(story: Discovery) -> Markup:
    """All sections in reading order."""
    parts = (error, failure, choice, parameters, rest, ahead, settings)
    sections = [part(story) for part in parts]
    return join(head(story), contents(sections), *sections)
