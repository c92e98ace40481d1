"""The loop of diagnose, add, refit, until nothing significant is left."""

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..control import OpenLoop
from ..display.progress import working
from ..effects import AbstractEffect, AbstractTransmission, Coulomb
from ..effects import catalogue as known
from ..errors import FitError
from ..estimate import OEM, Fit, SeparablePEM, Status, fit
from ..noise import ARFilter, fit_ar
from ..parameters import Bounds, list_parameters, read_values, write_values
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..storage.archive import classes_of
from ..storage.campaign import Campaign
from .comparison import compare
from .diagnosis import Diagnosis, Verdict, diagnose
from .score import whitened
from .signatures import amplitudes
from .story import Contender, Discovery, Outcome, Step, effect_on, step_name


def discover(
    loop: ClosedLoop,
    recordings: Recording | Recordings | Iterable[Recording],
    validate: Recording | Recordings | Iterable[Recording] | None = None,
    *,
    catalogue: Sequence[Any] = known,
    method: OEM | None = None,
    significance: float = 0.01,
    most: int = 6,
    resume: str | Path | None = None,
    progress: bool = True,
) -> Discovery:
    """Finds what the model lacks: diagnose, add, refit, until nothing significant is left.

    Then each added effect is tried without.

    **Arguments:**

    - `loop`: the starting model.
    - `recordings`: to fit. `validate`: held out, to judge by.
    - `catalogue`: as for `diagnose`.
    - `method`: of the fits.
    - `significance`: corrected p-value below which something counts as missing.
    - `most`: how many effects to add at the most.
    - `resume`: a folder in which every step is saved as it ends, and from which the same call
      goes on; it is made where it is not there.

    **Raises:** `FitError`, `ModelError`, `RecordingError` where model and recordings do not fit;
    also where they were sampled at different rates; `SaveError` where the folder holds steps of
    another call.
    """
    started = time.perf_counter()
    judged = "position" if isinstance(loop.controller, OpenLoop) else "torque"
    if method is not None and method.output not in (None, judged):
        raise FitError(
            f"a discovery compares {judged}, by which {loop.name} is judged, and not "
            f"OEM(output={method.output!r}): leave out output"
        )
    recordings = Recordings.of(recordings)
    held_out = None if validate is None else Recordings.of(validate)
    Recordings.of([*recordings, *(held_out or ())]).common_period()
    search = _Search(
        recordings, held_out, tuple(catalogue), method or OEM(), significance, progress
    )
    plan = {"loop": loop, "search": search.plan(), "most": most}
    with (
        working(f"discovery on {loop.name}", progress) as say,
        Campaign(resume, plan, classes_of(loop) | _classes_in(search.catalogue)) as campaign,
    ):

        def follow(steps: list[Step], name: str) -> tuple[Outcome, list[Step]]:
            verdict: Outcome | None = None
            while verdict is None:
                verdict, more = campaign.piece(
                    f"{name} {len(steps)}", lambda: search.turn(steps, most, say)
                )
                steps.extend(more)
            return verdict, steps

        start = campaign.piece("start", lambda: search.begin(loop, say))
        # A recording along which the first fit runs away is left out of all that follows.
        search = dataclasses.replace(search, recordings=start.fit.recordings)
        verdict, steps = follow([start], "turn")
        if verdict == "outside_catalogue" and len(steps) > 1:
            parted = campaign.piece("afresh", lambda: search.afresh(steps, say))
            if parted is not None:
                verdict, steps = follow([steps[0], parted], "afresh")
        unfinished = len(steps) > most and bool(_entries(steps, search.matters(steps)))
        steps, removed = search.prune(steps, say)
        notes = _notes(steps)
        if unfinished:
            notes = (f"stopped after {most} effects, as told: raise most to go on", *notes)
        if search.is_series(steps, say):
            note, steps, removed = _series_note(steps), steps[:1], ()
            verdict, notes, unfinished = "outside_catalogue", (*_notes(steps), note), False
    # What is outside may well leave more of one joint's signal than there was, but not of all.
    explained = verdict == "outside_catalogue" and steps[-1].fit.error_percent.min(axis=None) < 99
    if steps[-1].fit.status is Status.misfit and not explained:
        raise FitError(
            f"neither {loop.name} nor the catalogue explains anything of these recordings: "
            f"{steps[-1].fit.notes[-1]}"
        )
    seconds = time.perf_counter() - started
    return Discovery(verdict, tuple(steps), removed, notes, seconds, unfinished)


def _notes(steps: Sequence[Step]) -> tuple[str, ...]:
    bad = [s.label for s in steps if not s.fit.succeeded]
    if not bad:
        return ()
    return (f"the fit of {', '.join(bad)} did not converge: read its values with care",)


def _fitted_criterion(found: Fit, diagnosis: Diagnosis) -> float:
    """Whitened squared error on fitted recordings, and BIC's price."""
    count = sum(r.size for r in found.residuals)
    return _fitted_error(found, diagnosis) + len(found.names) * float(np.log(count))


def _fitted_error(found: Fit, diagnosis: Diagnosis) -> float:
    """Whitened squared error on fitted recordings."""
    return _whitened_error(found.residuals, diagnosis.noise, diagnosis.data.level)


def _series_note(steps: Sequence[Step]) -> str:
    """What is said of effects that together did less than one curve."""
    names = ", ".join(step_name(s) for s in steps if s.added is not None)
    return f"{names} together come close, but one curve does better with less: they were taken out"


class _Search(eqx.Module):
    """What stays the same over the turns of a discovery."""

    recordings: Recordings
    held_out: Recordings | None
    catalogue: tuple[Any, ...]
    method: OEM
    significance: float
    progress: bool

    def plan(self) -> dict[str, Any]:
        """What the steps follow from, beside the starting model."""
        return {
            "recordings": self.recordings,
            "validate": self.held_out,
            "catalogue": [_entry(entry) for entry in self.catalogue],
            "method": _quiet(self.method),
            "significance": self.significance,
        }

    def begin(self, loop: ClosedLoop, say: Callable[[str], None]) -> Step:
        """The starting model, fitted and diagnosed."""
        say("fit of the starting model")
        first = fit(loop, self.recordings, _quiet(self.method))
        say("diagnosis of the starting model")
        step = self.step("start", first)
        # With the noise known, once more: where it is strongly coloured, plain output error leaves
        # the parameters so far off that what follows would have to explain that. A filter fitted to
        # the residual itself would take what is missing for noise, and the model further off.
        again = fit(first.loop, first.recordings, self.whitened_method(step.diagnosis))
        again = dataclasses.replace(again, notes=(*first.notes, *again.notes))
        return self.step("start", again) if again.succeeded else step

    def step(self, label: str, found: Fit, **extra: Any) -> Step:
        """A step with its diagnosis and its error on held-out recordings."""
        diagnosis = diagnose(
            found, catalogue=self.catalogue, significance=self.significance, progress=False
        )
        held = None if self.held_out is None else compare(found, self.held_out)
        return Step(label, found, held, diagnosis.light(), **extra)

    def turn(
        self, steps: list[Step], most: int, say: Callable[[str], None]
    ) -> tuple[Outcome | None, tuple[Step, ...]]:
        """One turn: a verdict, or the next steps."""
        last = steps[-1]
        done = "explained" if last.added is not None else "adequate"
        matters = self.matters(steps)
        outside = any(map(matters, last.diagnosis.where))
        entries = _entries(steps, matters)
        if len(steps) > most or not (entries or outside):
            faint = self.faint(steps, say) if len(steps) <= most else ()
            return (None, faint) if faint else ("outside_catalogue" if outside else done, ())
        contenders = self.contenders(last, entries, say)
        if outside and not self.convinces(contenders, last):
            pair = [v for v in last.diagnosis.pair if v.key not in _added_twice(steps)]
            contenders = self.second_thoughts(contenders, entries, pair, last, say)
        if self.convinces(contenders, last):
            grown = self.grown(last, contenders, say)
            # A transmission that leaves nothing is the right one: its siblings take long to refit.
            if any(map(self.matters([*steps, grown]), grown.diagnosis.where)):
                more = self.with_siblings(contenders, last, say)
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
        return self.refit(last, _with_forms(_leading(entries), last.diagnosis.forms), say)

    def grown(
        self, last: Step, contenders: Sequence[Contender], say: Callable[[str], None]
    ) -> Step:
        """The next step, with the best contender in the model."""
        best = self.settled(contenders[0], say)
        say(f"diagnosis with {effect_on(best.name, best.joint)}")
        return self.step(
            f"+ {effect_on(best.name, best.joint)}",
            best.fit,
            added=best.fit.loop.effects[-1],
            alike=_alike(last.diagnosis, best, contenders),
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
            if contenders[0].criterion >= self.criterion(last.fit, last.diagnosis):
                break
            steps.append(self.grown(last, contenders, say))
            matters = self.matters(steps, share)
            left = _entries(steps, matters)
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
        entries = _entries(steps, self.matters(steps, share))
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
        contenders = self.refit(first, apart, say)
        kept = self.criterion(last.fit, last.diagnosis)
        better = [c for c in contenders if self.criterion(c.fit, last.diagnosis) < kept]
        return self.grown(first, better, say) if better else None

    def matters(self, steps: Sequence[Step], share: float = 1e-3) -> Callable[[Verdict], bool]:
        """Whether something is significant, and more than what the steps so far leave of rounding.

        Steps of the encoders, of the integration, and what a smooth sign makes of a sharp one show
        as a thousandth of the effects themselves, which with large effects is no small matter.
        """
        if steps[-1].fit.error_percent.to_numpy().max() < 1e-3:
            # Recordings without noise: what is left is the integration's.
            return lambda v: False
        gone = _fitted_error(steps[0].fit, steps[-1].diagnosis)
        gone -= _fitted_error(steps[-1].fit, steps[-1].diagnosis)
        return lambda v: v.p_value < self.significance and v.explained > share * gone

    def convinces(self, contenders: Sequence[Contender], last: Step) -> bool:
        """Whether the best contender betters the model, and leaves no curve that does much better.

        Where two effects together explain more than any curve, one of them may do with less.
        """
        if not contenders:
            return False
        gained = self.criterion(last.fit, last.diagnosis) - contenders[0].criterion
        if gained <= 0:
            return False
        pair = {v.key for v in last.diagnosis.pair}
        best = (contenders[0].name, contenders[0].joint)
        return best in pair or not _curve_is_better(last.diagnosis, gained)

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
        more = (*behind, *pair, *_transmissions(last.diagnosis))
        others = {v.key: v for v in more}
        found = self.refit(last, [v for key, v in others.items() if key not in tried], say)
        return sorted([*contenders, *found], key=_criterion)

    def confirmed(self, last: Step, say: Callable[[str], None]) -> bool:
        """Whether the curve that explains most is more than chance.

        Little evidence needs a second witness: recordings that the curve was not fitted to.
        """
        top = last.diagnosis.where[0]
        if top.evidence > 0:
            return True
        if self.held_out is None:
            return top.p_value < 0.1 * self.significance
        say(f"refit with a curve on joint {top.hypothesis.joint}")
        grown = last.fit.loop.add(last.diagnosis.predicted(top))
        found = fit(grown, self.recordings, self.whitened_method(last.diagnosis))
        before = self.unseen_error(last.fit, last.diagnosis)
        return self.unseen_error(found, last.diagnosis) < before

    def refit(
        self, last: Step, leading: Sequence[Verdict], say: Callable[..., None]
    ) -> list[Contender]:
        """The leading entries as full nonlinear models, best first."""
        found = []
        for k, verdict in enumerate(leading):
            called = effect_on(*verdict.key)
            say(f"refit with {called}, {k + 1} of {len(leading)}", k / len(leading))
            method = self.whitened_method(last.diagnosis)
            fits = [fit(loop, self.recordings, method) for loop in self.starts(last, verdict)]
            if amplitudes(verdict.hypothesis.effect) and not _as_predicted(fits[0], last, verdict):
                away = fit(self.unfiltered(fits[0].loop, last), self.recordings, method)
                fits.append(away)
            values = [self.criterion(refitted, last.diagnosis) for refitted in fits]
            tried = [
                Contender(*verdict.key, refitted, value)
                for refitted, value in zip(fits, values, strict=True)
                if np.isfinite(value) and _is_there(refitted, last.fit)
            ]
            found += sorted(tried, key=_criterion)[:1]
        return sorted(found, key=_criterion)

    def unfiltered(self, loop: ClosedLoop, last: Step) -> ClosedLoop:
        """The loop fitted as if noise were white: filters that knew nothing of an effect bar it."""
        # Output error, by the program that filters need anyway.
        noise = last.diagnosis.noise
        white = tuple(ARFilter(np.zeros(0), f.variance * f.gain) for f in noise)
        method = dataclasses.replace(self.whitened_method(last.diagnosis), filters=white)
        return fit(loop, self.recordings, method).loop

    def with_siblings(
        self, contenders: Sequence[Contender], last: Step, say: Callable[[str], None]
    ) -> list[Contender]:
        """Contenders, and beside a transmission that leads the others that come close to it.

        To a small motion a gap of micrometres is a soft spring, and that is what screening finds:
        a refit that begins with a gap as wide as the spring's twist tells which of the two it is.
        """
        loop, found = contenders[0].fit.loop, list(contenders)
        leading = loop.effects[-1]
        if not isinstance(leading, AbstractTransmission):
            return found
        tau = np.concatenate([r.tau[:, leading.joint - 1] for r in self.recordings])
        for verdict in _transmissions_on(last.diagnosis, leading.joint):
            other = verdict.hypothesis.effect.after(leading, float(np.std(tau)))  # type: ignore[attr-defined]
            if other is None or any(verdict.key == (c.name, c.joint) for c in found):
                continue
            say(f"refit with {effect_on(*verdict.key)} in its place")
            instead = loop.with_effects((*loop.effects[:-1], other))
            instead = instead.free(*_held_shapes(instead))
            plain = self.given()
            rough = fit(instead, self.recordings, plain)
            close = fit(rough.loop, self.recordings, self.whitened_method(last.diagnosis))
            value = self.criterion(close, last.diagnosis)
            if np.isfinite(value):
                found.append(Contender(*verdict.key, close, value))
        return sorted(found, key=_criterion)

    def starts(self, last: Step, verdict: Verdict, wide: float = 10.0) -> list[ClosedLoop]:
        """Where refits with an effect begin: at its prediction; from several where that is far off.

        What was screened at a finite setting may start in another valley at its prediction, and
        noise filters that knew nothing of it may bar the way out, so one refit begins without. And
        where drive and link part and meet again nearly every valley is a wrong one while the
        contact's stiffness is held at a wrong value; with that free from the start, and from a gap
        that is too wide, where the link flies longest and all parameters show, few are.
        """

        def grown(effect: AbstractEffect) -> ClosedLoop:
            return _of_one_sign(last.fit.loop.add(_inside(effect)))

        effect, found = verdict.hypothesis.effect, [grown(last.diagnosis.predicted(verdict))]
        if amplitudes(effect):
            return found
        found.append(grown(effect))
        if not effect.contact:
            return [*found, self.unfiltered(found[0], last)]
        held = _held_shapes(found[0])
        plain = self.given()
        apart = [grown(effect.scaled(factor)).free(*held) for factor in (1.0, wide)]
        fits = [fit(loop, self.recordings, plain) for loop in apart]
        lost = (Status.misfit, Status.diverged)
        return found + [fitted.loop for fitted in fits if fitted.status not in lost]

    def settled(self, best: Contender, say: Callable[[str], None]) -> Contender:
        """The best contender with noise filters of its own, and its held shapes if they matter.

        The filters it was judged by knew its effect from a signature only, so some of it may have
        passed for noise. And what was screened at a finite setting has shapes that only a good fit
        can tell (how stiff a backlash's contact is): held at a wrong value they leave something to
        explain, and estimated from there they may end in a valley beside the right one.
        """
        loop = _of_one_sign(best.fit.loop)
        held = () if amplitudes(loop.effects[-1]) else _held_shapes(loop)
        released = _released(loop, [name for name in held if name not in loop.names])
        found = [best.fit]
        for start in (loop, *released):
            say(f"refit of {effect_on(best.name, best.joint)} with its own noise")
            found.append(fit(start, self.recordings, self.alternating()))
        chosen = min((f for f in found if f.succeeded), key=_bic, default=best.fit)
        return Contender(best.name, best.joint, chosen, best.criterion)

    def alternating(self) -> SeparablePEM:
        """The method with noise filters estimated along with the parameters."""
        method = self.given()
        return SeparablePEM(method, criterion="bic", highest=30, white=None, rounds=3)

    def given(self) -> OEM:
        """The output error to refit with, from where the loop is."""
        return dataclasses.replace(_quiet(self.method), start="given")

    def whitened_method(self, diagnosis: Diagnosis) -> SeparablePEM:
        """The method with the noise filters of a diagnosis: efficient where noise is coloured."""
        method = self.given()
        return SeparablePEM(method, filters=diagnosis.noise)

    def criterion(self, found: Fit, diagnosis: Diagnosis) -> float:
        """Whitened squared error on fitted and held-out recordings, and BIC's price.

        Less is better; a difference of ten is decisive. Infinite where the fit runs away. Noise is
        what the diagnosis takes for it.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            value = _fitted_criterion(found, diagnosis) + self.unseen_error(found, diagnosis)
        return value if np.isfinite(value) else np.inf

    def unseen_error(self, found: Fit, diagnosis: Diagnosis) -> float:
        """Whitened squared error on held-out recordings; infinite where the loop runs away."""
        if self.held_out is None:
            return 0.0
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                error = _whitened_error(compare(found, self.held_out).residuals, diagnosis.noise)
        except (ArithmeticError, ValueError, RuntimeError):
            return np.inf
        return error if np.isfinite(error) else np.inf

    def prune(
        self, steps: list[Step], say: Callable[[str], None]
    ) -> tuple[list[Step], tuple[tuple[str, int | None], ...]]:
        """Takes out effects that the others have made superfluous, each tried by a refit.

        An early effect may also have won by what a later one explains (a spring that stood in for
        an offset and some of a wrong gain): its rivals, where they need no more parameters, are
        tried in its place.
        """
        removed: list[tuple[str, int | None]] = []
        # Noise is estimated anew each time, so that two rivals might take turns for ever.
        for _ in range(2 * len(steps)):
            final, kept = steps[-1], self.criterion(steps[-1].fit, steps[-1].diagnosis)
            tried = self.changed(steps, say)
            better, place, rival, found = min(
                tried, key=lambda x: x[0], default=(np.inf, 0, None, final.fit)
            )
            if not better < kept:
                break
            gone = steps[place].added
            assert gone is not None
            # The step that is last once this one has gone.
            stays = steps[-2] if steps[place] is final else final
            others_tried = () if stays is final else stays.contenders
            again = self.step(
                stays.label, found, added=stays.added, alike=stays.alike, contenders=others_tried
            )
            between = [s for s in steps if s is not stays and s is not steps[place]]
            if rival is None:
                removed.append((gone.effect_name(), getattr(gone, "joint", None)))
            else:
                others = [c for c in steps[place].contenders if c is not rival]
                before = steps[place - 1]
                between.insert(place, self.grown(before, [rival, *others], say))
            steps = [*between, again]
        return steps, tuple(removed)

    def changed(
        self, steps: Sequence[Step], say: Callable[[str], None]
    ) -> list[tuple[float, int, Contender | None, Fit]]:
        """The last model without each effect, and with each earlier one's rivals in its place.

        Without the last as well: what it made up for may have come right as the others settled.

        **Returns:** criterion, number of the step, the rival if there is one, and the fit.
        """
        final, found = steps[-1], []
        added = [k for k, s in enumerate(steps) if s.added is not None]
        if len(added) < 2:
            return []
        for at, k in enumerate(added):
            rivals = () if steps[k] is final else _rivals(steps[k])
            loop, place = final.fit.loop, len(added) - at
            fitting = (r for r in rivals if not _doubled(loop, place, r.fit.loop.effects[-1]))
            for rival in (None, *fitting):
                refitted = self.replaced(final, len(added) - at, rival, say)
                value = self.criterion(refitted, final.diagnosis)
                found.append((value, k, rival, refitted))
        return found

    def is_series(self, steps: Sequence[Step], say: Callable[[str], None]) -> bool:
        """Whether one free-form curve does better than three effects or more in a row.

        Then they are a series that comes close to something else.
        """
        last = steps[-1]
        if sum(s.added is not None for s in steps) < 3:
            return False
        top = steps[0].diagnosis.where[0]
        say(f"refit with a curve on joint {top.hypothesis.joint} in place of all effects")
        grown = steps[0].fit.loop.add(steps[0].diagnosis.predicted(top))
        found = fit(grown, self.recordings, self.whitened_method(last.diagnosis))
        # On fitted recordings alone: a curve says nothing of what lies beyond them.
        kept = _fitted_criterion(last.fit, last.diagnosis)
        return _fitted_criterion(found, last.diagnosis) < kept

    def replaced(
        self, final: Step, from_end: int, rival: Contender | None, say: Callable[[str], None]
    ) -> Fit:
        """The last fit again, with a rival or nothing for the effect so far from the loop's end."""
        loop = final.fit.loop
        at = len(loop.effects) - from_end
        gone = loop.effects[at]
        instead = () if rival is None else rival.fit.loop.effects[-1:]
        with_what = "" if rival is None else f", with {effect_on(rival.name, rival.joint)}"
        say(
            f"again without {effect_on(gone.effect_name(), getattr(gone, 'joint', None))}"
            f"{with_what}"
        )
        less = loop.with_effects((*loop.effects[:at], *instead, *loop.effects[at + 1 :]))
        return fit(_of_one_sign(less), self.recordings, self.whitened_method(final.diagnosis))


def _entry(entry: Any) -> Any:
    """An entry of a catalogue as a plan names it: classes and functions by their names."""
    name = getattr(entry, "__qualname__", None)
    return entry if name is None else f"{entry.__module__}.{name}"


def _classes_in(catalogue: Sequence[Any]) -> set[type]:
    """The classes of effects that a catalogue names; what its functions make is not known yet."""
    given = {entry for entry in catalogue if isinstance(entry, type)}
    return given.union(*(classes_of(entry) for entry in catalogue))


def _quiet(method: OEM) -> OEM:
    return dataclasses.replace(method, progress=False)


def _criterion(contender: Contender) -> float:
    return contender.criterion


def _transmissions(diagnosis: Diagnosis) -> list[Verdict]:
    """Elasticity and backlash on the joint on which a free-form curve explains most."""
    joint = diagnosis.where[0].hypothesis.joint
    return [] if joint is None else _transmissions_on(diagnosis, joint)


def _transmissions_on(diagnosis: Diagnosis, joint: int) -> list[Verdict]:
    return [
        v
        for v in diagnosis.ranking
        if isinstance(v.hypothesis.effect, AbstractTransmission) and v.hypothesis.joint == joint
    ]


def _entries(steps: Sequence[Step], matters: Callable[[Verdict], bool]) -> list[Verdict]:
    """Entries of the last ranking that matter and can be added."""
    twice = _added_twice(steps)
    return [
        v
        for v in steps[-1].diagnosis.ranking
        if matters(v) and v.possible and v.evidence > 0 and v.key not in twice
    ]


def _added_twice(steps: Sequence[Step]) -> set[tuple[str, int | None]]:
    """What is not added again: two ends of a travel, two harmonics of a ripple are enough.

    Three of a kind on one joint are a series that comes close to something else.
    """
    added = Counter(
        (s.added.effect_name(), getattr(s.added, "joint", None))
        for s in steps
        if s.added is not None
    )
    return {key for key, count in added.items() if count > 1}


def _leading(entries: Sequence[Verdict]) -> list[Verdict]:
    """The entries whose evidence is close to the best's, three at the most.

    Signatures are exact to first order only: five per cent of the best is within what the
    nonlinear models may still turn round.
    """
    if not entries:
        return []
    best = entries[0].evidence
    close = [v for v in entries if v.evidence > best - max(30.0, 0.05 * best)]
    return close[:3]


def _with_forms(leading: Sequence[Verdict], forms: Sequence[Verdict]) -> list[Verdict]:
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


def _bic(found: Fit) -> float:
    """Likelihood of a fit with noise filters of its own, and the price of what it estimates."""
    joints = found.residuals[0].shape[1]
    count = sum(len(r) for r in found.residuals)
    filters = [
        fit_ar([r[:, j] for r in found.residuals], highest=30, criterion="bic")
        for j in range(joints)
    ]
    spread = sum(count * np.log(max(f.variance, 1e-300)) for f in filters)
    free = len(found.names) + sum(f.order for f in filters)
    return float(spread + free * np.log(count * joints))


def _rivals(step: Step, most: int = 2) -> list[Contender]:
    """Other effects that were refitted in a step, and have no more to adjust than the chosen."""
    chosen = step.contenders[:1]
    return [
        c
        for c in step.contenders[1:]
        if (c.name, c.joint) != (chosen[0].name, chosen[0].joint)
        and len(c.fit.names) <= len(step.fit.names)
    ][:most]


def _doubled(loop: ClosedLoop, from_end: int, effect: AbstractEffect) -> bool:
    """Whether an effect, in place of another, would be a joint's second transmission."""
    at = len(loop.effects) - from_end
    rest = (*loop.effects[:at], *loop.effects[at + 1 :])
    return isinstance(effect, AbstractTransmission) and any(
        isinstance(e, AbstractTransmission) and e.joint == effect.joint for e in rest
    )


def _held_shapes(loop: ClosedLoop) -> tuple[str, ...]:
    """Names of the last effect's parameters that no fit estimates unless told to."""
    last = ("effects", len(loop.effects) - 1)
    return tuple(
        p.name
        for p in loop.parameters
        if p.where.steps[:2] == last and not p.declaration.free  # type: ignore[attr-defined]
    )


def _released(loop: ClosedLoop, names: Sequence[str]) -> list[ClosedLoop]:
    """The loop with these values free: from where they are, and from half and twice each."""
    if not names:
        return []
    given = {p.name: np.asarray(p.where(loop)) for p in loop.parameters if p.name in names}
    changes = [{}, *({name: f * given[name]} for name in names for f in (0.5, 2.0))]
    return [loop.with_values(**change).free(*names) for change in changes]


def _as_predicted(refitted: Fit, last: Step, verdict: Verdict, factor: float = 2.0) -> bool:
    """Whether a refit gains about what the effect's signature had promised."""
    with np.errstate(over="ignore", invalid="ignore"):
        before, after = (_fitted_criterion(f, last.diagnosis) for f in (last.fit, refitted))
    return verdict.evidence / factor < before - after < verdict.evidence * factor


def _is_there(refitted: Fit, before: Fit) -> bool:
    """Whether anything of the effect that a refit has added shows in the recordings."""
    new = [k for k, name in enumerate(refitted.names) if name not in before.names]
    return not new or bool(np.isfinite(refitted.std[new]).any())


def _of_one_sign(loop: ClosedLoop) -> ClosedLoop:
    """The loop with one smoothed sign a joint, where that of its Coulomb friction is estimated.

    Effects are added with the sharpness it had then, which may come out another beside them.
    """
    estimated, held = {}, []
    for p in loop.parameters:
        place = p.where.steps  # type: ignore[attr-defined]
        if place[0] != "effects" or place[2:] != ("gamma",):
            continue
        effect = loop.effects[place[1]]
        if isinstance(effect, Coulomb) and p.name in loop.names:
            estimated[effect.joint] = float(effect.gamma)
        elif p.name not in loop.names:
            held.append((p.name, getattr(effect, "joint", None)))
    return loop.with_values(**{name: estimated[j] for name, j in held if j in estimated})


def _inside(effect: AbstractEffect) -> AbstractEffect:
    """The effect with parameters that are on their bounds or beyond moved just inside."""
    chosen = [p for p in list_parameters(effect) if p.declaration.free]
    if not chosen:
        return effect
    values = Bounds.of(chosen).moved_inside(read_values(effect, chosen))
    return write_values(effect, chosen, values)


def _curve_is_better(diagnosis: Diagnosis, gained: float) -> bool:
    """Whether a free-form curve explains clearly more than the refitted effect has gained.

    A curve spends a dozen coefficients on what an effect of the catalogue, if it is the true one,
    says with one to four; evidence has that price in it.
    """
    if not diagnosis.where:
        return False
    curve = diagnosis.where[0].evidence
    return curve - gained > max(30.0, 0.1 * curve)


def _alike(
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


def _whitened_error(
    residuals: Sequence[Float[np.ndarray, "_samples joints"]],
    noise: Sequence[ARFilter],
    level: Float[np.ndarray, "recordings joints"] | None = None,
) -> float:
    """Squared error in units of the noise's innovations, of each recording's own if known."""
    total = 0.0
    for k, r in enumerate(residuals):
        white = whitened(r[None], noise, np.ones((1, len(r)), bool))
        total += float(np.sum((white if level is None else white / level[k]) ** 2))
    return total
