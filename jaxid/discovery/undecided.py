"""Tests of the weights of the examined models: whether they decide for the chosen one."""

from collections import Counter
from collections.abc import Mapping, Sequence

from .hypotheses import effect_on
from .likelihood import weights
from .models import LIKELY, Model, Named, probability
from .offsets import held_offsets
from .verdict import risen

# Smallest probability of the starting model for the verdict `adequate`.
_HALF = 0.5
# A smaller difference of scores is not worth more than a bare mention (Kass and Raftery 1995).
_BARE = 2.0


def undecided(
    models: Sequence[Model],
    chosen: Model,
    alike: Mapping[Named, Sequence[Named]],
    worth: float,
) -> str:
    """The reason if scores do not decide for the chosen model; empty if they do.

    A model with a further effect that raises the held-out error is no reason.

    **Arguments:**

    - `alike`: for each effect of the chosen model, the effects that these recordings cannot
      distinguish from it.
    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    start = next(m for m in models if not m.effects and m.curve is None)
    if not chosen.effects:
        share = probability_of_start(models)
        if share >= _HALF:
            return ""
        rival = next(m for m in models if m is not start and not _the_same(m, start))
        return (
            f"the starting model has a probability of only {share:.2g}, and "
            f"{rival.label} has {rival.weight:.2g}: record more, or longer"
        )
    if chosen.score < start.score - LIKELY:
        return _improbable(models, chosen, alike) or _incomplete(models, chosen, worth)
    return (
        f"the score of the starting model is only {start.score - chosen.score:.2g} larger "
        f"({LIKELY:.0f} are odds of 20 to 1): record more, or longer"
    )


def probability_of_start(models: Sequence[Model]) -> float:
    """Weight of the starting model, with that of the models that do not contradict it."""
    start = next(m for m in models if not m.effects and m.curve is None)
    return sum(m.weight for m in models if m is start or _the_same(m, start))


def _the_same(m: Model, chosen: Model) -> bool:
    """Whether a model only has friction by direction in place of offsets, and is hardly better.

    Except near reversals and at rest the two are one torque, and a note says so.
    """
    if m.fit is None or chosen.fit is None or m.score < chosen.score - _BARE:
        return False
    further = Counter(m.key) - Counter(chosen.key)
    kept = Counter(chosen.key) - Counter(m.key) == Counter()
    exchanged = set(held_offsets(m.fit.loop)) - set(held_offsets(chosen.fit.loop))
    return kept and 0 < further.total() == len(exchanged)


def _improbable(
    models: Sequence[Model], chosen: Model, alike: Mapping[Named, Sequence[Named]]
) -> str:
    """The reason if an effect of the chosen model is improbable; empty if none is."""
    for name in chosen.names:
        group = {name, *alike.get(name, ())}
        share = probability(models, *group)
        if share < _HALF:
            plain = [m for m in models if m.curve is None]
            rival = next(m for m in plain if not group.intersection(m.names))
            return (
                f"models without {effect_on(*name)} have a probability of {1 - share:.3g}, most of "
                f"all {rival.label}: record other motions, or choose a model from the table"
            )
    return ""


def _incomplete(models: Sequence[Model], chosen: Model, worth: float) -> str:
    """The reason if a further effect is probable, although not by odds of 20 to 1."""
    mine = Counter(chosen.key)

    def is_possible(m: Model) -> bool:
        if m.fit is None or m.curve is not None or not mine < Counter(m.key):
            return False
        if _the_same(m, chosen):
            return False
        if chosen.held_out is None or m.held_out is None:
            return True
        return not risen(chosen.held_out, m.held_out, m.noise, worth)

    more = [m for m in models if is_possible(m)]
    best = min(more, key=lambda m: m.score, default=chosen)
    share = 1.0 - float(weights([m.score for m in (chosen, *more)])[0])
    if share < _HALF:
        return ""
    (further, *_) = (Counter(best.names) - Counter(chosen.names)).elements()
    return (
        f"models with a further effect have a probability of {share:.3g}, most of all "
        f"{effect_on(*further)}: record more, or longer"
    )
