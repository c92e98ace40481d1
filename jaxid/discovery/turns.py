"""One turn of a discovery: a verdict, or the next step."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx

from ..effects import AbstractTransmission
from ..estimate import Fit, fit
from ..simulation.loop import ClosedLoop
from .choices import (
    addable,
    added_twice,
    curve_is_better,
    leading_few,
    looking_alike,
    transmissions,
    with_forms,
)
from .comparison import compare
from .diagnosis import Verdict
from .hypotheses import effect_on
from .refits import Refits, by_criterion, fitted_error, quiet
from .screening import diagnose
from .story import Contender, Outcome, Step


class Search(eqx.Module):
    """What stays the same over the turns of a discovery."""

    refits: Refits
    catalogue: tuple[Any, ...]
    significance: float

    def plan(self) -> dict[str, Any]:
        """What the steps follow from, beside the starting model."""
        return {
            "recordings": self.refits.recordings,
            "validate": self.refits.held_out,
            "catalogue": [_entry(entry) for entry in self.catalogue],
            "method": quiet(self.refits.method),
            "significance": self.significance,
        }

    def begin(self, loop: ClosedLoop, say: Callable[[str], None]) -> Step:
        """The starting model, fitted and diagnosed."""
        say("fit of the starting model")
        first = fit(loop, self.refits.recordings, quiet(self.refits.method))
        say("diagnosis of the starting model")
        step = self.step("start", first)
        # With the noise known, once more: where it is strongly coloured, plain output error leaves
        # the parameters so far off that what follows would have to explain that. A filter fitted to
        # the residual itself would take what is missing for noise, and the model further off.
        again = fit(first.loop, first.recordings, self.refits.whitened_method(step.diagnosis))
        again = dataclasses.replace(again, notes=(*first.notes, *again.notes))
        return self.step("start", again) if again.succeeded else step

    def step(self, label: str, found: Fit, **extra: Any) -> Step:
        """A step with its diagnosis and its error on held-out recordings."""
        diagnosis = diagnose(
            found, catalogue=self.catalogue, significance=self.significance, progress=False
        )
        held = None if self.refits.held_out is None else compare(found, self.refits.held_out)
        return Step(label=label, fit=found, held_out=held, diagnosis=diagnosis.light(), **extra)

    def turn(
        self, steps: list[Step], most: int, say: Callable[[str], None]
    ) -> tuple[Outcome | None, tuple[Step, ...]]:
        """One turn: a verdict, or the next steps."""
        last = steps[-1]
        done = "explained" if last.added is not None else "adequate"
        matters = self.matters(steps)
        outside = any(map(matters, last.diagnosis.where))
        entries = addable(steps, matters)
        if len(steps) > most or not (entries or outside):
            faint = self.faint(steps, say) if len(steps) <= most else ()
            return (None, faint) if faint else ("outside_catalogue" if outside else done, ())
        contenders = self.contenders(last, entries, say)
        if outside and not self.convinces(contenders, last):
            pair = [v for v in last.diagnosis.pair if v.key not in added_twice(steps)]
            contenders = self.second_thoughts(contenders, entries, pair, last, say)
        if self.convinces(contenders, last):
            grown = self.grown(last, contenders, say)
            # A transmission that leaves nothing is the right one: its siblings take long to refit.
            if any(map(self.matters([*steps, grown]), grown.diagnosis.where)):
                more = self.refits.with_siblings(contenders, last, say)
                grown = grown if more[0] is contenders[0] else self.grown(last, more, say)
            return None, (grown,)
        if outside and len(steps) < most and (further := self.detour(steps, contenders, say)):
            return None, further
        # A weak entry that no refit confirms is chance, unless a curve finds something as well.
        outside = outside and self.confirmed(last, say)
        return "outside_catalogue" if outside else done, ()

    def contenders(
        self, last: Step, entries: Sequence[Verdict], say: Callable[[str], None]
    ) -> list[Contender]:
        """The leading entries, and other forms of them, refitted."""
        return self.refits.refit(last, with_forms(leading_few(entries), last.diagnosis.forms), say)

    def grown(
        self, last: Step, contenders: Sequence[Contender], say: Callable[[str], None]
    ) -> Step:
        """The next step, with the best contender in the model."""
        best = self.refits.settled(contenders[0], say)
        say(f"diagnosis with {effect_on(best.name, best.joint)}")
        return self.step(
            f"+ {effect_on(best.name, best.joint)}",
            best.fit,
            added=best.fit.loop.effects[-1],
            alike=looking_alike(last.diagnosis, best, contenders),
            contenders=(best, *contenders[1:]),
        )

    def detour(
        self,
        before: Sequence[Step],
        contenders: Sequence[Contender],
        say: Callable[[str], None],
        longest: int = 2,
        share: float = 1e-3,
    ) -> tuple[Step, ...]:
        """Steps by which effects together leave nothing, where none alone matches the best curve.

        Screening sees each effect beside a model that lacks the other, and a curve may take a part
        of both; a second effect shows its true size only when the first is in. That they match the
        curve is not enough: ripples in a row come close to any dependence on position.
        """
        steps = list(before)
        while contenders and len(steps) < len(before) + longest:
            last = steps[-1]
            if contenders[0].criterion >= self.refits.criterion(last.fit, last.diagnosis):
                break
            steps.append(self.grown(last, contenders, say))
            matters = self.matters(steps, share)
            left = addable(steps, matters)
            if not left and not any(map(matters, steps[-1].diagnosis.where)):
                return tuple(steps[len(before) :])
            contenders = self.contenders(steps[-1], left, say)
        return ()

    def faint(
        self, steps: Sequence[Step], say: Callable[[str], None], share: float = 1e-4
    ) -> tuple[Step, ...]:
        """A step by an effect that is small beside those added, if it leaves nothing.

        What rounding leaves of a large effect is never quite another effect of the catalogue.
        """
        entries = addable(steps, self.matters(steps, share))
        contenders = self.contenders(steps[-1], entries, say)
        if not self.convinces(contenders, steps[-1]):
            return ()
        return self.detour(steps, contenders, say, 1, share)

    def afresh(self, steps: Sequence[Step], say: Callable[[str], None]) -> Step | None:
        """A first step by a transmission that alone does better than all the steps; None if none.

        A drive and a link that come apart look, at a small setting, like friction, or like a lag,
        and what was added for that hides them from every later screening.
        """
        first, last = steps[0], steps[-1]
        apart = [
            v
            for v in first.diagnosis.ranking
            if isinstance(v.hypothesis.effect, AbstractTransmission)
        ]
        contenders = self.refits.refit(first, apart, say)
        kept = self.refits.criterion(last.fit, last.diagnosis)
        better = [c for c in contenders if self.refits.criterion(c.fit, last.diagnosis) < kept]
        return self.grown(first, better, say) if better else None

    def matters(self, steps: Sequence[Step], share: float = 1e-3) -> Callable[[Verdict], bool]:
        """Whether something is significant, and more than what the steps so far leave of rounding.

        Steps of the encoders, of the integration, and what a smooth sign makes of a sharp one show
        as a thousandth of the effects themselves, which with large effects is no small matter.
        """
        if steps[-1].fit.error_percent.to_numpy().max() < 1e-3:
            # Recordings without noise: what is left is the integration's.
            return lambda v: False
        gone = fitted_error(steps[0].fit, steps[-1].diagnosis)
        gone -= fitted_error(steps[-1].fit, steps[-1].diagnosis)
        return lambda v: v.p_value < self.significance and v.explained > share * gone

    def convinces(self, contenders: Sequence[Contender], last: Step) -> bool:
        """Whether the best contender betters the model, and leaves no curve that does much better.

        Where two effects together explain more than any curve, one of them may do with less.
        """
        if not contenders:
            return False
        gained = self.refits.criterion(last.fit, last.diagnosis) - contenders[0].criterion
        if gained <= 0:
            return False
        pair = {v.key for v in last.diagnosis.pair}
        best = (contenders[0].name, contenders[0].joint)
        return best in pair or not curve_is_better(last.diagnosis, gained)

    def second_thoughts(
        self,
        contenders: Sequence[Contender],
        entries: Sequence[Verdict],
        pair: Sequence[Verdict],
        last: Step,
        say: Callable[[str], None],
    ) -> list[Contender]:
        """More contenders, before anything is called outside the catalogue.

        Entries further behind, since a shape between those of the grid may explain twice as much,
        and what led may have led by a signature that is not true of large effects; two effects
        that only together explain it; and elasticity and backlash, since a drive and a link that
        come apart are far from what a small setting shows of them.
        """
        tried = {(c.name, c.joint) for c in contenders}
        behind = [v for v in entries[:6] if v.key not in tried]
        behind = [v for v in behind if v.evidence > 0.5 * behind[0].evidence]
        more = (*behind, *pair, *transmissions(last.diagnosis))
        others = {v.key: v for v in more}
        found = self.refits.refit(last, [v for key, v in others.items() if key not in tried], say)
        return sorted([*contenders, *found], key=by_criterion)

    def confirmed(self, last: Step, say: Callable[[str], None]) -> bool:
        """Whether the curve that explains most is more than chance.

        Little evidence needs a second witness: recordings that the curve was not fitted to.
        """
        top = last.diagnosis.where[0]
        if top.evidence > 0:
            return True
        if self.refits.held_out is None:
            return top.p_value < 0.1 * self.significance
        say(f"refit with a curve on joint {top.hypothesis.joint}")
        grown = last.fit.loop.add(last.diagnosis.predicted(top))
        found = fit(grown, self.refits.recordings, self.refits.whitened_method(last.diagnosis))
        before = self.refits.unseen_error(last.fit, last.diagnosis)
        return self.refits.unseen_error(found, last.diagnosis) < before


def _entry(entry: Any) -> Any:
    """An entry of a catalogue as a plan names it: classes and functions by their names."""
    name = getattr(entry, "__qualname__", None)
    return entry if name is None else f"{entry.__module__}.{name}"
