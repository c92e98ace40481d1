"""After the last step: effects that the others have made superfluous, and series of them."""

from collections.abc import Callable, Sequence

import numpy as np

from ..estimate import Fit, fit
from .choices import doubled, rivals_of
from .refits import fitted_criterion
from .story import Contender, Step
from .turns import Search


def prune(
    search: Search, steps: list[Step], say: Callable[[str], None]
) -> tuple[list[Step], tuple[tuple[str, int | None], ...]]:
    """Takes out effects that the others have made superfluous, each tried by a refit.

    An early effect may also have won by what a later one explains (a spring that stood in for
    an offset and some of a wrong gain): its rivals, where they need no more parameters, are
    tried in its place.
    """
    removed: list[tuple[str, int | None]] = []
    # Noise is estimated anew each time, so that two rivals might take turns for ever.
    for _ in range(2 * len(steps)):
        final, kept = steps[-1], search.refits.criterion(steps[-1].fit, steps[-1].diagnosis)
        tried = changed(search, steps, say)
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
        again = search.step(
            stays.label, found, added=stays.added, alike=stays.alike, contenders=others_tried
        )
        between = [s for s in steps if s is not stays and s is not steps[place]]
        if rival is None:
            removed.append((gone.effect_name(), getattr(gone, "joint", None)))
        else:
            others = [c for c in steps[place].contenders if c is not rival]
            before = steps[place - 1]
            between.insert(place, search.grown(before, [rival, *others], say))
        steps = [*between, again]
    return steps, tuple(removed)


def changed(
    search: Search, steps: Sequence[Step], say: Callable[[str], None]
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
        rivals = () if steps[k] is final else rivals_of(steps[k])
        loop, place = final.fit.loop, len(added) - at
        fitting = (r for r in rivals if not doubled(loop, place, r.fit.loop.effects[-1]))
        for rival in (None, *fitting):
            refitted = search.refits.replaced(final, len(added) - at, rival, say)
            value = search.refits.criterion(refitted, final.diagnosis)
            found.append((value, k, rival, refitted))
    return found


def is_series(search: Search, steps: Sequence[Step], say: Callable[[str], None]) -> bool:
    """Whether one free-form curve does better than three effects or more in a row.

    Then they are a series that comes close to something else.
    """
    last = steps[-1]
    if sum(s.added is not None for s in steps) < 3:
        return False
    top = steps[0].diagnosis.where[0]
    say(f"refit with a curve on joint {top.hypothesis.joint} in place of all effects")
    grown = steps[0].fit.loop.add(steps[0].diagnosis.predicted(top))
    found = fit(grown, search.refits.recordings, search.refits.whitened_method(last.diagnosis))
    # On fitted recordings alone: a curve says nothing of what lies beyond them.
    kept = fitted_criterion(last.fit, last.diagnosis)
    return fitted_criterion(found, last.diagnosis) < kept
