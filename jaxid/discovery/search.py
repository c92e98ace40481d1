"""The loop of diagnose, add, refit, until nothing significant is left."""

import dataclasses
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..control import OpenLoop
from ..display.progress import working
from ..effects import catalogue as known
from ..errors import FitError
from ..estimate import OEM, Status
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..storage.campaign import Campaign
from ..storage.classes import classes_of
from .choices import addable
from .pruning import is_series, prune
from .refits import Refits
from .story import Discovery, Outcome, Step, step_name
from .turns import Search


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
    search = Search(
        refits=Refits(recordings=recordings, held_out=held_out, method=method or OEM()),
        catalogue=tuple(catalogue),
        significance=significance,
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
        refits = dataclasses.replace(search.refits, recordings=start.fit.recordings)
        search = dataclasses.replace(search, refits=refits)
        verdict, steps = follow([start], "turn")
        if verdict == "outside_catalogue" and len(steps) > 1:
            parted = campaign.piece("afresh", lambda: search.afresh(steps, say))
            if parted is not None:
                verdict, steps = follow([steps[0], parted], "afresh")
        unfinished = len(steps) > most and bool(addable(steps, search.matters(steps)))
        steps, removed = prune(search, steps, say)
        notes = _notes(steps)
        if unfinished:
            notes = (f"stopped after {most} effects, as told: raise most to go on", *notes)
        if is_series(search, steps, say):
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
    return Discovery(
        verdict=verdict,
        steps=tuple(steps),
        removed=removed,
        notes=notes,
        seconds=seconds,
        unfinished=unfinished,
    )


def _notes(steps: Sequence[Step]) -> tuple[str, ...]:
    bad = [s.label for s in steps if not s.fit.succeeded]
    if not bad:
        return ()
    return (f"the fit of {', '.join(bad)} did not converge: read its values with care",)


def _series_note(steps: Sequence[Step]) -> str:
    """What is said of effects that together did less than one curve."""
    names = ", ".join(step_name(s) for s in steps if s.added is not None)
    return f"{names} together come close, but one curve does better with less: they were taken out"


def _classes_in(catalogue: Sequence[Any]) -> set[type]:
    """The classes of effects that a catalogue names; what its functions make is not known yet."""
    given = {entry for entry in catalogue if isinstance(entry, type)}
    return given.union(*(classes_of(entry) for entry in catalogue))
