"""Models that a search has examined, with their scores and weights."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, Curve
from ..errors import ModelError
from ..estimate import Fit
from ..estimate.result import joint_columns
from ..noise import ARFilter
from .comparison import Comparison
from .diagnosis import over_recordings
from .explore import Candidate, key_of
from .hypotheses import effect_on
from .landscape import form
from .likelihood import weights

if TYPE_CHECKING:
    import pandas as pd

Named = tuple[str, int | None]
# Models within this difference of scores are indistinguishable: odds of 20 to 1.
LIKELY = 6.0
# Number of models that a story keeps; later ones have no weight.
_KEPT = 30


class Model(eqx.Module):
    """A set of effects over the starting model, and its score.

    - `curve`: a free-form curve in addition to the effects.
    - `fit`: its full refit; None if it was only predicted.
    - `noise`: noise filters of its residual, one per output.
    - `left`: relative error on the fitted recordings by joint, %.
    - `beyond`: number of effects, plus one for a curve, that the prediction added to a fitted
      model.
    - `weight`: its posterior weight among all examined models.
    - `held_out`: its comparison with held-out recordings, if there is one.
    """

    effects: tuple[AbstractEffect, ...]
    score: float
    curve: Curve | None = None
    fit: Fit | None = None
    noise: tuple[ARFilter, ...] = ()
    left: Float[np.ndarray, " joints"] | None = None
    beyond: int = 0
    weight: float = 0.0
    held_out: Comparison | None = None

    @property
    def key(self) -> tuple:
        """Identity of the set of effects."""
        return key_of(self.effects, self.curve)

    @property
    def names(self) -> tuple[Named, ...]:
        """Name and joint of each effect."""
        return tuple(named(e) for e in self.effects)

    @property
    def status(self) -> str:
        """Status of its fit, or `predicted`."""
        return "predicted" if self.fit is None else self.fit.status.name

    @property
    def unseen_percent(self) -> Float[np.ndarray, " joints"] | None:
        """Relative error on held-out recordings, by joint, %."""
        held = self.held_out
        return None if held is None else over_recordings(held.error_percent.to_numpy())

    @property
    def label(self) -> str:
        """Its additions to the starting model, in words."""
        return " + ".join(self._parts(self.names)) or "start"

    def label_beside(self, final: Sequence[AbstractEffect]) -> str:
        """The label, in which several effects of the final model are called `final`.

        **Arguments:**

        - `final`: the effects of the final model.
        """
        known, own = Counter(map(named, final)), Counter(self.names)
        if len(final) < 2 or known - own:
            return self.label
        return " + ".join(["final", *self._parts(tuple((own - known).elements()))])

    def _parts(self, names: Sequence[Named]) -> list[str]:
        parts = [effect_on(*name) for name in names]
        if self.curve is not None:
            along = f"{self.curve.label}{' and direction' if self.curve.signed else ''}"
            parts.append(f"curve of {along} on joint {self.curve.joint}")
        return parts

    def to_dict(self, best: float) -> dict[str, Any]:
        """The model as plain JSON.

        **Arguments:**

        - `best`: the score of the best model.
        """
        unseen = self.unseen_percent
        return {
            "model": self.label,
            "effects": [{"effect": n, "joint": j} for n, j in self.names],
            "curve": None if self.curve is None else self.curve.effect_name(),
            "score": float(self.score),
            "difference": float(self.score - best),
            "weight": float(self.weight),
            "fit_percent": None if self.left is None else self.left.tolist(),
            "validate_percent": None if unseen is None else unseen.tolist(),
            "status": self.status,
        }


def named(effect: AbstractEffect) -> Named:
    """An effect's name and joint."""
    return effect.effect_name(), getattr(effect, "joint", None)


def listed(effects: Sequence[AbstractEffect]) -> str:
    """Effects with their joints, as part of a sentence."""
    return " and ".join(effect_on(*named(e)) for e in effects)


def piece_name(effects: Sequence[AbstractEffect]) -> str:
    """The name of a set's refit among saved pieces; it distinguishes forms of one effect."""
    parts = []
    for e in effects:
        name, joint, kind = form(e)
        parts.append(f"{name} {joint or ''} {kind}")
    return f"with {', '.join(parts)}"


class Visited:
    """All examined models, each with the score of its refit, or else of its best prediction."""

    def __init__(self) -> None:
        self._models: dict[tuple, Model] = {}

    def add(self, model: Model) -> None:
        """Adds a model, unless it is known from a prediction nearer to a refit."""
        had = self._models.get(model.key)
        if had is None or (model.beyond, model.score) < (had.beyond, had.score):
            self._models[model.key] = model

    def drop(self, key: tuple) -> None:
        """Removes a model."""
        del self._models[key]

    def forget(self, gone: set[tuple]) -> None:
        """Removes all models with an effect of these forms."""
        self._models = {k: m for k, m in self._models.items() if not gone.intersection(k)}

    def add_predicted(
        self,
        found: Iterable[Candidate],
        beside: Model,
        anchor: float,
        left: Callable[[Candidate], np.ndarray],
    ) -> None:
        """Adds sets predicted from a fitted model.

        **Arguments:**

        - `anchor`: correction of their scores; with it, the best set that was refitted has the
          score of its refit.
        - `left`: function for a set's relative error by joint, %.
        """
        for c in found:
            if np.isfinite(c.score) and (c.effects or c.curve is not None):
                effects = (*beside.effects, *c.effects)
                beyond = len(c.effects) + (c.curve is not None)
                predicted = Model(
                    effects, c.score + anchor, c.curve, None, c.noise, left(c), beyond
                )
                self.add(predicted)

    def fitted(self, effects: Sequence[AbstractEffect]) -> Model | None:
        """The refit of a set, if there is one."""
        found = self._models.get(key_of(effects))
        return found if found is not None and found.fit is not None else None

    def ranked(self, which: Callable[[Model], bool] = lambda model: True) -> list[Model]:
        """Models, best first."""
        return sorted(filter(which, self._models.values()), key=lambda m: m.score)

    def alike(self, chosen: Model, effect: AbstractEffect) -> tuple[Named, ...]:
        """Effects that could replace an effect of a model at nearly the same score."""
        rest = list(chosen.effects)
        rest.remove(next(e for e in rest if e is effect))
        kept = sorted((form(e) for e in rest), key=repr)
        found = []
        for model in self.ranked():
            if model.curve is not None or model.score > chosen.score + LIKELY:
                continue
            forms = [form(e) for e in model.effects]
            others = [e for e, f in zip(model.effects, forms, strict=True) if f not in kept]
            if len(forms) != len(kept) + 1 or len(others) != 1:
                continue
            if named(others[0]) != named(effect) and named(others[0]) not in found:
                found.append(named(others[0]))
        return tuple(found)

    def weighed(self, chosen: Model) -> tuple[Model, ...]:
        """All models with their weights, best first.

        Sets that contain all effects of the chosen model are predicted from its own linear system.
        Earlier predictions of these sets are left out.
        """

        def known(m: Model) -> bool:
            more = len(m.effects) + (m.curve is not None) - len(chosen.effects)
            return m.beyond <= more or Counter(chosen.key) - Counter(m.key) != Counter()

        models = self.ranked(known)
        shares = weights([m.score for m in models])
        return tuple(
            dataclasses.replace(m, weight=float(w)) for m, w in zip(models, shares, strict=True)
        )


def probability(models: Iterable[Model], *names: Named) -> float:
    """Share of the models with one of the effects in the weight of all models without a curve.

    A free-form curve describes the same torque as an effect and does not contradict it (Madigan and
    Raftery 1994).
    """
    plain = [m for m in models if m.curve is None]
    shares = weights([m.score for m in plain])
    return float(sum(w for m, w in zip(plain, shares, strict=True) if set(names) & set(m.names)))


def worth_keeping(models: Sequence[Model]) -> tuple[Model, ...]:
    """The best models and all fitted ones."""
    return tuple(m for k, m in enumerate(models) if k < _KEPT or m.fit is not None)


def picked(models: Sequence[Model], asked: int | str) -> Model:
    """A model by its row in the table, or by its name.

    **Raises:** `ModelError` if there is no such model.
    """
    found = models if isinstance(asked, int) else [m for m in models if m.label == asked]
    place = asked if isinstance(asked, int) else 0
    if not 0 <= place < len(found):
        what = f"row {asked}" if isinstance(asked, int) else f"model {asked!r}"
        raise ModelError(
            f"there is no {what} among the {len(models)} models of this discovery: "
            "see the table Discovery.models"
        )
    return found[place]


def models_table(models: Sequence[Model]) -> "pd.DataFrame":
    """Table of models: score, difference to the best, weight, errors in %, status."""
    import pandas as pd

    rows = []
    for m in models:
        row: dict[str, Any] = {
            "model": m.label,
            "score": m.score,
            "difference": m.score - models[0].score,
            "weight": m.weight,
        }
        row |= _by_joint("fit", m.left)
        row |= _by_joint("held out", m.unseen_percent)
        rows.append({**row, "status": m.status})
    table = pd.DataFrame(rows)
    last = table.pop("status")
    return table.assign(status=last)


def _by_joint(what: str, percent: np.ndarray | None) -> dict[str, float]:
    values = () if percent is None else percent
    return {
        f"{what}, {label}": float(x)
        for label, x in zip(joint_columns(len(values)), values, strict=True)
    }
