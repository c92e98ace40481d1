"""Errors of recordings and joints by step, and where the final model still fails."""

from collections.abc import Sequence

import numpy as np

from ..discovery import Comparison
from ..discovery.data import whitened
from ..discovery.diagnosis import Verdict
from ..display import figures
from ..effects import Curve
from ..effects.curve import coordinate_unit
from ..noise import autocorrelation, centred
from ._beside import Beside
from ._html import Content, Markup, breakable, cell, figure, join, section, table, tag
from ._models import where_table
from ._signals import misfits

LAGS = 38
# A joint counts as described by the model below this ratio of error to noise floor; a larger error
# is visible in a figure.
NEAR = 1.1


def errors(beside: Beside) -> Markup:
    """Relative errors of recordings and joints by step, with the noise floor."""
    story = beside.story
    fitted = [step.fit.error_percent.to_numpy() for step in story.steps]
    floor = story.diagnosis.floor_by_recording()
    rows = _rows("fitted", story.fit.recordings.names, fitted, floor)
    if beside.unseen:
        held = [s.held_out.error_percent.to_numpy() for s in story.steps if s.held_out is not None]
        rows += _rows("held out", beside.after.recordings.names, held, beside.floor)
    steps = [breakable(step.label) for step in story.steps]
    columns: list[Content] = ["recording", "joint", *steps, "noise floor", "last over floor"]
    said = (
        "Norm of measured minus simulated signal over norm of measured signal, in %, for each "
        "step. The noise floor is the error that a perfect model would leave, as estimated on the "
        f"fitted recordings. A ratio below {NEAR:g} means that the residual is almost only noise."
    )
    if story.floor_in_doubt().any():
        said += " If an effect is missing, it is too high where a model has estimated it."
    shown = table(columns, rows, "relative error in % by recording, joint and step")
    return section("All recordings, joints and steps", tag("p", said), shown)


def _rows(
    used: str, names: Sequence[str], by_step: Sequence[np.ndarray], floor: np.ndarray
) -> list[list[Content]]:
    rows: list[list[Content]] = []
    for k, name in enumerate(names):
        for j, by_noise in enumerate(floor[k].tolist()):
            values = [float(step[k, j]) for step in by_step]
            ratio = values[-1] / max(by_noise, 1e-12)
            shown = [cell(f"{x:.2f}", x) for x in (*values, by_noise)]
            last = cell(f"{ratio:.2f}", ratio, f"number {'good' if ratio < NEAR else 'bad'}")
            small = tag("small", f" {used}".replace("held out", "held\u00a0out"))
            rows.append([join(name, small), j + 1, *shown, last])
    return rows


def rest(beside: Beside) -> Markup:
    """Where the final model still fails, and whether its residual is noise."""
    story, held = beside.story, beside.after
    pieces: list[Content] = [tag("p", _verdict(beside))]
    columns = [
        "recording",
        "joint",
        "error, %",
        "noise floor, %",
        "time beyond twice the noise, %",
        "longest stretch",
        "autocorrelations out of bounds",
    ]
    said = (
        "The autocorrelations are those of the residual whitened by the noise filter of the fit. "
        f"Of {LAGS} autocorrelations of white noise, {0.05 * LAGS:.0f} are expected outside the "
        "bounds."
    )
    pieces += [table(columns, _failures(beside), "residual of the final model"), tag("p", said)]
    if story.diagnosis.depends_on():
        pieces += [
            against(held, story.diagnosis.where[0], "the final model"),
            where_table(story.diagnosis),
        ]
    return section("Where the model still fails", *pieces)


def _verdict(beside: Beside) -> Content:
    found = [
        f"{_joints(np.flatnonzero(above) + 1)} on {name}"
        for name, above in zip(beside.after.recordings.names, beside.ratio >= NEAR, strict=True)
        if above.any()
    ]
    left = beside.story.diagnosis.depends_on()
    if not found and not left:
        return "Nowhere in these recordings: the residual of every joint is almost only noise."
    if not found:
        return (
            "The residual of every joint is almost only noise, but it still depends on a "
            "coordinate:"
        )
    return f"The residual is larger than the noise for {'; for '.join(found)}."


def _joints(numbers: np.ndarray) -> str:
    *rest, last = map(str, numbers)
    return f"joints {', '.join(rest)} and {last}" if rest else f"joint {last}"


def _failures(beside: Beside) -> list[list[Content]]:
    rows: list[list[Content]] = []
    held = beside.after
    for k, name in enumerate(held.recordings.names):
        time, measured, simulated = held.judged(k)
        residual = measured - simulated
        noise, outside = beside.noise(k), _outside(beside, residual)
        for j, left in enumerate(residual.T):
            spans = misfits(np.asarray(time), left, float(noise[j]))
            lasted = sum(end - start for start, end in spans)
            share = 100 * lasted / max(float(time[-1] - time[0]), 1e-12)
            longest = max(spans, key=lambda span: span[1] - span[0], default=None)
            stretch = (
                "none" if longest is None else f"{longest[0]:.2f}\u00a0…\u00a0{longest[1]:.2f} s"
            )
            percent = [cell(f"{x[k, j]:.2f}", x[k, j]) for x in (beside.error, beside.floor)]
            counted = cell(f"{outside[j]} of {LAGS}", outside[j])
            rows.append([name, j + 1, *percent, cell(f"{share:.1f}", share), stretch, counted])
    return rows


def _outside(beside: Beside, residual: np.ndarray) -> list[int]:
    """How many autocorrelations of each joint's innovations are out of their bounds."""
    filters = beside.story.diagnosis.noise
    counts = []
    for column in whitened(residual[None], filters, residual[None] != 0)[0].T:
        acf, bound = autocorrelation([centred(column)], LAGS)
        counts.append(int(np.sum(np.abs(acf[1:]) > bound)))
    return counts


def against(held: Comparison, where: Verdict, model: str) -> Markup:
    """A model's residual against the coordinate on which it depends most."""
    curve = where.hypothesis.effect
    assert isinstance(curve, Curve)
    joint = curve.joint
    x, y = [], []
    for k, (run, left) in enumerate(zip(held.runs, held.residuals, strict=True)):
        kept = np.isin(np.asarray(run.time), held.judged(k)[0])
        kind = curve.coordinate
        way = run.time if kind == "t" else np.asarray(getattr(run, kind))[:, curve.of - 1]
        sign = np.sign(np.asarray(run.v)[kept, joint - 1]) if curve.signed else 1.0
        # Samples at which the joint stands still are not compared.
        moves = left[:, joint - 1] != 0
        x.append(np.asarray(way)[kept][moves])
        y.append((left[:, joint - 1] * sign)[moves])
    name = curve.spoken_coordinate
    signed = " × sign of velocity" if curve.signed else ""
    torque, position = held.loop.arm.units()
    drawn = figures.dependence(
        np.concatenate(x),
        np.concatenate(y),
        name,
        coordinate_unit(curve, torque, position),
        (position if held.signal == "position" else torque)[joint - 1],
        y_name=f"residual of joint {joint}{signed}",
    )
    on = name if curve.coordinate == "t" else f"the {name}"
    caption = (
        f"Residual of {model} in joint {joint}'s {held.signal}{signed}, against {on}. The line "
        "is the mean in bins of equal count; it is flat if the model is complete. The band is "
        "two standard errors for independent samples."
    )
    return figure(drawn, caption)
