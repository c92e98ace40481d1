"""Best-first search over sets of effects, each predicted in the linear system."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, Curve
from ..noise import ARFilter
from ..simulation.loop import ClosedLoop
from .bounded import least_squares
from .landscape import Entry, Landscape, crowded, form, shares_a_joint
from .likelihood import score
from .predict import Prediction
from .score import spanned

# Decisive difference of scores: odds of 150 to 1.
DECISIVE = 10.0
# Number of sets that are extended, and of single effects and pairs that are added to each.
_OPEN, _ADDED, _PAIRED = 3, 5, 2
# Number of leading entries whose best partner is searched.
_FIRSTS = 8
# Number of the best sets whose own noise filters are estimated, and of iterations of that.
_REFINED, _TURNS = 8, 3
# Entries with less than this share of the best evidence are not added. The share is not near one
# because shapes are on a grid, and the true shape may be between its points.
_BEHIND = 0.5


class Candidate(eqx.Module):
    """A set of effects, with or without a free-form curve, and its score in the linear system.

    - `rest`: its residual, not whitened.
    - `taken`: changes of the base's values that belong to it.
    - `columns`: columns of its curve.
    """

    effects: tuple[AbstractEffect, ...]
    score: float
    noise: tuple[ARFilter, ...]
    prediction: Prediction
    rest: Float[np.ndarray, "recordings samples outputs"]
    taken: Float[np.ndarray, " absorbed"]
    curve: Curve | None = None
    columns: Float[np.ndarray, "recordings samples outputs knots"] | None = None

    @property
    def freedom(self) -> int:
        """Number of estimated physical values."""
        knots = 0 if self.columns is None else self.columns.shape[-1]
        return self.prediction.freedom + knots

    @property
    def size(self) -> int:
        """Number of chosen effects and curves."""
        return len(self.effects) + (self.curve is not None)

    @property
    def key(self) -> tuple:
        """Identity of the set, independent of order and values."""
        return key_of(self.effects, self.curve)


def key_of(effects: Sequence[AbstractEffect], curve: Curve | None = None) -> tuple:
    """Identity of a set of effects, independent of order and values."""
    given = [*effects, *([] if curve is None else [curve])]
    return tuple(sorted((form(e) for e in given), key=repr))


def explore(
    landscape: Landscape,
    most: int,
    say: Callable[[str], None],
) -> list[Candidate]:
    """All examined sets, best first.

    The best set, and those that are not decisively worse, are changed: one or two effects are
    added, one is removed, one is replaced, or a curve is added. The search ends when no change
    gives a better set.

    **Arguments:**

    - `most`: largest number of effects in a set.
    - `say`: function that reports the set that is examined.
    """
    nothing = _candidate(landscape, landscape.predictor.predict(()))
    seen: dict[tuple, Candidate] = {nothing.key: nothing}
    opened: set[tuple] = set()
    while (at := _next(seen, opened)) is not None:
        opened.add(at.key)
        for effects in _moves(landscape, seen, at, most):
            if key_of(effects) in seen or shares_a_joint(effects):
                continue
            said = ", ".join(e.effect_name() for e in effects)
            say(f"prediction of model {len(seen)}: with {said}")
            found = _candidate(landscape, landscape.predictor.predict(effects))
            seen[key_of(effects)] = found
        for curved in _with_curves(landscape, at):
            seen[curved.key] = curved
    ranked = _ranked(seen)
    near = {c.key for c in ranked[:_REFINED]} | {nothing.key}
    refined = [_refined(landscape, c) if c.key in near else c for c in ranked]
    return sorted(refined, key=lambda c: c.score)


def largest_first(
    effects: Sequence[AbstractEffect], examined: Sequence[Candidate]
) -> tuple[AbstractEffect, ...]:
    """The effects in the order of what each explains alone; those not examined alone are last.

    A result lists effects that are added together in this order.
    """
    alone = {one.key[0]: one.score for one in examined if one.size == 1}
    return tuple(sorted(effects, key=lambda e: alone.get(form(e), np.inf)))


def _ranked(seen: dict[tuple, Candidate]) -> list[Candidate]:
    return sorted(seen.values(), key=lambda c: c.score)


def _next(seen: dict[tuple, Candidate], opened: set[tuple]) -> Candidate | None:
    """The best set that has not been extended yet; None if there is none.

    Sets that contain a better set are not extended.
    """
    plain: list[Candidate] = []
    for c in _ranked(seen):
        if (
            c.curve is None
            and np.isfinite(c.score)
            and not any(set(p.key) < set(c.key) for p in plain)
        ):
            plain.append(c)
    near = [c for c in plain[:_OPEN] if c.score < plain[0].score + DECISIVE]
    return next((c for c in near if c.key not in opened), None)


def _candidate(landscape: Landscape, found: Prediction) -> Candidate:
    noise = landscape.predictor.noise
    made = Candidate(found.effects, np.inf, noise, found, found.rest, found.taken)
    return _scored(landscape, made, found.rest) if found.possible else made


def _scored(landscape: Landscape, c: Candidate, rest: np.ndarray) -> Candidate:
    """A set with a new residual, and the score of this residual."""
    data = landscape.predictor.data
    judged = score(data, rest, c.freedom, c.size, landscape.forms, c.taken)
    return dataclasses.replace(c, score=judged.value, noise=judged.noise, rest=rest)


def _refined(landscape: Landscape, c: Candidate) -> Candidate:
    """A set whose amplitudes and base values are estimated with its own noise filters.

    The search predicts all sets with the same filters. A full fit estimates filters of its own,
    which raise its likelihood, most of all where much of the residual is unexplained. Only with
    filters of its own is the score of a set comparable with that of a fit.
    """
    for _ in range(_TURNS if np.isfinite(c.score) else 0):
        better = _estimated(landscape, c, c.noise)
        if better.score > c.score - 1:
            break
        c = better
    return c


def _estimated(landscape: Landscape, c: Candidate, noise: Sequence[ARFilter]) -> Candidate:
    """A set whose linear values are estimated again, from their current values."""
    data = landscape.predictor.data
    wide = [data.base, c.prediction.moved, *([] if c.columns is None else [c.columns])]
    columns = np.concatenate(wide, axis=-1)
    white = data.white_columns(columns, noise, slice(None))
    left = data.white_residual(c.rest, noise, c.taken)
    basis = spanned(white)
    low, high = landscape.predictor.limits
    within = low - c.taken, high - c.taken
    more = least_squares(basis.T @ left, basis.T @ white, within)[0]
    rest = (c.rest - columns @ more) * data.mask[..., None]
    moved = dataclasses.replace(c, taken=c.taken + more[: len(c.taken)])
    return _scored(landscape, moved, rest)


def _moves(
    landscape: Landscape,
    seen: dict[tuple, Candidate],
    at: Candidate,
    most: int,
) -> Iterator[tuple[AbstractEffect, ...]]:
    own = _fitted(landscape.predictor.system.loop)
    had = (*own, *at.effects)
    if len(at.effects) < most:
        entries = _allowed(landscape.beside(at.prediction), had)
        best = entries[0].evidence if entries else 0.0
        for entry in entries[:_ADDED]:
            if entry.evidence > max(0.0, _BEHIND * best):
                yield (*at.effects, entry.effect)
        if len(at.effects) + 1 < most:
            pairs = landscape.pairs(at.prediction, entries[:_FIRSTS])
            pairs = [(a, b) for a, b in pairs if _allowed([b], (*had, a.effect))]
            for one, other in pairs[:_PAIRED]:
                if one.evidence + other.evidence > max(best, 0.0) + DECISIVE:
                    yield (*at.effects, one.effect, other.effect)
    for k, gone in enumerate(at.effects):
        less = (*at.effects[:k], *at.effects[k + 1 :])
        if not less:
            continue
        yield less
        without = seen.get(key_of(less))
        if without is None or not without.prediction.possible:
            continue
        others = [
            e
            for e in _allowed(landscape.beside(without.prediction), (*own, *less))
            if form(e.effect)[:2] != form(gone)[:2]
        ]
        for entry in others[:_PAIRED]:
            if entry.evidence > 0:
                yield (*less, entry.effect)


def _fitted(loop: ClosedLoop) -> list[AbstractEffect]:
    """The loop's own effects with a free parameter.

    Effects without one are left out, because their held values may be wrong.
    """
    places = {p.place[1] for p in loop.free_parameters if p.place[0] == "effects"}
    return [e for k, e in enumerate(loop.effects) if k in places]


def _allowed(entries: Sequence[Entry], had: Sequence[AbstractEffect]) -> list[Entry]:
    """Entries of the catalogue that can be added to these effects; curves are no entries of it."""
    return [e for e in entries if not isinstance(e.effect, Curve) and not crowded((e.effect,), had)]


def _with_curves(landscape: Landscape, at: Candidate) -> list[Candidate]:
    """The set with each of the curves that explain most of its residual."""
    entries = landscape.beside(at.prediction, _PAIRED, curves=True)
    return [_curved(landscape, at, e) for e in entries if e.evidence > 0]


def _curved(landscape: Landscape, at: Candidate, entry: Entry) -> Candidate:
    assert isinstance(entry.effect, Curve)
    made = dataclasses.replace(
        at,
        rest=at.prediction.rest,
        taken=at.prediction.taken,
        curve=entry.effect,
        columns=landscape.data.columns(entry.hypothesis.columns).astype(float),
    )
    return _estimated(landscape, made, landscape.predictor.noise)
