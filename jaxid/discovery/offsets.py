"""Offsets of a fitted model that may be friction that differs by direction."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, AsymmetricFriction, TorqueOffset
from ..estimate.minimise import Prior
from ..noise import ARFilter
from ..parameters import Parameter, read_values
from ..simulation.loop import ClosedLoop
from .hypotheses import free_of
from .likelihood import Score, score
from .predict import Prediction, Predictor
from .signs import shapes_of_signs

# Smallest offset for which this is examined, in standard deviations.
_SIGNIFICANT = 4.0


class Instead(eqx.Module):
    """A model with friction that differs by direction in place of an offset, as predicted.

    Both torques are constant except near reversals and at rest, so a fitted offset absorbs most of
    such a friction, and what is left is too small to be found. If the viscous part does not explain
    its price, it is held at zero, and the friction has as many values as the offset.

    - `loop`: the loop with the friction, and with the offset held at zero.
    - `name`: name of the offset.
    - `effect`: the friction, with its predicted values.
    - `noise`: noise filters of the residual.
    - `loss`: increase of the score. Its number of effects is the same, so the price is too.
    """

    loop: ClosedLoop
    name: str = eqx.field(static=True)
    effect: AbstractEffect
    noise: tuple[ARFilter, ...]
    loss: float


def instead_of_offsets(predictor: Predictor, std: Float[np.ndarray, " values"]) -> list[Instead]:
    """The models in which friction by direction replaces one of the significant offsets.

    **Arguments:**

    - `predictor`: the linear system of the fitted model.
    - `std`: standard deviations of its values.
    """
    loop = predictor.system.loop
    smoothing, form = shapes_of_signs(loop)
    plain = predictor.predict([])
    now = _score(predictor, plain.rest, plain.freedom, plain.taken).value
    found = []
    for p, place, joint in _offsets(loop):
        value = float(p.where(loop))
        if not abs(value) > _SIGNIFICANT * std[place]:
            continue
        without = _without(predictor, p, place, value)
        sign = {"smoothing": float(smoothing[joint - 1]), "form": float(form[joint - 1])}
        there = without.predict([AsymmetricFriction(joint=joint, **sign)])
        if there.possible:
            effect = there.effects[0]
            then = _score(without, there.rest, there.freedom, there.taken)
            exchanged = without.system.loop.add(effect)
            coulomb, rest, taken = _coulomb_alone(without, there)
            alone = _score(without, rest, there.freedom - 1, taken)
            if alone.value < then.value:
                effect, then = AsymmetricFriction(joint=joint, coulomb=coulomb, **sign), alone
                exchanged = _without_viscous(without.system.loop.add(effect))
            found.append(Instead(exchanged, p.name, effect, then.noise, then.value - now))
    return sorted(found, key=lambda x: x.loss)


def held_offsets(loop: ClosedLoop) -> list[str]:
    """Names of the offsets of a loop that are not estimated."""
    return [
        p.name
        for p in loop.parameters
        if p.name not in loop.names
        and p.place[0] == "effects"
        and isinstance(loop.effects[int(p.place[1])], TorqueOffset)
    ]


def _offsets(loop: ClosedLoop) -> Iterator[tuple[Parameter, int, int]]:
    """Free offsets with place in `theta` and joint, on joints without friction by direction."""
    had = {e.joint for e in loop.effects if isinstance(e, AsymmetricFriction)}
    place = 0
    for p in loop.free_parameters:
        effect = loop.effects[int(p.place[1])] if p.place[0] == "effects" else None
        if isinstance(effect, TorqueOffset) and effect.joint not in had:
            yield p, place, effect.joint
        place += p.size


def _coulomb_alone(
    without: Predictor, both: Prediction
) -> tuple[float, Float[np.ndarray, "recordings samples outputs"], Float[np.ndarray, " absorbed"]]:
    """The Coulomb part of a predicted friction without its viscous part.

    **Returns:** its value, the residual, and the changes of the base's values.
    """
    (friction,) = both.effects
    assert isinstance(friction, AsymmetricFriction)
    own = free_of(friction)
    at = [p.place for p in own].index(("coulomb",))
    # The torque is linear in both values.
    values = np.asarray(read_values(friction, own))
    column, left = both.slopes[:, at], both.residual + both.slopes @ values
    coulomb = float(column @ left) / max(float(column @ column), 1e-300)
    data, base = without.data, without.system.base
    rest = data.residual - coulomb * both.moved[..., at]
    taken = without.absorbed(rest)
    return coulomb, (rest - base @ taken) * data.mask[..., None], taken


def _without_viscous(loop: ClosedLoop) -> ClosedLoop:
    """The loop with the viscous part of its last effect held."""
    place = "effects", len(loop.effects) - 1, "viscous"
    return loop.hold(*(p.name for p in loop.parameters if p.place == place))


def _score(
    predictor: Predictor,
    rest: Float[np.ndarray, "recordings samples outputs"],
    freedom: int,
    taken: Float[np.ndarray, " absorbed"],
) -> Score:
    """The score of a predicted model without the price of its effects."""
    return score(predictor.data, rest, freedom, 0, 0, taken)


def _without(predictor: Predictor, p: Parameter, place: int, value: float) -> Predictor:
    """The predictor of the loop with an offset held at zero.

    Torque is linear in the offset, so the residual changes by its column.
    """
    system, prior = predictor.system, predictor.system.prior
    if prior is not None:
        rows = np.delete(np.asarray(prior.rows), place, axis=1)
        prior = Prior(rows, np.delete(np.asarray(prior.expected), place))
    changed = dataclasses.replace(
        system,
        prior=prior,
        loop=system.loop.hold(**{p.name: 0.0}),
        residual=system.residual + value * system.base[..., place],
        base=np.delete(system.base, place, axis=-1),
    )
    return Predictor.of(changed, predictor.noise, predictor.data.level)
