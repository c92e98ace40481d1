"""Shapes that added effects hold by default, estimated when a search has ended."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..estimate import Fit, Status
from ..parameters import Bounds, Parameter, list_parameters
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from ..simulation.widening import LEAD, SIGN
from .fits import Fits
from .likelihood import score_of, weights
from .models import Model
from .release import doubtful
from .text import joined

# Start values of a shape relative to its value, and of the form of a sign.
_SHARES, _FORMS = (1.0, 0.5), (0.0, 1.0)
# Largest distance in deviations between two fits in the same minimum.
_SAME = 0.5
# Shapes that any fit may estimate.
_OF_FRICTION = (*SIGN, LEAD)
# Smallest weight of a minimum that is mentioned.
_SHOWN = 0.05


def with_shapes(fits: Fits, at: Model) -> Fit:
    """The fit of the final model with the shapes of its added effects estimated.

    A search compares effects with their shapes held at defaults, such as the exponent of a Stribeck
    curve. The deviations of such a fit do not contain the uncertainty of the shape. With the shape
    free, sign and peak of a friction can replace each other, so there may be several minima with
    similar errors. The fit therefore starts from several shapes. Its deviations contain the spread
    of the minima, weighed by their scores (law of total variance; Madigan and Raftery 1994), and no
    value is less certain than its bounds allow.

    If the score is no better with the shapes free, the recordings do not contradict the held ones,
    and free values would only follow noise: the values remain, with the deviations of the fit in
    which the shapes are free.

    Only along an imposed motion, where such fits take seconds.

    **Returns:** the fit of the model itself if no shape is held, or if no such fit succeeds.
    """
    assert at.fit is not None
    loop = at.fit.loop
    held = shapes_of(loop, len(at.effects))
    if not held or not imposed(loop):
        return at.fit
    found = [fits.with_shapes(at.effects, start, at.noise) for start in _starts(loop, held)]
    sound = [f for f in found if f.status.simulated and f.status is not Status.misfit]
    if not sound:
        return at.fit
    free = _merged(sound)
    better = score_of(free).value < score_of(at.fit).value
    return free if better else _less_certain(at.fit, free, held)


def shapes_of(loop: ClosedLoop, added: int) -> list[Parameter]:
    """Shapes of the last effects of a loop that are held by declaration, except those of signs."""
    first = len(loop.effects) - added
    return [
        p
        for p in doubtful(loop)
        if int(p.place[1]) >= first
        and p.place[-1] not in _OF_FRICTION
        and np.isfinite(p.where(loop))
    ]


def has_held_shape(effect: AbstractEffect) -> bool:
    """Whether a shape of an effect is held by declaration, except those of signs."""
    return any(
        not (p.declaration.free or p.declaration.linear) and p.place[-1] not in _OF_FRICTION
        for p in list_parameters(effect)
    )


def _starts(loop: ClosedLoop, held: Sequence[Parameter]) -> list[ClosedLoop]:
    """The loop with held shapes free, at other values of one of them and of its joint's form."""
    loop = loop.free(*[p.name for p in held])
    found: dict[tuple, ClosedLoop] = {}
    for p in held:
        forms = [q for q in loop.free_parameters if q.place[-1] == SIGN[1] and q.joint == p.joint]
        value = float(np.asarray(p.where(loop)))
        choices = [[value * share for share in _SHARES], *(_FORMS for _ in forms)]
        for values in itertools.product(*choices):
            names = [q.name for q in (p, *forms)]
            start = loop.with_values(**dict(zip(names, values, strict=True)))
            found.setdefault(tuple(start.theta.tolist()), start)
    return list(found.values())


def _merged(found: Sequence[Fit]) -> Fit:
    """The fit with the lowest score, with deviations that contain the spread of all minima."""
    best, *others = sorted(found, key=lambda f: score_of(f).value)
    minima = [best]
    for fit in others:
        if not any(_same(fit, other) for other in minima):
            minima.append(fit)
    share = weights([score_of(f).value for f in minima])
    # The minimum with the lowest score gives the values; the others are at a distance from it.
    covariance = sum(
        weight * (f.covariance + np.outer(f.theta - best.theta, f.theta - best.theta))
        for weight, f in zip(share, minima, strict=True)
        if weight > 0
    )
    covariance = _between_bounds(np.asarray(covariance), Bounds.of(best.loop.free_parameters))
    notes, near = best.notes, int(np.sum(share > _SHOWN))
    if near > 1:
        said = (
            f"{near} sets of values explain these recordings almost equally well; the best one is "
            "given, and deviations contain the distance to the others"
        )
        notes = (*notes, said)
    return dataclasses.replace(best, covariance=covariance, notes=notes)


def _less_certain(fit: Fit, free: Fit, held: Sequence[Parameter]) -> Fit:
    """A fit with held shapes, with the deviations that its values have if the shapes are free.

    **Arguments:**

    - `free`: the fit of the same model with these shapes free.
    """
    at = [free.names.index(name) for name in fit.names]
    apart = free.theta[at] - fit.theta
    covariance = free.covariance[np.ix_(at, at)] + np.outer(apart, apart)
    covariance = _between_bounds(covariance, Bounds.of(fit.loop.free_parameters))
    shapes = joined([f"{p.name} of {float(p.where(fit.loop)):.3g}" for p in held])
    said = (
        f"these recordings do not contradict the default {shapes}; the deviations of the other "
        "values contain its uncertainty"
    )
    return dataclasses.replace(fit, covariance=covariance, notes=(*fit.notes, said))


def _between_bounds(
    covariance: Float[np.ndarray, "parameters parameters"], bounds: Bounds
) -> Float[np.ndarray, "parameters parameters"]:
    """A covariance in which no value is less certain than its two bounds allow.

    No distribution between two bounds has a variance above a quarter of their distance squared
    (Popoviciu 1935). A larger variance is reduced to that, and with it those of correlated values,
    as by a measurement of the value (Kalman 1960). Values that are not determined at all remain so.
    """
    most = (np.asarray(bounds.upper) - np.asarray(bounds.lower)) ** 2 / 4
    for k, limit in enumerate(most):
        variance = covariance[k, k]
        if limit < variance < np.inf:
            column = covariance[:, k]
            covariance = covariance - (variance - limit) / variance**2 * np.outer(column, column)
    return covariance


def _same(one: Fit, other: Fit) -> bool:
    """Whether two fits of one model are in the same minimum."""
    std = np.minimum(one.std, other.std)
    known = np.isfinite(std) & (std > 0)
    apart = np.abs(one.theta - other.theta)[known]
    return bool(np.all(apart <= _SAME * std[known]))
