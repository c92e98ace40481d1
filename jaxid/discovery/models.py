"""Models that a search has looked at, and what they are worth beside each other."""

from collections.abc import Callable, Iterable, Sequence

import equinox as eqx
import numpy as np

from ..effects import AbstractEffect, Curve
from ..estimate import Fit
from .explore import Candidate, key_of
from .landscape import form
from .likelihood import weights

Named = tuple[str, int | None]


class Model(eqx.Module):
    """A set of effects over the starting model, and its score.

    - `curve`: a free-form curve that it has beside them.
    - `fit`: its full refit; None where it was predicted only.
    """

    effects: tuple[AbstractEffect, ...]
    score: float
    curve: Curve | None = None
    fit: Fit | None = None

    @property
    def key(self) -> tuple:
        """Which effects are in it."""
        return key_of(self.effects, self.curve)

    @property
    def names(self) -> tuple[Named, ...]:
        """Name and joint of each effect."""
        return tuple(named(e) for e in self.effects)


def named(effect: AbstractEffect) -> Named:
    """An effect's name and joint."""
    return effect.effect_name(), getattr(effect, "joint", None)


class Visited:
    """All models that were looked at, each at its best score: a refit's, else a prediction's."""

    def __init__(self) -> None:
        self._models: dict[tuple, Model] = {}

    def add(self, model: Model) -> None:
        """A model; what is known of a refit stays."""
        had = self._models.get(model.key)
        if had is None or (model.fit is not None, -model.score) > (had.fit is not None, -had.score):
            self._models[model.key] = model

    def add_predicted(self, found: Iterable[Candidate], beside: Model, anchor: float) -> None:
        """Sets predicted beside a fitted model.

        **Arguments:**

        - `anchor`: what is added to their scores, so that the best of them which was refitted has
          the score of its refit.
        """
        for c in found:
            if np.isfinite(c.score) and (c.effects or c.curve is not None):
                effects = (*beside.effects, *c.effects)
                self.add(Model(effects, c.score + anchor, c.curve))

    def fitted(self, effects: Sequence[AbstractEffect]) -> Model | None:
        """The refit of a set, if there is one."""
        found = self._models.get(key_of(effects))
        return found if found is not None and found.fit is not None else None

    def ranked(self, which: Callable[[Model], bool] = lambda model: True) -> list[Model]:
        """Models, best first."""
        return sorted(filter(which, self._models.values()), key=lambda m: m.score)

    def alike(self, chosen: Model, effect: AbstractEffect, within: float) -> tuple[Named, ...]:
        """What could stand in an effect's place in a model, at nearly the same score."""
        rest = list(chosen.effects)
        rest.remove(next(e for e in rest if e is effect))
        kept = sorted((form(e) for e in rest), key=repr)
        found = []
        for model in self.ranked():
            if model.curve is not None or model.score > chosen.score + within:
                continue
            forms = [form(e) for e in model.effects]
            others = [e for e, f in zip(model.effects, forms, strict=True) if f not in kept]
            if len(forms) != len(kept) + 1 or len(others) != 1:
                continue
            if named(others[0]) != named(effect) and named(others[0]) not in found:
                found.append(named(others[0]))
        return tuple(found)

    def probability(self, name: Named) -> float:
        """Weight of all models that have an effect."""
        models = self.ranked()
        share = weights([m.score for m in models])
        return float(sum(w for w, m in zip(share, models, strict=True) if name in m.names))
