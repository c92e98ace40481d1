"""`discover`: the search, the tests of the final model, and the result."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ..display.progress import live_figure, working
from ..effects import AbstractEffect
from ..effects import catalogue as known
from ..errors import FitError
from ..estimate import OEM, Fit, Status
from ..estimate.standstill import slow_note, worst_at_standstill
from ..recording import Recording, Recordings
from ..simulation.batch import prepare
from ..simulation.checks import check_loop
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from ..simulation.sharing import with_one_blas_thread
from ..storage.campaign import Campaign
from ..storage.classes import classes_of
from .alongside import (
    along_recorded,
    approximating,
    in_the_loop,
    one_late_drive,
    without_law,
)
from .asked import Asked, check_apart
from .coloured_noise import floor_with_coloured_noise
from .dependence import depends_on_motion
from .diagnosis import over_recordings
from .held_out import diverges, on_held_out, raised, tested, with_held_out
from .hypotheses import effect_on
from .landscape import form
from .models import Model, Named, listed, named, probability, worth_keeping
from .parts import without_parts
from .remarks import remarks
from .screening import not_examined
from .search import Search
from .shapes import with_shapes
from .step import Step
from .story import Discovery
from .text import joined
from .undecided import undecided
from .verdict import (
    Outcome,
    explains_little,
    indefinite,
    misfit_of,
    refuted,
    refuted_unseen,
)

_STOPPED = "the search was interrupted; resume=... continues it from its saved steps"


@with_one_blas_thread
def discover(
    loop: ClosedLoop,
    recordings: Recording | Recordings | Iterable[Recording],
    validate: Recording | Recordings | Iterable[Recording] | None = None,
    *,
    catalogue: Sequence[Any] = known,
    method: OEM | None = None,
    significance: float = 0.01,
    worth: float = 0.05,
    most: int = 6,
    resume: str | Path | None = None,
    progress: bool = True,
) -> Discovery:
    """Searches the catalogue for the set of effects with the lowest score.

    Sets of effects are predicted in the system that is linearised along the fitted runs. The best
    few are fitted in full. The system is then linearised again at the best fit, until no predicted
    set has a lower score.

    **Arguments:**

    - `loop`: the starting model. With more than three joints under a known law, with a sampled
      law, if its friction is so sharp that simulations are slow, or if the first fit refutes the
      law, sets of effects are compared along the recorded motion, and the loop is
      simulated at the end; a note says so.
    - `recordings`: recordings to fit. All recordings have one sample rate.
    - `validate`: held-out recordings. They do not enter the score; they test the final model. If
      None, the model is tested on the fitted recordings only.
    - `catalogue`: as for `diagnose`.
    - `method`: settings of the fits, an `OEM`; by default `OEM()`.
    - `significance`: corrected p-value below which a diagnosis reports a missing effect.
    - `worth`: smallest relevant change of a joint's torque, in % of its norm, and at least a tenth
      of the model's error, or a quarter if the law is unknown. An effect that changes the torque
      of every joint by less is not added.
    - `most`: largest number of effects to add.
    - `resume`: folder in which every fit is saved as it ends, and from which the same call
      continues; it is created if it does not exist.
    - `progress`: whether to show the set that is tried and the remaining time, and in a notebook
      also the error of each model.

    Ctrl-C ends the search. If the starting model has been fitted by then, the result is the best
    fitted model, with `interrupted` set and the verdict `undetermined`.

    **Raises:** `FitError`, `ModelError` or `RecordingError` if model and recordings do not match;
    `RecordingError` if the recordings have different sample rates, or if a held-out recording is
    also fitted; `SaveError` if the folder contains steps of another call.
    """
    started = time.perf_counter()
    check_loop(loop)
    judged = loop.controller.judged
    if method is not None and method.output not in (None, judged):
        raise FitError(
            f"a discovery on {loop.name} compares {judged}; OEM(output={method.output!r}) is not "
            "supported: leave out output"
        )
    recordings = Recordings.of(recordings)
    held_out = None if validate is None else Recordings.of(validate)
    Recordings.of([*recordings, *(held_out or ())]).common_period()
    check_apart(recordings, held_out or ())
    if held_out is not None:
        # A held-out recording that cannot be used is refused before the search.
        prepare(loop, held_out)
    asked = Asked(
        recordings, held_out, method or OEM(), tuple(catalogue), significance, worth, most
    )
    with (
        working(f"discovery on {loop.name}", progress) as say,
        Campaign(
            resume, {"loop": loop, "search": asked.plan()}, classes_of(loop) | asked.classes()
        ) as campaign,
    ):

        def begun(prefix: str = "") -> Search:
            return Search(asked, campaign, say, live_figure(progress), prefix=prefix)

        story = _with_and_without_law(begun, along_recorded(loop), started)
        simulated = imposed(loop) or not imposed(story.fit.loop)
        if simulated or story.interrupted or story.fit.mistake:
            return story
        say("simulation of the loop")
        models = [step.fit.loop for step in story.steps]
        note = in_the_loop(loop, models, held_out or recordings)
        seconds = time.perf_counter() - started
        return dataclasses.replace(story, notes=(*story.notes, note), seconds=seconds)


def _with_and_without_law(
    begun: Callable[..., Search], loop: ClosedLoop, started: float
) -> Discovery:
    """The result of a search, or of one without the law if effects of it approximate the law.

    With one joint a late drive and a sampled law are the same. The law is not the declared one if
    an effect beside the late drive is not needed along the recorded motion.

    **Arguments:**

    - `begun`: function from the prefix of saved steps to a search.
    - `loop`: the starting model. `started`: time of `time.perf_counter`.
    """
    story = _with_and_without_standstill(begun, loop, started)
    along = without_law(loop)
    if story.verdict != "explained" or along is loop or imposed(story.fit.loop):
        return story
    effects = [step.added for step in story.steps if step.added is not None]
    why = one_late_drive(loop, effects, story.fit.recordings.common_period())
    if not why:
        return story
    again = begun("without the law, ")
    again.watched.say("the same without the law")
    stopped = dataclasses.replace(story, verdict="undetermined", interrupted=True, reason=_STOPPED)
    try:
        other = _searched(again, along, started)
        sure = other.verdict in ("adequate", "explained") and not other.interrupted
        needless = approximating(story.steps, other.steps) if sure else ()
    except KeyboardInterrupt:
        return stopped
    if other.interrupted:
        return stopped
    if not needless:
        return story
    note = (
        f"{why} sets of effects are compared along the recorded motion, without the law, where "
        f"this is not needed: {listed(needless)}"
    )
    return dataclasses.replace(other, notes=(note, *other.notes))


def _with_and_without_standstill(
    begun: Callable[..., Search], loop: ClosedLoop, started: float
) -> Discovery:
    """The result of a search, repeated without standstill if the model describes that worst.

    **Arguments:** those of `_with_and_without_law`.
    """
    search = begun()
    story = _searched(search, loop, started)
    done = story.verdict != "undetermined" or story.interrupted
    if done or story.fit.mistake or search.refuted:
        return story
    slower = worst_at_standstill(story.fit)
    if slower is None:
        return story
    # Along the recorded motion, if the first search went on there.
    moving = dataclasses.replace(search.given, standstill=slower)
    again = begun("moving, ")
    again.watched.say("the same without standstill, which the model describes worst")
    if search.why:
        again.note(search.why)
    try:
        story = _searched(again, moving, started)
    except KeyboardInterrupt:
        return dataclasses.replace(story, interrupted=True, reason=_STOPPED)
    notes = (*story.notes, *slow_note(loop.standstill, moving))
    return dataclasses.replace(story, notes=notes)


def _searched(search: Search, loop: ClosedLoop, started: float) -> Discovery:
    """The result of a search; if it is interrupted, that of the best fitted model."""
    try:
        verdict, unfinished = search.run(loop)
        return _told(search, verdict, unfinished, started)
    except KeyboardInterrupt:
        if not search.stopped():
            raise
        return _told(search, "undetermined", False, started, interrupted=True)


def _told(
    search: Search, verdict: Outcome, unfinished: bool, started: float, interrupted: bool = False
) -> Discovery:
    """The result of a search, with errors on held-out recordings."""
    models = search.visited.weighed(search.at)
    steps = tested(search, _steps(search, models))
    if not interrupted:
        steps = [*steps[:-1], _with_coloured_noise(search, steps[-1])]
    models = with_held_out(search, models, steps)
    short = _stopped_short(search.asked.most)
    reason = _STOPPED if interrupted else diverges(search, steps[-1]) or raised(search, steps)
    if not reason:
        reason = _doubt(search, verdict, steps)
        if unfinished and steps[-1].fit.status is Status.converged:
            if reason:
                search.note(f"the model also fails a test: {reason}")
            reason = short
    reason = reason or search.refuted
    if (reason and not interrupted) or verdict == "outside_catalogue":
        steps = _without_probabilities(steps)
    elif not reason:
        alike = {named(s.added): s.alike for s in steps if s.added is not None}
        chosen = next((m for m in models if m.key == search.at.key), search.at)
        reason = undecided(models, chosen, alike, search.asked.worth)
    if not interrupted and not reason and search.at.effects:
        steps, reason = _final(search, steps)
        models = tuple(_as_shown(m, steps[-1]) if m.fit is search.at.fit else m for m in models)
        steps = _without_probabilities(steps) if reason else steps
    if not interrupted and not reason and verdict != "outside_catalogue":
        last, noise = steps[-1], search.at.noise
        assert last.diagnosis is not None
        reason = depends_on_motion(
            last.fit, last.diagnosis, noise, last.held_out, search.asked.worth
        )
        steps = _without_probabilities(steps) if reason else steps
    notes = (*remarks(steps, search.given, search.offsets), *search.failures)
    notes = (*notes, *_not_examined(search))
    notes = (*_without_recordings(search.asked.recordings, steps[0].fit), *notes)
    if unfinished and reason != short:
        notes = (short, *notes)
    return Discovery(
        verdict="undetermined" if reason else verdict,
        reason=reason,
        steps=tuple(steps),
        considered=worth_keeping(models),
        removed=search.removed,
        notes=notes,
        seconds=time.perf_counter() - started,
        unfinished=unfinished,
        interrupted=interrupted,
    )


def _with_coloured_noise(search: Search, last: Step) -> Step:
    """The last step, with the noise floor of joints whose residual is shown to be noise."""
    if last.diagnosis is None or last.fit.status is not Status.converged:
        return last
    noise, worth = search.at.noise, search.asked.worth
    floor = floor_with_coloured_noise(last.fit, last.diagnosis, noise, last.held_out, worth)
    diagnosis = dataclasses.replace(last.diagnosis, measured=floor)
    return dataclasses.replace(last, diagnosis=diagnosis)


def _without_probabilities(steps: Sequence[Step]) -> list[Step]:
    """The steps of an answer that is in doubt.

    Probabilities assume that one of the examined models is right.
    """
    return [s if s.added is None else dataclasses.replace(s, probability=None) for s in steps]


def _final(search: Search, steps: Sequence[Step]) -> tuple[list[Step], str]:
    """The steps, the last one without needless parts of added effects and with their shapes free,
    and a reason if held-out recordings refute that last fit.

    The other tests of the model are those with the shapes held: beside a free shape the size of an
    effect can be uncertain although the effect is not.
    """
    search.watched.begin("fit", "fits with the shapes of added effects free")
    last = steps[-1]
    try:
        needed = without_parts(search.fits, search.at)
        if needed is not search.at.fit:
            search.note(needed.notes[-1])
        fit = with_shapes(search.fits, dataclasses.replace(search.at, fit=needed))
    except KeyboardInterrupt:
        search.note("held shapes of the added effects were not estimated: interrupted")
        return list(steps), ""
    if fit is last.fit:
        return list(steps), ""
    unseen = on_held_out(search, fit)
    last, reason = dataclasses.replace(last, fit=fit, held_out=unseen), ""
    if steps[0].held_out is not None and unseen is not None:
        assert last.diagnosis is not None
        noise, measured = search.at.noise, last.diagnosis.measured
        reason = refuted_unseen(fit, noise, measured, steps[0].held_out, unseen, search.asked.worth)
    return [*steps[:-1], last], reason


def _as_shown(model: Model, last: Step) -> Model:
    """The final model of the table with the errors of its last fit; its score is unchanged."""
    left = over_recordings(last.fit.error_percent.to_numpy())
    return dataclasses.replace(model, fit=last.fit, left=left, held_out=last.held_out)


def _stopped_short(most: int) -> str:
    """The reason if a further effect would be added to the largest number of effects."""
    return (
        f"a further effect would lower the error, and the search stopped at the limit of {most} "
        f"effect{'s' * (most != 1)}: raise most; many effects together may approximate another law"
    )


def _doubt(search: Search, verdict: Outcome, steps: Sequence[Step]) -> str:
    """The reason if the final model fails a test; empty if it passes all of them."""
    first, last = steps[0], steps[-1]
    if first.fit.mistake:
        return f"{first.fit.mistake}; no effect was searched, so correct this first"
    if verdict == "outside_catalogue":
        # A curve can absorb the residual of a model that explains nothing, and so can effects.
        if last.fit.status is Status.misfit:
            return misfit_of(last.fit)
        assert last.diagnosis is not None
        measured = last.diagnosis.measured
        return explains_little(last.fit, search.at.noise, measured) if last is not first else ""
    both = None
    if first.held_out is not None and last.held_out is not None:
        both = first.held_out, last.held_out
    assert last.diagnosis is not None
    worth = search.asked.worth
    loose = indefinite(last.fit, len(search.at.effects))
    return loose or refuted(last.fit, search.at.noise, last.diagnosis, both, worth)


def _without_recordings(asked: Recordings, first: Fit) -> list[str]:
    """A note on recordings that the search left out, because the first fit diverged there."""
    kept = {r.name for r in first.recordings}
    gone = [r.name for r in asked if r.name not in kept]
    if not gone:
        return []
    return [
        f"all fits leave out {joined(gone)}, because the simulation of the starting model diverges "
        "there: start from other values, or check the recording"
    ]


def _not_examined(search: Search) -> list[str]:
    """A note on effects of the catalogue that were not compared with the residual."""
    diagnosis = next(iter(search.diagnoses.values()), None)
    if diagnosis is None:
        return []
    names = not_examined(diagnosis.fit.loop, diagnosis.scene, search.asked.catalogue)
    if not names:
        return []
    return [
        f"not examined: {joined(names)}, because the motion of this arm is not simulated; that "
        "needs a known continuous law and at most three joints"
    ]


def _steps(search: Search, weighed: Sequence[Model]) -> list[Step]:
    """The starting model, followed by one additional effect per step."""
    start = search.visited.fitted(())
    assert start is not None
    models = [start]
    for k in range(1, len(search.at.effects)):
        less = search.at.effects[:k]
        models.append(search.had(search.at, less) or search.refitted(search.at, less))
    if search.at.effects:
        models.append(search.at)
    steps = []
    for k, model in enumerate(models):
        assert model.fit is not None
        step = Step(
            label="start",
            fit=model.fit,
            held_out=on_held_out(search, model.fit),
            diagnosis=search.diagnoses.get(model.key),
        )
        if k:
            added = model.effects[-1]
            step = dataclasses.replace(
                step,
                label=f"+ {effect_on(*named(added))}",
                added=added,
                alike=_alike(search, model, added),
                probability=probability(weighed, named(added)),
            )
        steps.append(step)
    return steps


def _alike(search: Search, model: Model, added: AbstractEffect) -> tuple[Named, ...]:
    """Alternatives to an effect, in the model to which it was added or in the final model."""
    last = next(e for e in search.at.effects if form(e) == form(added))
    found = (*search.visited.alike(model, added), *search.visited.alike(search.at, last))
    return tuple(dict.fromkeys(n for n in found if n not in search.at.names))
