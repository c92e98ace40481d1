"""Errors of the models of a search on recordings that it has not used."""

import dataclasses
import itertools
from collections.abc import Sequence

from ..errors import FitError
from ..estimate import Fit
from ..noise import ARFilter
from .comparison import Comparison, compare
from .models import Model
from .search import Search
from .step import Step
from .text import joined
from .verdict import on_unseen, risen

# Smallest weight of a model whose error on held-out recordings is computed.
_SHOWN = 0.01


def on_held_out(search: Search, fit: Fit) -> Comparison | None:
    """A fit on the held-out recordings; None if there are none, or if it diverges along them."""
    if search.asked.held_out is None:
        return None
    try:
        return compare(fit, search.asked.held_out)
    except FitError as error:
        search.note(str(error))
        return None


def with_held_out(
    search: Search, models: Sequence[Model], steps: Sequence[Step]
) -> tuple[Model, ...]:
    """Models with their error on held-out recordings, computed if their weight is large enough."""
    known = {id(s.fit): s.held_out for s in steps}
    found = []
    for m in models:
        if m.fit is not None and id(m.fit) in known:
            m = dataclasses.replace(m, held_out=known[id(m.fit)])
        elif m.fit is not None and m.weight > _SHOWN:
            m = dataclasses.replace(m, held_out=on_held_out(search, m.fit))
        found.append(m)
    return tuple(found)


def tested(search: Search, steps: Sequence[Step]) -> list[Step]:
    """The steps, each with what its effect does to the error on held-out recordings."""
    found = list(steps[:1])
    for before, step in itertools.pairwise(steps):
        if before.held_out is not None and step.held_out is not None:
            noise, worth = search.at.noise, search.asked.worth
            unseen = on_unseen(before.held_out, step.held_out, noise, worth)
            step = dataclasses.replace(step, unseen=unseen)
        found.append(step)
    return found


def one_raised(steps: Sequence[Step], noise: Sequence[ARFilter], worth: float) -> str:
    """A reason that names the first effect that raised the held-out error; empty if none did.

    **Arguments:**

    - `noise`: noise filters of the residual of the final model, one per output.
    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    for before, step in itertools.pairwise(steps):
        if step.unseen == "raises" and before.held_out is not None and step.held_out is not None:
            name = step.label.removeprefix("+ ")
            return risen(before.held_out, step.held_out, noise, worth, name)
    return ""


def raised(search: Search, steps: Sequence[Step]) -> str:
    """A reason that names the effects that raised the held-out error; empty if none did.

    One effect may raise it while all together lower it.
    """
    seen = [s.held_out for s in steps if s.held_out is not None]
    noise, worth = search.at.noise, search.asked.worth
    if len(seen) < 2:
        return ""
    reason = risen(seen[0], seen[-1], noise, worth)
    if not reason:
        return one_raised(steps, noise, worth)
    culprits = [s for s in steps if s.unseen in ("raises", "mixed")]
    # The names of all added effects would not add to the reason.
    some = 0 < len(culprits) < len(seen) - 1
    said = f"; it rose with {joined([s.label.removeprefix('+ ') for s in culprits])}"
    return reason + said * some


def diverges(search: Search, last: Step) -> str:
    """The reason if the final model cannot be simulated along the held-out recordings."""
    if search.asked.held_out is None or last.held_out is not None:
        return ""
    return (
        "the model diverges when it is simulated along a held-out recording, which a note names: "
        "check that recording, or fit recordings with motions like it as well"
    )
