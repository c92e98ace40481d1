"""`discover`: the search, the tests of the final model, and the result."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ..display.progress import live_figure, working
from ..effects import catalogue as known
from ..errors import FitError
from ..estimate import OEM
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
from .models import listed
from .search import Search
from .story import Discovery
from .telling import STOPPED, told


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
    stopped = dataclasses.replace(story, verdict="undetermined", interrupted=True, reason=STOPPED)
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
        return dataclasses.replace(story, interrupted=True, reason=STOPPED)
    notes = (*story.notes, *slow_note(loop.standstill, moving))
    return dataclasses.replace(story, notes=notes)


def _searched(search: Search, loop: ClosedLoop, started: float) -> Discovery:
    """The result of a search; if it is interrupted, that of the best fitted model."""
    try:
        verdict, unfinished = search.run(loop)
        return told(search, verdict, unfinished, started)
    except KeyboardInterrupt:
        if not search.stopped():
            raise
        return told(search, "undetermined", False, started, interrupted=True)
