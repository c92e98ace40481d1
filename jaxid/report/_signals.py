"""Measured and simulated signals, before and after, of one joint at a time."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from ..display import figures
from ._beside import Beside
from ._html import Markup, choose, figure, join, percent, section, tag

# Points of a line, in total over all joints: this limits the size of the page, and a single joint
# is drawn in full detail.
POINTS = 12_000
# A stretch is a misfit if its RMS residual exceeds this multiple of the noise.
BEYOND = 2.0
# Share of a recording up to which misfits are marked.
MARKED = 0.4


def signals(beside: Beside) -> Markup:
    """Measured and simulated on one axis with the residual below, one figure per joint."""
    held, k = beside.after, beside.worst
    seen = "which was held out" if beside.unseen else "which was fitted"
    many = len(held.recordings)
    which = f" (the one with the largest errors, of {many} recordings)" if many > 1 else ""
    when = ", before → after" if beside.several else ""
    name = held.recordings.names[k]
    said = f"Relative error of the {held.signal} on {name}, {seen}{which}{when}:"
    panels = [
        tag("div", _figure(beside, j), class_="panel", data_panel=str(j + 1))
        for j in range(held.loop.joints)
    ]
    return section("Measured and simulated", tag("p", said), _cards(beside), _zoom(), *panels)


def _cards(beside: Beside) -> Markup:
    """Errors of all joints; with several joints, each card selects the figure of its joint."""
    before = beside.before.error_percent.to_numpy()[beside.worst]
    after, floor = beside.error[beside.worst], beside.floor[beside.worst]
    rows = []
    for j in range(len(after)):
        change = f"{percent(after[j])}\u00a0%"
        if beside.several:
            change = f"{percent(before[j])}\u00a0→\u00a0{change}"
        small = tag("small", f"noise alone\u00a0{percent(floor[j])}\u00a0%")
        rows.append(join(tag("span", f"joint {j + 1}"), tag("b", change), small))
    if len(rows) == 1:
        return tag("div", tag("div", rows[0], class_="card alone"), class_="cards")
    return choose("joint", "Joint that is shown", rows, beside.lead)


def _zoom() -> Markup:
    keys = (
        ("+", "+", "zoom in"),
        ("−", "-", "zoom out"),
        ("←", "ArrowLeft", "earlier"),
        ("→", "ArrowRight", "later"),
        ("all", "0", "show all"),
    )
    buttons = [
        tag("button", sign, type="button", data_key=key, aria_label=said, title=said)
        for sign, key, said in keys
    ]
    return tag("div", *buttons, class_="zoom", role="group", aria_label="zoom in time")


def _figure(beside: Beside, joint: int) -> Markup:
    held, k = beside.after, beside.worst
    time, measured, after = (x if x.ndim == 1 else x[:, joint] for x in held.shown(k))
    before = beside.before.shown(k)[2][:, joint] if beside.several else None
    torque, position = held.loop.arm.units()
    noise = float(beside.noise(k)[joint])
    drawn = figures.before_after(
        time,
        measured,
        after,
        before,
        BEYOND * noise,
        name=held.signal,
        unit=(position if held.signal == "position" else torque)[joint],
        most=min(figures.MAX_POINTS, POINTS // held.loop.joints),
    )
    found = misfits(time, np.nan_to_num(measured - after), noise)
    # Marks over most of a figure carry no information; the table of residuals has the share.
    if sum(end - start for start, end in found) < MARKED * (time[-1] - time[0]):
        figures.mark_misfit(drawn, 1, found, name="beyond noise")
    models = "before and after the effects were added" if beside.several else "by the model"
    caption = (
        f"Joint {joint + 1} along {held.recordings.names[k]}: {held.signal} as measured and as "
        f"simulated {models}, with the residual below. The band contains 95 % of the residual "
        "that noise alone would leave."
    )
    return figure(drawn, caption, linked=True)


def misfits(
    time: Float[np.ndarray, " samples"], residual: Float[np.ndarray, " samples"], noise: float
) -> list[tuple[float, float]]:
    """Stretches in which a residual is larger than its noise, as start and end in s.

    A moving mean square over a hundredth of the recording (at least 21 samples) is compared
    with that of the noise; stretches closer together than that are merged.
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
