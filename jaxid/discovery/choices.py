"""Which entries of a ranking are worth a refit, and which of them stand for each other."""

from collections import Counter
from collections.abc import Callable, Sequence

from ..effects import AbstractEffect, AbstractTransmission
from ..simulation.loop import ClosedLoop
from .diagnosis import Diagnosis, Verdict
from .story import Contender, Step


def addable(steps: Sequence[Step], matters: Callable[[Verdict], bool]) -> list[Verdict]:
    """Entries of the last ranking that matter and can be added."""
    twice = added_twice(steps)
    return [
        v
        for v in steps[-1].diagnosis.ranking
        if matters(v) and v.possible and v.evidence > 0 and v.key not in twice
    ]


def added_twice(steps: Sequence[Step]) -> set[tuple[str, int | None]]:
    """What is not added again: two ends of a travel, two harmonics of a ripple are enough.

    Three of a kind on one joint are a series that comes close to something else.
    """
    added = Counter(
        (s.added.effect_name(), getattr(s.added, "joint", None))
        for s in steps
        if s.added is not None
    )
    return {key for key, count in added.items() if count > 1}


def leading_few(entries: Sequence[Verdict]) -> list[Verdict]:
    """The entries whose evidence is close to the best's, three at the most.

    Signatures are exact to first order only: five per cent of the best is within what the
    nonlinear models may still turn round.
    """
    if not entries:
        return []
    best = entries[0].evidence
    close = [v for v in entries if v.evidence > best - max(30.0, 0.05 * best)]
    return close[:3]


def with_forms(leading: Sequence[Verdict], forms: Sequence[Verdict]) -> list[Verdict]:
    """The leading entries, each with its other forms that are not far behind.

    A form with fewer parameters may lose on a coarse grid of shapes and win once refitted.
    """
    chosen = list(leading)
    for verdict in leading:
        chosen += [
            form
            for form in forms
            if form.key == verdict.key
            and type(form.hypothesis.effect) is not type(verdict.hypothesis.effect)
            and form.possible
            and form.evidence > 0.5 * verdict.evidence
        ]
    return chosen


def transmissions(diagnosis: Diagnosis) -> list[Verdict]:
    """Elasticity and backlash on the joint on which a free-form curve explains most."""
    joint = diagnosis.where[0].hypothesis.joint
    return [] if joint is None else transmissions_on(diagnosis, joint)


def transmissions_on(diagnosis: Diagnosis, joint: int) -> list[Verdict]:
    return [
        v
        for v in diagnosis.ranking
        if isinstance(v.hypothesis.effect, AbstractTransmission) and v.hypothesis.joint == joint
    ]


def rivals_of(step: Step, most: int = 2) -> list[Contender]:
    """Other effects that were refitted in a step, and have no more to adjust than the chosen."""
    chosen = step.contenders[:1]
    return [
        c
        for c in step.contenders[1:]
        if (c.name, c.joint) != (chosen[0].name, chosen[0].joint)
        and len(c.fit.names) <= len(step.fit.names)
    ][:most]


def doubled(loop: ClosedLoop, from_end: int, effect: AbstractEffect) -> bool:
    """Whether an effect, in place of another, would be a joint's second transmission."""
    at = len(loop.effects) - from_end
    rest = (*loop.effects[:at], *loop.effects[at + 1 :])
    return isinstance(effect, AbstractTransmission) and any(
        isinstance(e, AbstractTransmission) and e.joint == effect.joint for e in rest
    )


def curve_is_better(diagnosis: Diagnosis, gained: float) -> bool:
    """Whether a free-form curve explains clearly more than the refitted effect has gained.

    A curve spends a dozen coefficients on what an effect of the catalogue, if it is the true one,
    says with one to four; evidence has that price in it.
    """
    if not diagnosis.where:
        return False
    curve = diagnosis.where[0].evidence
    return curve - gained > max(30.0, 0.1 * curve)


def looking_alike(
    diagnosis: Diagnosis, best: Contender, contenders: Sequence[Contender]
) -> tuple[tuple[str, int | None], ...]:
    """What cannot be told from the chosen effect: refitted rivals, then signatures."""
    chosen = next(v for v in diagnosis.ranking if v.key == (best.name, best.joint))
    refitted = {(c.name, c.joint): c.criterion for c in contenders}
    near = [
        key
        for key, value in refitted.items()
        if value < best.criterion + 10.0 and key != chosen.key
    ]
    near += [v.key for v in diagnosis.alike(chosen) if v.key not in refitted]
    return tuple(near)
