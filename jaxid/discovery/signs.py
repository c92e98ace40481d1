"""Shapes of the smoothed signs of a loop's frictions; those of one joint are the same."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, Coulomb
from ..parameters import Parameter
from ..simulation.loop import ClosedLoop
from ..simulation.widening import SIGN

# Ends of the places of the shapes of an effect's sign.
OF_SIGN = {(what,) for what in SIGN}
# Smoothing, rad/s or m/s, and form of the sign of a joint without Coulomb friction.
_DEFAULT = 0.01, 0.0
# Relative difference of shapes that changes a fit by less than its deviations.
_SAME = 0.1
# Smoothing below which a sign jumps, as a share of its scale.
JUMPS = 0.02
# Form between those of arctan and tanh.
_BETWEEN = 0.5
# Form above which a sign is a ramp, as a share of the largest one.
_RAMP = 0.99


def shapes_of_signs(
    loop: ClosedLoop,
) -> tuple[Float[np.ndarray, " joints"], Float[np.ndarray, " joints"]]:
    """Smoothing, rad/s or m/s, and form of the sign in the Coulomb friction of each joint."""
    known = {
        e.joint: (float(e.smoothing), float(e.form)) for e in loop.effects if isinstance(e, Coulomb)
    }
    smoothing, form = np.array([known.get(j, _DEFAULT) for j in range(1, loop.joints + 1)]).T
    return smoothing, form


def of_one_sign(loop: ClosedLoop, share: float = 1.0) -> ClosedLoop:
    """The loop with one sign per joint, where shapes of that of its Coulomb friction are estimated.

    Effects are added with the current shapes, and the refit may change those of the friction.

    **Arguments:**

    - `share`: how far the other shapes move to those of the Coulomb friction.
    """
    estimated, held = {}, []
    for p in loop.parameters:
        if p.place[0] != "effects" or p.place[2:] not in OF_SIGN:
            continue
        effect = loop.effects[int(p.place[1])]
        own = _joint_of_sign(effect), p.place[-1]
        if isinstance(effect, Coulomb) and p.name in loop.names:
            estimated[own] = float(np.asarray(p.where(loop)))
        elif p.name not in loop.names:
            held.append((p.name, own, float(np.asarray(p.where(loop)))))
    return loop.with_values(
        **{
            name: now + share * (estimated[own] - now)
            for name, own, now in held
            if own in estimated
        }
    )


def has_one_sign(loop: ClosedLoop) -> bool:
    """Whether the frictions of each joint have almost the same sign, where its shape is estimated.

    A fit estimates the shape of the Coulomb friction only.
    """
    tied = of_one_sign(loop)
    for p in loop.parameters:
        if p.place[0] == "effects" and p.place[2:] in OF_SIGN:
            now, own = (float(np.asarray(p.where(x))) for x in (loop, tied))
            if abs(now - own) > _SAME * max(now, own, p.declaration.scale * _SAME):
                return False
    return True


def from_usual_signs(loop: ClosedLoop) -> ClosedLoop | None:
    """The loop with a usual shape of each estimated sign that is a jump or a ramp; None if none is.

    These are the ends of the range of shapes, where a fit can be in another minimum.
    """
    free = {p.place: p for p in loop.free_parameters if p.place[2:] in OF_SIGN}
    values = {}
    for place, p in free.items():
        if place[-1] != SIGN[0]:
            continue
        form = free.get((*place[:2], SIGN[1]))
        ramp = form is not None and float(form.where(loop)) > _RAMP * form.declaration.upper
        if float(p.where(loop)) < JUMPS * p.declaration.scale or ramp:
            values[p.name] = p.declaration.scale
            if form is not None:
                values[form.name] = _BETWEEN
    return loop.with_values(**values) if values else None


def reshaped(loop: ClosedLoop, effect: AbstractEffect) -> bool:
    """Whether the shape of a sign is estimated on the joint of an effect.

    A change of the shape can replace a friction, which a linear system predicts with large errors.
    """
    free = [p for p in loop.free_parameters if p.place[0] == "effects" and p.place[2:] in OF_SIGN]
    joints = {_joint_of_sign(loop.effects[int(p.place[1])]) for p in free}
    return _joint_of_sign(effect) in joints


def follows(p: Parameter, loop: ClosedLoop) -> bool:
    """Whether a parameter is a shape of a sign that follows the joint's Coulomb friction."""
    if p.place[0] != "effects" or p.place[2:] not in OF_SIGN:
        return False
    effect = loop.effects[int(p.place[1])]
    leading = {e.joint for e in loop.effects if isinstance(e, Coulomb)}
    return not isinstance(effect, Coulomb) and _joint_of_sign(effect) in leading


def _joint_of_sign(effect: AbstractEffect) -> Any:
    """The joint whose direction a friction has; for a shared shaft, the one that it drives."""
    return getattr(effect, "driven", getattr(effect, "joint", None))
