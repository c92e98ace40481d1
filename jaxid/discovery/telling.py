"""The result of a search: the tests of its final model, the verdict and the notes."""

import dataclasses
import time
from collections.abc import Sequence

from ..effects import AbstractEffect
from ..estimate import Fit, Status
from ..recording import Recordings
from .changes import changed_values
from .coloured_noise import floor_with_coloured_noise
from .dependence import depends_on_motion
from .diagnosis import over_recordings
from .episodes import in_one_episode
from .held_out import diverges, on_held_out, raised, tested, with_held_out
from .hypotheses import effect_on
from .landscape import form
from .models import Model, Named, named, probability, worth_keeping
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

STOPPED = "the search was interrupted; resume=... continues it from its saved steps"
# Smallest share of a joint's squared residual with which a change is the reason of a verdict that
# has another one.
_MOST = 0.5


def told(
    search: Search, verdict: Outcome, unfinished: bool, started: float, interrupted: bool = False
) -> Discovery:
    """The result of a search, with errors on held-out recordings."""
    models = search.visited.weighed(search.at)
    steps = tested(search, _steps(search, models))
    # If a curve explains the residual, it is no noise.
    if not interrupted and verdict != "outside_catalogue":
        steps = [*steps[:-1], _with_coloured_noise(search, steps[-1])]
    models = with_held_out(search, models, steps)
    short = _stopped_short(search.asked.most)
    reason = STOPPED if interrupted else diverges(search, steps[-1]) or raised(search, steps)
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
    if not interrupted:
        unlike = _in_one_episode(search, steps[-1]) or _changed(search, steps, verdict, reason)
        steps = _without_probabilities(steps) if unlike else steps
        reason = unlike or reason
    notes = (short,) if unfinished and reason != short else ()
    return Discovery(
        verdict="undetermined" if reason else verdict,
        reason=reason,
        steps=tuple(steps),
        considered=worth_keeping(models),
        removed=search.removed,
        notes=(*notes, *_notes(search, steps)),
        seconds=time.perf_counter() - started,
        unfinished=unfinished,
        interrupted=interrupted,
    )


def _notes(search: Search, steps: Sequence[Step]) -> list[str]:
    """What a user should know beside the verdict."""
    return [
        *_without_recordings(search.asked.recordings, steps[0].fit),
        *remarks(steps, search.given, search.offsets),
        *search.failures,
        *_not_examined(search),
    ]


def _sound(step: Step) -> bool:
    """Whether a step has a fit whose residual can be analysed."""
    converged = step.fit.status is Status.converged and not step.fit.mistake
    return converged and step.diagnosis is not None


def _in_one_episode(search: Search, last: Step) -> str:
    """The reason if what the final model leaves is large in one episode; empty if it is not."""
    if not _sound(last):
        return ""
    assert last.diagnosis is not None
    return in_one_episode(last.diagnosis, search.asked.worth)


def _changed(search: Search, steps: Sequence[Step], verdict: Outcome, reason: str) -> str:
    """The reason if a value is not the same throughout the recordings; empty if there is another.

    Added effects may approximate a change, so the starting model with a change is compared with the
    final model as well. A missing effect may look like a small change, so then only a note tells of
    it.

    **Arguments:**

    - `reason`: the other reason; empty if there is none.
    """
    last, worth = steps[-1], search.asked.worth
    error = over_recordings(last.fit.error_percent.to_numpy())
    found = [("", 0.0)]
    for step in (last, steps[0])[: len(steps)]:
        if _sound(step):
            assert step.diagnosis is not None
            found.append(changed_values(step.diagnosis, worth, error))
    said, share = max(found, key=lambda x: x[1])
    is_the_reason = share > _MOST if reason else verdict != "outside_catalogue"
    if is_the_reason:
        return said
    if said:
        search.note(said)
    return ""


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
