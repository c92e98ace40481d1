"""Added effects of which the recordings determine no value."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from ..effects import AbstractEffect
from ..estimate import Fit
from .examined import Examined
from .explore import key_of
from .models import Model, listed
from .relevance import matches_curve
from .verify import values_of, wald

# Smallest distance of a determined value from zero, in deviations: a 95 % interval excludes zero.
DETERMINED = 2.0


def undetermined(found: Fit, added: int) -> tuple[AbstractEffect, ...]:
    """The effects, of those that a refit has added, of which the recordings determine no value.

    A value is determined if it is at least two standard deviations from zero. Values that can
    replace each other, such as the coefficients of a Fourier series over a part of a turn, are
    determined together if their Wald statistic has the same probability. If neither is, the effect
    is absent, or other parameters of the model can take its place. The deviations contain the
    errors that noise of a recorded motion causes, which the score does not contain.

    **Arguments:**

    - `added`: number of added effects; these are the loop's last ones.
    """
    effects = found.loop.effects
    last = range(len(effects) - added, len(effects))
    values = {k: values_of(found.loop, k) for k in last}
    return tuple(effects[k] for k, own in values.items() if own and not _determined(found, own))


def _determined(fit: Fit, values: Sequence[tuple[int, bool]]) -> bool:
    """Whether a value of an effect is determined, or those in which torque is linear together."""
    from scipy.stats import chi2

    own = [place for place, _ in values]
    if (DETERMINED * fit.std[own] < np.abs(fit.theta)[own]).any():
        return True
    linear = [place for place, linear in values if linear and np.isfinite(fit.std[place])]
    if len(linear) < 2:
        return False
    chance = chi2.sf(DETERMINED**2, 1)
    return bool(chi2.sf(wald(fit, linear), len(linear)) < chance)


def with_fewer(
    search: Examined, at: Model, fit: Fit, loose: Sequence[AbstractEffect]
) -> Model | None:
    """The best model without one of the effects that a fit does not determine; None if none is.

    Two effects that can take each other's place determine no value of either.

    **Arguments:**

    - `at`: the model to which the fit adds effects. `loose`: those of which no value is determined.
    """
    added, found = search.added(fit), []
    for gone in loose:
        kept = tuple(e for e in added if e is not gone)
        if len(kept) == len(at.effects):
            continue
        less = search.had(at, kept) or search.refitted(search.judged(added, fit), kept)
        assert less.fit is not None
        if undetermined(less.fit, len(kept) - len(at.effects)) or search.not_genuine(less.fit):
            continue
        found.append(less)
    return min(found, key=lambda m: m.score, default=None)


def without_loose(search: Examined, at: Model) -> Model | None:
    """The model without effects of which no value is determined, if a curve explains as much.

    Together such effects can approximate a curve, like a spring and two ripples of long periods a
    function of position. Otherwise None.
    """
    assert at.fit is not None
    loose = undetermined(at.fit, len(at.effects))
    kept = Counter(key_of([e for e in at.effects if not any(e is x for x in loose)]))
    rivals = search.visited.ranked(
        lambda m: m.curve is not None and not Counter(key_of(m.effects)) - kept
    )
    if not loose or not rivals:
        return None
    part, floor = search.part(at, rivals[0].effects), search.diagnoses[at.key].floor_percent()
    curve = rivals[0].curve
    assert curve is not None
    if not matches_curve(part.left, rivals[0].left, at.left, floor, curve.joint):
        return None
    said = f"{listed(loose)}: no value is determined; a curve of {curve.label} explains as much"
    search.note(said)
    return part
