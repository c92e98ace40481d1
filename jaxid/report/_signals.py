"""Signals beside the model: where it fails, and what it leaves."""

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from ..discovery import Comparison, Discovery, compare
from ..discovery.diagnosis import Verdict, coordinate_unit
from ..discovery.score import whitened
from ..discovery.story import Step
from ..display import figures
from ..effects import Curve
from ..noise import autocorrelation
from ._html import Markup, figure

LAGS = 38
# A stretch counts as misfit where its residual is this many times what noise leaves.
BEYOND = 2.0


def compared(step: Step) -> Comparison:
    """The step's model beside recordings: held-out ones where there are any."""
    return step.held_out or compare(step.fit, step.fit.recordings)


def along(story: Discovery, held: Comparison, recording: int, caption: str) -> Markup:
    """One recording beside the model, with the stretches marked that noise does not explain."""
    drawn = held.plot(recording)
    time, measured, simulated = held.judged(recording)
    noise = noise_level(story)
    for joint, rest in enumerate((measured - simulated).T):
        found = misfits(np.asarray(time), rest, float(noise[joint]))
        figures.mark_misfit(drawn, joint + 1, found, name=f"beyond {BEYOND:g} × noise")
    name = held.recordings.names[recording]
    return figure(drawn, caption, wide=True, linked=name)


def noise_level(story: Discovery) -> Float[np.ndarray, " joints"]:
    """Deviation of each joint's noise along the fitted recordings, in the unit of the signal."""
    fit = story.fit
    size = np.stack([np.sqrt(np.mean(rest**2, axis=0)) for rest in fit.residuals])
    share = story.diagnosis.floor / np.maximum(fit.error_percent.to_numpy(), 1e-12)
    return np.sqrt(np.mean((size * share) ** 2, axis=0))


def misfits(
    time: Float[np.ndarray, " samples"], residual: Float[np.ndarray, " samples"], noise: float
) -> list[tuple[float, float]]:
    """Stretches in which a residual is larger than its noise, as start and end in s.

    A moving mean square over a hundredth of the recording (21 samples at the least) is held
    against the noise's; stretches closer than that are one.
    """
    width = max(21, len(time) // 100)
    if noise <= 0 or len(time) < width:
        return []
    power = uniform_filter1d(residual**2, width, mode="nearest")
    wide = uniform_filter1d((power > (BEYOND * noise) ** 2).astype(float), width, mode="nearest")
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide > 1e-9, [0]]).astype(int)))
    half, last = width // 2, len(time) - 1
    return [
        (float(time[min(start + half, last)]), float(time[max(end - 1 - half, 0)]))
        for start, end in edges.reshape(-1, 2)
        if end - start > 2 * half
    ]


def against(held: Comparison, where: Verdict, model: str) -> Markup:
    """The residual against the coordinate it depends on most, with its mean along it."""
    curve = where.hypothesis.effect
    assert isinstance(curve, Curve)
    joint = curve.joint
    x, y = [], []
    for k, (run, rest) in enumerate(zip(held.runs, held.residuals, strict=True)):
        kept = np.isin(np.asarray(run.time), held.judged(k)[0])
        kind = curve.coordinate
        way = run.time if kind == "t" else np.asarray(getattr(run, kind))[:, curve.of - 1]
        sign = np.sign(np.asarray(run.v)[kept, joint - 1]) if curve.signed else 1.0
        # Where the joint stands still nothing was compared.
        moves = rest[:, joint - 1] != 0
        x.append(np.asarray(way)[kept][moves])
        y.append((rest[:, joint - 1] * sign)[moves])
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
    return figure(
        drawn,
        f"What {model} leaves of joint {joint}'s {held.signal}{signed}, against {on}. A model that "
        "lacks nothing leaves a flat line. The line is the mean in stretches of equal count, the "
        "band two standard errors of independent samples.",
    )


def whiteness(story: Discovery, held: Comparison, recording: int) -> list[Markup]:
    """Autocorrelation of each joint's residual once the noise filter is taken out of it."""
    rest = held.residuals[recording]
    mask = np.ones((1, len(rest)), bool)
    # The filter has nothing to go by in its first rows, which are zero.
    start = max(filt.order for filt in story.diagnosis.noise)
    shown = whitened(rest[None], story.diagnosis.noise, mask)[0, start:]
    pieces = []
    for joint, column in enumerate(shown.T, start=1):
        acf, bound = autocorrelation([column - column.mean()], LAGS)
        outside = int(np.sum(np.abs(acf[1:]) > bound))
        order = story.diagnosis.noise[joint - 1].order
        colour = f"noise coloured by a filter of order {order}" if order else "white noise"
        caption = (
            f"Joint {joint} along {held.recordings.names[recording]}, {colour} taken out: "
            f"{outside} of {LAGS} lags beyond the bound; {0.05 * LAGS:.0f} are expected of what "
            "is white."
        )
        drawn: go.Figure = figures.autocorrelation(np.arange(1, LAGS + 1), acf[1:], bound)
        drawn.update_layout(height=260)
        pieces.append(figure(drawn, caption))
    return pieces
