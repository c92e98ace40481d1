"""The sections of the page, each from what the results can show."""

import platform
from collections.abc import Sequence
from importlib import metadata

import numpy as np
import plotly.graph_objects as go

from .. import figures
from ..discovery import Comparison, Discovery, compare
from ..discovery.diagnose import Diagnosis, Verdict
from ..discovery.discover import Step
from ._html import Content, Markup, figure, join, number, probability, table, tag

WORDS = {
    "adequate": "adequate",
    "explained": "explained",
    "outside_catalogue": "outside the catalogue",
}
COORDINATES = {
    "q": ("position", 1),
    "v": ("velocity", 1),
    "a": ("acceleration", 1),
    "tau": ("torque", 0),
}


def section(title: str, *content: Content) -> Markup:
    """A section under its heading."""
    return tag("section", tag("h2", title), *content)


def head(story: Discovery) -> Markup:
    """The verdict, and what it did to the error."""
    badge = tag("span", WORDS[story.verdict], class_=f"badge {story.verdict}")
    rows = story.table()
    held = [c for c in rows.columns if c.startswith("held out")] or list(rows.columns)
    cards = []
    for place, name in enumerate(held):
        first, last = float(rows[name].iloc[0]), float(rows[name].iloc[-1])
        change = f"{first:.2f} → {last:.2f} %" if len(rows) > 1 else f"{last:.2f} %"
        floor = f"noise floor {story.noise_floor_percent()[place]:.2f} %"
        cards.append(
            tag("div", tag("b", change), tag("span", name), tag("small", floor), class_="card")
        )
    kicker = tag("p", "jaxid discover: ", tag("b", story.loop.name), " ", badge, class_="kicker")
    notes = [tag("p", note, class_="note") for note in story.notes]
    lead = tag("p", "Relative error of the torque", class_="lead")
    return tag(
        "header",
        kicker,
        tag("h1", story.sentence),
        lead,
        tag("div", *cards, class_="cards"),
        *notes,
    )


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


def compared(step: Step) -> Comparison:
    """The step's model beside recordings: held-out ones where there are any."""
    return step.held_out or compare(step.fit, step.fit.recordings)


def failure(story: Discovery) -> Markup:
    """Where the starting model fails."""
    step = story.steps[0]
    held = compared(step)
    name = held.recordings.names[0]
    pieces: list[Content] = [
        figure(
            held.plot(0),
            f"The starting model along {name}: {held.signal}, what is left of it, and the "
            "autocorrelation of what is left.",
            wide=True,
        )
    ]
    if step.diagnosis.depends_on():
        where = step.diagnosis.where[0]
        pieces.append(_against(held, where, "the starting model"))
    pieces.append(_where_table(step.diagnosis))
    title = "Where the starting model failed" if len(story.steps) > 1 else "The model beside data"
    return section(title, *pieces)


def _against(held: Comparison, where: Verdict, model: str) -> Markup:
    """The residual against the coordinate it depends on most, with its mean along it."""
    curve = where.hypothesis.effect
    joint: int = where.hypothesis.joint  # type: ignore[assignment]
    x, y = [], []
    for k, (run, rest) in enumerate(zip(held.runs, held.residuals, strict=True)):
        kept = np.isin(np.asarray(run.time), held.judged(k)[0])
        kind = curve.coordinate  # type: ignore[attr-defined]
        along = run.time if kind == "t" else np.asarray(getattr(run, kind))[:, curve.of - 1]  # type: ignore[attr-defined]
        x.append(np.asarray(along)[kept])
        sign = np.sign(np.asarray(run.v)[kept, joint - 1]) if curve.signed else 1.0  # type: ignore[attr-defined]
        y.append(rest[:, joint - 1] * sign)
    name, unit = _coordinate(held, curve)
    signed = " × sign of velocity" if curve.signed else ""  # type: ignore[attr-defined]
    torque, position = held.loop.arm.units()
    y_unit = (position if held.signal == "position" else torque)[joint - 1]
    middle, mean, band = _means(np.concatenate(x), np.concatenate(y))
    drawn = figures.curve_fit(
        np.concatenate(x),
        np.concatenate(y),
        name,
        unit,
        y_unit,
        middle,
        mean,
        band,
        y_name=f"residual of joint {joint}{signed}",
    )
    caption = (
        f"What {model} leaves of joint {joint}'s {held.signal}{signed}, against {name}; the line "
        "is its mean in stretches of equal count, the band two standard errors of independent "
        "samples."
    )
    return figure(drawn, caption)


def _coordinate(held: Comparison, curve: object) -> tuple[str, str]:
    kind, of = curve.coordinate, curve.of  # type: ignore[attr-defined]
    if kind == "t":
        return "time", "s"
    torque, position = held.loop.arm.units()
    unit = torque[of - 1] if kind == "tau" else position[of - 1]
    unit += {"v": "/s", "a": "/s²"}.get(kind, "")
    return f"{COORDINATES[kind][0]} of joint {of}", unit


def _means(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of y in stretches of x of equal count, and two standard errors."""
    order = np.array_split(np.argsort(x, kind="stable"), max(2, min(30, len(x) // 20)))
    middle = np.array([np.median(x[k]) for k in order])
    mean = np.array([np.mean(y[k]) for k in order])
    error = np.array([2 * np.std(y[k]) / np.sqrt(len(k)) for k in order])
    # A coordinate that stands still gives several stretches one place, which a line cannot have.
    distinct = np.append(True, np.diff(middle) > 0)
    return middle[distinct], mean[distinct], error[distinct]


def _where_table(diagnosis: Diagnosis) -> Markup:
    rows = [
        [
            r["coordinate"],
            "yes" if r["times_sign_of_v"] else "",
            r["joint"],
            probability(r["p_value"]),
            r["explained_percent"],
        ]
        for r in diagnosis.where_table().head(10).to_dict("records")
    ]
    columns = ["coordinate", "times sign of v", "joint", "corrected p", "residual explained, %"]
    caption = "free-form curves: on what the torque of which joint depends beyond the model"
    return table(columns, rows, caption)


def choice(story: Discovery) -> Markup:
    """Why these effects and not their rivals, step by step."""
    pieces: list[Content] = []
    for before, step in zip(story.steps, story.steps[1:], strict=False):
        pieces.append(tag("h3", step.label))
        pieces += _evidence(before.diagnosis)
        pieces += _rivals(step)
    if len(story.steps) == 1:
        pieces += _evidence(story.diagnosis)
    for name, joint in story.removed:
        where = "" if joint is None else f" on joint {joint}"
        pieces.append(tag("p", f"{name}{where} was added and later found not to be needed."))
    title = "Why this effect and not its rivals" if len(story.steps) > 1 else "What was asked"
    return section(title, *pieces)


def _evidence(diagnosis: Diagnosis) -> list[Content]:
    said = (
        f"Every effect of the catalogue at its best setting, from one fit. p-values are corrected "
        f"for {diagnosis.tests:.0f} independent tests; below {diagnosis.significance:g} something "
        "counts as missing. Evidence is the whitened squared error an effect takes away, less "
        "log(samples) for each amplitude."
    )
    rows = [
        [
            r["effect"],
            r["joint"],
            r["evidence"],
            probability(r["p_value"]),
            r["explained_percent"],
            _unbroken(r["amplitude"]),
            r["predicted_error_percent"],
            "" if r["possible"] else "unphysical",
        ]
        for r in diagnosis.table().head(15).to_dict("records")
    ]
    columns = [
        "effect",
        "joint",
        "evidence",
        "corrected p",
        "residual explained, %",
        "predicted amplitude",
        "predicted error, %",
        "",
    ]
    return [
        tag("p", said),
        figure(diagnosis.plot(), "Share of the whitened residual that each entry explains."),
        table(columns, rows, "ranking of the catalogue"),
    ]


def _unbroken(amplitudes: str) -> str:
    """Amplitudes that a line breaks between, not within."""
    return ", ".join(one.replace(" ", "\u00a0") for one in amplitudes.split(", "))


def _rivals(step: Step) -> list[Content]:
    pieces: list[Content] = []
    if step.contenders:
        best = step.contenders[0].criterion
        rows = [[c.name, c.joint, c.criterion, c.criterion - best] for c in step.contenders]
        said = (
            "The leading entries, added and refitted in full. The criterion is the whitened "
            "squared error on fitted and held-out recordings plus BIC's price; less is better, "
            "and a difference of ten is decisive."
        )
        columns = ["effect", "joint", "criterion", "behind the best"]
        pieces += [tag("p", said), table(columns, rows, "refitted contenders")]
    if step.alike:
        others = ", ".join(n + ("" if j is None else f" on joint {j}") for n, j in step.alike)
        said = f"These recordings cannot tell it from {others}."
        pieces.append(tag("p", said, class_="note"))
    else:
        pieces.append(tag("p", "Nothing else of the catalogue does as well on these recordings."))
    return pieces


def parameters(story: Discovery) -> Markup:
    """Every parameter of the final model with its interval."""
    first, last = story.steps[0].fit, story.fit
    start = dict(zip(first.names, first.theta.tolist(), strict=True))
    rows: list[Sequence[Content]] = []
    for name, value, std, unit in zip(last.names, last.theta, last.std, last.units, strict=True):
        low, high = float(value - 1.96 * std), float(value + 1.96 * std)
        known = bool(np.isfinite(std))
        interval = f"{number(low)} … {number(high)}" if known else "not determined"
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
        figure(last.plot(), "Two standard deviations either side, relative to each value."),
    )


def rest(story: Discovery) -> Markup:
    """What the final model leaves, and its autocorrelation."""
    step = story.steps[-1]
    held = compared(step)
    acf, bound = held.autocorrelation(0)
    pieces: list[Content] = []
    if len(story.steps) > 1:
        caption = f"The final model along {held.recordings.names[0]}."
        pieces.append(figure(held.plot(0), caption, wide=True))
    for joint, column in enumerate(acf.T, start=1):
        outside = int(np.sum(np.abs(column[1:]) > bound))
        caption = (
            f"Residual of joint {joint} along {held.recordings.names[0]}: {outside} of "
            f"{len(column) - 1} lags beyond the bound of a white one. Coloured noise goes beyond "
            "it too; what is structure, the verdict says."
        )
        lags = np.arange(1, len(column))
        pieces.append(figure(figures.autocorrelation(lags, column[1:], bound), caption))
    if story.verdict == "outside_catalogue" and story.diagnosis.depends_on():
        pieces.append(tag("h3", "What no entry explains"))
        pieces.append(_against(held, story.diagnosis.where[0], "the final model"))
        if len(story.steps) > 1:
            pieces.append(_where_table(story.diagnosis))
    return section("What is left", *pieces)


def settings(story: Discovery) -> Markup:
    """Versions, recordings and settings, so that another can do it again."""
    fit = story.steps[0].fit
    facts = [
        ("robot", repr(fit.loop)),
        ("effects at the end", ", ".join(_effects(story)) or "none"),
        ("method", repr(fit.method)),
        ("significance", f"{story.diagnosis.significance:g}"),
        ("took", f"{story.seconds:.0f} s"),
        ("Python", platform.python_version()),
        *((package, _version(package)) for package in ("jaxid-robotics", "jax", "diffrax")),
    ]
    rows = [[name, value] for name, value in facts]
    recordings = [["fitted", *_recording(r)] for r in fit.recordings]
    held = story.steps[0].held_out
    if held is not None:
        recordings += [["held out", *_recording(r)] for r in held.recordings]
    columns = ["used", "recording", "samples", "duration, s", "rate, Hz"]
    return section(
        "To do it again",
        table(columns, recordings, "recordings"),
        table(["setting", "value"], rows, "settings and versions"),
    )


def _effects(story: Discovery) -> list[str]:
    named = ((e.effect_name(), getattr(e, "joint", None)) for e in story.loop.effects)
    return [name if joint is None else f"{name}({joint})" for name, joint in named]


def _recording(recording) -> list[Content]:
    return [recording.name, recording.samples, recording.duration, recording.rate]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed as a package"


def body(story: Discovery) -> Markup:
    """All sections in reading order."""
    parts = (head, error, failure, choice, parameters, rest, settings)
    return join(*(part(story) for part in parts))
