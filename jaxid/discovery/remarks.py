"""Notes on a discovery in addition to its verdict."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..control import Tracking
from ..effects import AbstractEffect, ActuatorLag, TimeDelay
from ..estimate import Fit
from ..estimate.result import joint_columns
from ..estimate.standstill import slow_note
from ..simulation.batch import motion_cutoff
from ..simulation.loop import ClosedLoop
from ..simulation.widening import LEAD
from .alongside import LATE
from .diagnosis import Diagnosis, over_recordings
from .explore import DECISIVE
from .hypotheses import amplitude_names, effect_on
from .loose import DETERMINED
from .models import named
from .offsets import held_offsets
from .step import Step, found_parameters
from .text import joined


def remarks(
    steps: Sequence[Step], given: ClosedLoop, offsets: Mapping[str, AbstractEffect]
) -> tuple[str, ...]:
    """Notes on failed fits, released values, offsets, noise, bounds, slow motion and late drives.

    **Arguments:**

    - `given`: the starting loop of the discovery.
    - `offsets`: names of offsets, each with the effect that explains the recordings in its place.
    """
    bad = [s.label for s in steps if not s.fit.succeeded]
    said = [f"the fit of {', '.join(bad)} did not converge: use its values with care"]
    last = steps[-1].fit
    more = (*_estimated(last, given), *_delayed(last, given), *_instead(last, given, offsets))
    more = (*more, *_uncertain(steps), *_coloured(steps[-1]), *_out_of_bounds(steps[-1].diagnosis))
    more = (*more, *slow_note(given.standstill, last.loop), *looks_sampled(last))
    return (*(said if bad else ()), *more)


def _uncertain(steps: Sequence[Step]) -> list[str]:
    """Notes on added effects that are certain although each of their values is uncertain."""
    loop = steps[-1].fit.loop
    shapes = [p for p in loop.free_parameters if p.place[0] == "effects" and p.size == 1]
    found = []
    added = [step.added for step in steps if step.added is not None]
    for k, effect in enumerate(added):
        values = found_parameters(steps, k).values()
        if any(x["std"] is not None and abs(x["value"]) > DETERMINED * x["std"] for x in values):
            continue
        joint = getattr(effect, "joint", None)
        free = [p.name for p in shapes if p.joint == joint and not p.declaration.linear]
        label = effect_on(*named(effect))
        if joint is not None and free:
            found.append(
                f"each value of {label} is uncertain, although the error is larger without it: its "
                f"size and {joined(free)} can replace each other, and the recordings determine "
                f"only the sum of the effects on joint {joint}"
            )
        elif len(values) > 1:
            found.append(
                f"each value of {label} is uncertain, although together they are not zero: along "
                "these recordings they can replace each other or other parameters"
            )
    return found


def _coloured(last: Step) -> list[str]:
    """A note on joints whose error counts as noise, although another noise floor is lower."""
    floor = None if last.diagnosis is None else last.diagnosis.measured
    if floor is None or not floor.coloured.any():
        return []
    columns = joint_columns(last.fit.loop.joints)
    high, low = over_recordings(floor.percent), over_recordings(floor.low)
    said = [
        f"{columns[j]} ({high[j]:.3g} %, and {low[j]:.3g} % from the other noise floors)"
        for j in np.flatnonzero(floor.coloured)
    ]
    return [
        f"the error of {joined(said)} counts as noise, because the motion of other recordings "
        "does not predict it: it may be slow noise, or torque that something else causes"
    ]


# Share of the residual that an effect out of its bounds must explain to be mentioned.
_MUCH = 0.1


def _out_of_bounds(diagnosis: Diagnosis | None) -> list[str]:
    """A note on an effect that explains most of all, with values that its bounds forbid."""
    if diagnosis is None or not diagnosis.ranking:
        return []
    first, *others = diagnosis.ranking
    rivals = [v.evidence for v in (*diagnosis.where, *others) if v.possible]
    ahead = first.evidence - max(rivals, default=0.0)
    total = diagnosis.gram.rest
    # Without amplitudes, an effect is simulated at a finite setting.
    names = amplitude_names(diagnosis.fit.loop, first.hypothesis.effect)
    much = ahead > DECISIVE and first.explained > _MUCH * total
    if first.possible or not names or not much:
        return []
    values, stds = diagnosis.amplitude(first)
    limits = zip(first.hypothesis.lower, first.hypothesis.upper, strict=True)
    wrong = [
        f"{name} = {value:.3g} ± {std:.2g}{'' if unit == '1' else f' {unit}'} (bounds {a:g}, {b:g})"
        for (name, unit), value, std, (a, b) in zip(names, values, stds, limits, strict=True)
        if not a <= value <= b
    ]
    if not wrong:
        return []
    return [
        f"{effect_on(*first.key)} would explain {100 * first.explained / total:.0f} % of the "
        f"squared residual, more than any other effect or curve, but with {joined(wrong)}: if your "
        "robot can have such a value, define this effect with wider bounds; otherwise another "
        "effect resembles it"
    ]


# What the lead of a friction means: a small one, and one above the time constant of the low-pass.
_LOW_PASS = (
    "; the low-pass makes velocity late where friction jumps, by up to {:.2g} ms at this cutoff, "
    "and the lead corrects this (simulations of a law ignore it)"
)
_SOFT = (
    "; friction of simulators with soft constraints precedes velocity, that of real joints does "
    "not: on a measured arm something else is missing (simulations of a law ignore the lead)"
)
# Deviations between an estimate and the default value that it contradicts.
_APART = 3.0


def _estimated(fit: Fit, given: ClosedLoop) -> list[str]:
    """Notes on values with a default that the search estimated."""
    places = {p.place for p in given.free_parameters}
    held = {p.place: p for p in given.parameters if p.place not in places}
    found = []
    for p in fit.loop.free_parameters:
        if p.place in held:
            before, row = float(held[p.place].where(given)), fit.table().loc[p.name]
            unit = "" if row["unit"] == "1" else f" {row['unit']}"
            value, std = row["value"], row["std"]
            said = f"{p.name} was estimated, {value:.3g}"
            if not np.isfinite(std):
                found.append(f"{said}{unit}, but these recordings do not determine it")
                continue
            far = abs(value - before) > _APART * std
            found.append(
                f"{said} ± {std:.2g}{unit}: these recordings "
                + ("" if far else "do not ")
                + f"contradict its default value of {before:.3g}"
                + (_lead(value, fit) if p.place[-1] == LEAD else "")
            )
    return found


def _lead(value: float, fit: Fit) -> str:
    """The cause of a lead of friction over velocity, as the end of a sentence.

    Where friction jumps, acceleration jumps as well. There a low-pass of the position changes the
    velocity, so that its zero is later than that of the joint.
    """
    law, recordings = fit.loop.controller, fit.recordings
    own = isinstance(law, Tracking)
    cutoff = min(map(law.known, recordings)) if own else motion_cutoff(law, recordings)
    constant = 1 / (2 * np.pi * cutoff)
    return _LOW_PASS.format(1e3 * constant) if value < constant else _SOFT


def _delayed(fit: Fit, given: ClosedLoop) -> list[str]:
    """A note on the delay between torque and motion, if the estimate contradicts the given one."""
    names = [p.name for p in fit.loop.free_parameters if p.place == ("controller", "delay")]
    found = []
    for name in names:
        value, std = fit.table().loc[name, ["value", "std"]]
        before = float(given.controller.late)
        if abs(value - before) > _APART * std:
            way = "later" if value > 0 else "earlier"
            samples = value / fit.recordings.common_period()
            held = _APART * std / fit.recordings.common_period()
            if abs(samples - 0.5) < max(held, _ABOUT):
                cause = "as if it is held from one sample to the next"
            elif 0 < samples <= LATE:
                cause = (
                    "which a sampled law, a bus or a filter can cause, but also a missing effect"
                )
            else:
                cause = (
                    "which a sampled law does not explain: check time stamps, and filters on one "
                    "of the signals"
                )
            found.append(
                f"the torque is estimated to act {1e3 * abs(value):.3g} ± {1e3 * std:.2g} ms {way} "
                + ("than recorded" if before == 0 else f"than recorded, not {1e3 * before:.3g} ms")
                + f", {cause}"
            )
    return found


def _instead(fit: Fit, given: ClosedLoop, offsets: Mapping[str, AbstractEffect]) -> list[str]:
    """Notes on offsets that may be friction that differs by direction."""
    found = [
        f"{name} was left out: friction that differs by direction is in its place, which has a "
        "lower score"
        for name in held_offsets(fit.loop)
        if name not in held_offsets(given)
    ]
    for name, effect in offsets.items():
        if name in fit.loop.names:
            row = fit.table().loc[name]
            found.append(
                f"{name}, {row['value']:.3g} ± {row['std']:.2g} {row['unit']}, may also be "
                f"{effect_on(*named(effect))}: except near reversals and at rest the two are the "
                "same, and these recordings do not distinguish them"
            )
    return found


# Range of delays, in samples, of a law that is computed at the rate of the recording and held, and
# the smallest one of a faster law.
_HELD, _FASTER = (0.25, 0.8), 0.05
# Largest difference from half a sample, in samples, of a delay that holding alone causes.
_ABOUT = 0.1


def looks_sampled(fit: Fit) -> list[str]:
    """Notes on drives whose delay is that of a sampled law, if the law is declared continuous."""
    if fit.loop.controller.period is not None:
        return []
    period, found = fit.recordings.common_period(), []
    for effect in fit.loop.effects:
        value = float(effect.late) if isinstance(effect, (ActuatorLag, TimeDelay)) else 0.0
        joint = getattr(effect, "joint", "")
        if _HELD[0] * period < value < _HELD[1] * period:
            found.append(
                f"joint {joint} has a delay of {1e3 * value:.3g} ms, about "
                "half a sample, like a law that is sampled with the recordings and held: declare "
                f"it by jaxid.control.Sampled(law, every={period:.4g}), or, if the law is unknown, "
                f"by jaxid.control.Tracking(delay={period / 2:.4g})"
            )
        elif _FASTER * period < value < _HELD[0] * period and not fit.loop.controller.imposes:
            found.append(
                f"joint {joint} has a delay of {1e3 * value:.3g} ms, like a law that is sampled "
                f"every {2e3 * value:.2g} ms and held: if it is sampled, declare it by "
                "jaxid.control.Sampled(law, every=...)"
            )
    return found
