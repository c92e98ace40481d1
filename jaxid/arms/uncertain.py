"""Uncertainty of the base parameters of drawn bodies."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .serial import SerialArm

# Standard deviation of a rotor of which nothing is known, relative to the largest base parameter.
_UNKNOWN = 10.0
# Smallest standard deviation, relative to the largest one of a parameter of the same unit; smallest
# eigenvalue of the correlation. Otherwise links without a body would be known exactly.
_LEAST, _APART = 1e-3, 1e-9


def drawn_covariance(
    arm: SerialArm, uncertainty: float, unknown_rotors: Sequence[int] = ()
) -> Float[np.ndarray, "base base"]:
    """Covariance of an arm's base parameters if its drawn bodies are uncertain.

    Masses have this relative deviation. First moments have the same deviation relative to mass
    times the distance of the centre of mass or, if that is larger, the radius of gyration; inertias
    relative to the largest one of their link. Errors of different parameters are independent.

    **Arguments:**

    - `uncertainty`: relative standard deviation of the bodies' parameters.
    - `unknown_rotors`: joints, from 1, whose rotor inertia is part of a base parameter and is not
      known.
    """
    bodies, combined = np.asarray(arm.bodies), np.asarray(arm.combined)
    deviation = np.stack([_deviations(body) for body in bodies])
    for unit in (slice(0, 6), slice(6, 9), slice(9, 10)):
        part = deviation[:, unit]
        deviation[:, unit] = np.maximum(part, _LEAST * part.max())
    within = combined * (uncertainty * deviation.ravel())
    covariance = within @ within.T
    # It needs a regressor at many poses.
    rotors = arm.rotors_in_base() if unknown_rotors else np.zeros((len(combined), 0))
    for joint in unknown_rotors:
        column = rotors[:, joint - 1] * _UNKNOWN * np.abs(np.asarray(arm.base)).max()
        covariance = covariance + np.outer(column, column)
    return covariance + _APART * np.diag(np.diag(covariance))


def _deviations(body: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    """Deviations of `BODY` for a relative uncertainty of one, SI units."""
    inertia, moment, mass = np.abs(body[[0, 3, 5]]).max(), np.linalg.norm(body[6:9]), abs(body[9])
    return np.concatenate(
        [np.full(6, inertia), np.full(3, max(moment, np.sqrt(inertia * mass))), [mass]]
    )
