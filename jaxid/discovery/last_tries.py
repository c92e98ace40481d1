"""Models that a search tries in full when no addition and no removal is better."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

from ..effects import AbstractEffect, AsymmetricFriction, Backlash
from ..errors import FitError, ModelError
from ..estimate import Fit
from ..noise import ARFilter
from ..simulation.dynamics import imposed
from .examined import Examined
from .explore import DECISIVE, key_of
from .landscape import form
from .likelihood import price_of_value
from .loose import undetermined
from .models import LIKELY, Model, listed
from .offsets import instead_of_offsets
from .relevance import loses
from .shapes import has_held_shape, shapes_of
from .signs import reshaped
from .transmissions import similar_ones, suspected
from .watched import ROUND

# Largest number of predicted models of a kind that are fitted because they may replace the chosen
# one.
_RIVALS = 2
# Largest number of predicted models that are fitted because they make the chosen effects doubtful.
_DOUBTS = 4
# Relative error of predicted decreases of the score if a shape of a sign is estimated.
_INEXACT = 0.2


def replaced(search: Examined, at: Model) -> Model | None:
    """The best fit of a model with another effect in the place of one, if it is better.

    Predictions are inexact, so a predicted model that is not decisively worse may be better. If a
    shape of the joint's sign is estimated, they are less exact. An effect whose shape is held may
    be better with another shape. Along an imposed motion, where a fit takes seconds, it is fitted
    with the shape free. A rival whose fit is worse than that of a part of its effects is fitted
    again, from the values of the chosen model.
    """
    assert at.fit is not None
    loop, own, best = at.fit.loop, Counter(map(form, at.effects)), at
    along = imposed(loop)
    start = search.visited.fitted(())
    assert start is not None
    reach = max(DECISIVE, _INEXACT * (start.score - at.score))

    def is_rival(m: Model) -> bool:
        others = [e for e in m.effects if form(e) not in own]
        shaped = along and any(map(has_held_shape, others))
        known = m.fit is not None and not (shaped and shapes_of(m.fit.loop, len(m.effects)))
        if m.curve is not None or len(m.effects) != len(at.effects):
            return False
        one = (Counter(map(form, m.effects)) - own).total() == 1
        if known:
            return one and _at_another_minimum(search, m)
        inexact = shaped or any(reshaped(loop, e) for e in others)
        return one and bool(m.score < at.score + (reach if inexact else DECISIVE))

    rivals = search.visited.ranked(is_rival)
    for rival in rivals[:_RIVALS]:
        if rival.fit is None or _at_another_minimum(search, rival):
            again = partial(search.fits.exchanged, loop, at.effects, rival.effects, rival.noise)
            best = _better(search, best, rival.effects, again)
        fitted = search.visited.fitted(rival.effects)
        if along and fitted is not None and fitted is not best:
            best = _with_free_shapes(search, best, fitted)
    return None if best is at else best


def _at_another_minimum(search: Examined, model: Model) -> bool:
    """Whether a fit with a part of a fitted model's effects is decisively better than it.

    At the minimum, further parameters raise the score by no more than their price.
    """
    if model.fit is None:
        return False
    there, values = Counter(map(form, model.effects)), len(model.fit.names)
    price = price_of_value(model.fit)

    def is_better(part: Model) -> bool:
        if part.fit is None or part.curve is not None:
            return False
        own = Counter(map(form, part.effects))
        more = price * max(values - len(part.fit.names), 0)
        return own < there and bool(part.score + more + DECISIVE < model.score)

    return bool(search.visited.ranked(is_better))


def _with_free_shapes(search: Examined, best: Model, rival: Model) -> Model:
    """The better one of a model and of a fitted rival with the held shapes of its effects free."""
    assert rival.fit is not None
    loop = rival.fit.loop
    held = shapes_of(loop, len(rival.effects))
    if not held:
        return best
    start = loop.free(*[p.name for p in held])
    again = partial(search.fits.with_shapes, rival.effects, start, rival.noise)
    return _better(search, best, rival.effects, again)


def replaced_by_shape(search: Examined, at: Model) -> Model | None:
    """The best fit without one effect and with held shapes on its joint free; None if the effect is
    needed beside them.

    An effect may only correct the shape of another one on the joint. Along an imposed motion, where
    a fit takes seconds, the model with that shape free is fitted. As in a removal, it is preferred
    unless its score is higher by odds of 20 to 1.
    """
    assert at.fit is not None
    if not imposed(at.fit.loop):
        return None
    best = None
    for gone in at.effects:
        rest = tuple(e for e in at.effects if e is not gone)
        joint = getattr(gone, "joint", None)
        if any(has_held_shape(e) and getattr(e, "joint", None) == joint for e in rest):
            less = search.had(at, rest) or search.refitted(at, rest)
            # Its own filters describe a part of the missing effect as noise.
            less = dataclasses.replace(less, noise=at.noise)
            again = _with_free_shapes(search, less, less)
            limit = at.score + LIKELY if best is None else best.score
            if again is not less and again.score < limit:
                best, needless = again, gone
    if best is not None:
        said = "not needed if the shapes of the other effects on its joint are estimated"
        search.note(f"{listed((needless,))}: {said}")
    return best


def doubtful(search: Examined, at: Model) -> Model | None:
    """The best fit of a model without some chosen effect, if it is better.

    Such a model makes the effect improbable by its weight. If it was only predicted, from a model
    with fewer effects, its score is inexact, so it is fitted. It has no weight if it cannot be
    fitted, or if the recordings determine no value of one of its effects.
    """
    assert at.fit is not None
    best, own, most = at, set(at.names), search.asked.most

    def contradicts(m: Model) -> bool:
        alone = m.fit is None and m.curve is None and len(m.effects) <= most
        return alone and bool(own - set(m.names)) and bool(m.score < best.score + LIKELY)

    for _ in range(_DOUBTS):
        rival = next(iter(search.visited.ranked(contradicts)), None)
        if rival is None:
            break
        again = partial(search.fits.exchanged, at.fit.loop, at.effects, rival.effects, rival.noise)
        found = _better(search, best, rival.effects, again)
        fitted = search.visited.fitted(rival.effects)
        fit = None if fitted is None else fitted.fit
        if fit is None or undetermined(fit, len(rival.effects)):
            search.visited.drop(rival.key)
        else:
            best = found
    return None if best is at else best


def with_transmission(search: Examined, at: Model) -> Model | None:
    """The best fit with a transmission or limit that predictions underrate, if it is better."""
    assert at.fit is not None
    full, best = len(at.effects) >= search.asked.most, at
    if full or imposed(at.fit.loop) or at.key not in search.diagnoses:
        return None
    diagnosis = search.diagnoses[at.key]
    for effect in suspected(diagnosis):
        tried = search.visited.fitted((*at.effects, effect)) is not None
        if not tried and _explains_some(search, at, effect):
            best = _better(search, best, (effect,), _added(search, at, effect, at.noise))
    left, screened = diagnosis.depends_on(), [v.hypothesis.effect for v in diagnosis.forms]
    for effect, similar in similar_ones(at.effects, search.asked, screened):
        # An elasticity is simpler than a gap; it may be better if nothing is left.
        if not left and not isinstance(effect, Backlash):
            continue
        rest = tuple(e for e in at.effects if e is not effect)
        if search.visited.fitted((*rest, similar)) is None:
            less = search.had(at, rest) or search.refitted(at, rest)
            best = _better(search, best, (similar,), _added(search, less, similar, at.noise))
    return best if best.score < at.score - LIKELY else None


def without_offset(search: Examined, at: Model) -> Model | None:
    """The best fit with friction by direction in place of an offset, if it is better."""
    fit, predictor = search.seen
    offered = AsymmetricFriction in search.asked.catalogue
    if len(at.effects) >= search.asked.most or not offered or fit is not at.fit:
        return None
    best = at
    for found in instead_of_offsets(predictor, fit.std)[:_RIVALS]:
        if found.loss > DECISIVE:
            continue
        search.offsets[found.name] = found.effect
        # The predicted loop has copies of the fitted effects.
        effects = found.loop.effects[-len(at.effects) - 1 :]
        if not (search.visited.fitted(effects) or search.small.intersection(key_of(effects))):
            again = partial(search.fits.exchanged, found.loop, effects, effects, found.noise)
            best = _better(search, best, (found.effect,), again)
    if not best.score < at.score - LIKELY:
        return None
    # Filters that were estimated elsewhere cost a model more than such a friction can gain, so the
    # model is fitted with those of the rival as well.
    again = partial(search.fits.exchanged, fit.loop, at.effects, at.effects, best.noise)
    same = _better(search, at, at.effects, again)
    return best if best.score < same.score - LIKELY else same


def _explains_some(search: Examined, at: Model, effect: AbstractEffect) -> bool:
    """Whether an effect changes a joint's error by a relevant amount in a first fit, without
    filters.

    The other fits of a transmission, from further starts and with free shapes, take a minute. Most
    suspected transmissions are significant because of some other small error of the model.
    """
    assert at.fit is not None
    search.watched.begin("fit", f"first fit with {listed((effect,))}", ROUND)
    try:
        fit = search.fits.first_with(at.fit, at.effects, effect, at.noise)
    except (ModelError, FitError) as error:
        search.note(f"no fit with {listed((effect,))}: {error}")
        return False
    tried = search.judged(search.added(fit), fit)
    return fit.status.simulated and loses(at, tried, search.asked.worth)


def _added(
    search: Examined, at: Model, effect: AbstractEffect, noise: Sequence[ARFilter]
) -> Callable[[], Fit]:
    """The function that fits a model with an additional effect of which predictions are wrong."""
    assert at.fit is not None
    return partial(search.fits.with_effects, at.fit, at.effects, (effect,), noise, 0.0)


def _better(
    search: Examined, best: Model, effects: Sequence[AbstractEffect], fitted: Callable[[], Fit]
) -> Model:
    """The better one of a model and of a fit; a note tells if the fit fails or is of no use.

    **Arguments:**

    - `effects`: the effects that the fit tries.
    """
    search.watched.begin("fit", f"fit with {listed(effects)} instead", ROUND)
    try:
        fit = fitted()
    except (ModelError, FitError) as error:
        search.note(f"no fit with {listed(effects)}: {error}")
        return best
    if not fit.status.simulated or search.not_genuine(fit):
        return best
    return min(best, search.visit(search.added(fit), fit), key=lambda m: m.score)


# In the order in which they are tried.
ATTEMPTS = replaced, replaced_by_shape, with_transmission, without_offset, doubtful
