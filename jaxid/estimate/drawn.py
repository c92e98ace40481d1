"""Mistakes that raise no error if bodies are estimated: they contradict the drawn bodies.

A clock that is twice as fast, torque in a wrong unit, another zero position and sometimes another
robot change the estimated bodies only, and so can a position in a wrong unit. Drawings have errors,
but rotors and a tool that a file lacks only add to its bodies. So bodies that seem much lighter on
every joint, or lighter by a factor between units on one joint, are called a mistake.
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..arms import AbstractSerialArm, PhysicalArm, SerialArm, in_base_parameters
from ..effects import RotorInertia
from ..errors import JaxidError
from ..parameters import list_parameters, read_values
from ..simulation.inertia import mass_matrices
from .idim import stack_with_motion
from .regression import linear_parameters
from .result import Fit

# Share of drawn inertia, or of the torque of drawn bodies, below which the estimate is doubtful.
_LIGHT = 0.5
# The same for one joint: an angle in degrees has 1/57 of the inertia, a distance in mm 1/1000.
_UNIT = 1 / 20
# Smallest torque of drawn bodies that is compared, as a share of the recorded torque.
_VISIBLE = 0.1
# A smaller torque is compared if it is this multiple of the fit's error, which may be similar to it
# by chance. It is often a difference of larger ones, so hardly anything of it may be there.
_CLEAR, _GONE = 4.0, 0.2
# Smallest significant difference, in standard deviations.
_SURE = 3.0
_OTHERWISE = "if the file is wrong instead, start from the estimated bodies (jaxid.write_urdf)"


class _Bodies(eqx.Module):
    """A serial arm with its estimated base parameters, and with the drawn ones."""

    arm: SerialArm
    drawn: SerialArm
    covariance: Float[np.ndarray, "base base"]


def contradiction(found: Fit) -> str:
    """The mistake if estimated bodies contradict those of the file, as a sentence; or empty."""
    bodies = _bodies_of(found)
    if bodies is None:
        return ""
    share, high = _inertias(found, bodies)
    if np.any(high < _UNIT):
        joints = " and ".join(f"joint {j + 1}" for j in np.flatnonzero(high < _UNIT))
        return (
            f"the estimated inertia is {_listed(share)} of that of the bodies in the file: check "
            f"the unit of the position of {joints} (degrees instead of rad give 0.017, mm instead "
            f"of m 0.001), the clock and the unit of torque; {_OTHERWISE}"
        )
    if np.all(high < _LIGHT):
        return (
            f"the estimated inertia is {_listed(share)} of that of the bodies in the file: check "
            "the clock of the time stamps (one that is twice as fast gives a quarter), the unit of "
            f"torque and torque constants; {_OTHERWISE}"
        )
    if (share := _torques(found, bodies)) is not None:
        return (
            f"the torque of the estimated bodies is {_listed(share)} of that of the bodies in the "
            "file: check the units and zero positions of the joints, their order, the clock of the "
            f"time stamps, and that the file describes this robot; {_OTHERWISE}"
        )
    return ""


def _listed(values: Float[np.ndarray, " joints"]) -> str:
    return " and ".join(f"{x:.2g}" for x in values)


def _bodies_of(found: Fit) -> _Bodies | None:
    """The bodies of a fit; None if it has not estimated all of their parameters."""
    arm = found.loop.arm
    if not isinstance(arm, AbstractSerialArm) or not found.succeeded:
        return None
    names = [n for p in found.loop.free_parameters if p.place[0] == "arm" for n in p.names]
    at = [found.names.index(name) for name in names]
    covariance = found.covariance[np.ix_(at, at)]
    if len(at) < len(read_values(arm, list_parameters(arm))) or not np.isfinite(covariance).all():
        return None
    if isinstance(arm, PhysicalArm):
        arm, covariance = in_base_parameters(arm, covariance)
    assert isinstance(arm, SerialArm)
    return _Bodies(arm, dataclasses.replace(arm, base=None), covariance)


def _inertias(
    found: Fit, bodies: _Bodies
) -> tuple[Float[np.ndarray, " joints"], Float[np.ndarray, " joints"]]:
    """Shares of the drawn inertia, and their upper limits of three standard deviations."""
    q = np.concatenate([r.q for r in found.recordings])
    rotors = np.zeros(bodies.arm.joints)
    for effect in found.loop.effects:
        if isinstance(effect, RotorInertia):
            rotors[effect.joint - 1] += float(effect.inertia)
    drawn, own = _inertia(bodies.drawn, q), _inertia(bodies.arm, q)
    share = (own + rotors) / drawn
    if not (np.any(share < _UNIT) or np.all(share < _LIGHT)):
        # No limit is needed, and each base parameter takes another evaluation.
        return share, share
    # Inertia is linear in the base parameters.
    base = np.asarray(bodies.arm.base)
    moved = [dataclasses.replace(bodies.arm, base=base + row) for row in np.eye(len(base))]
    slopes = np.stack([_inertia(arm, q) for arm in moved]) - own
    spread = np.sqrt(np.einsum("aj,ab,bj->j", slopes, bodies.covariance, slopes)) / drawn
    return share, share + _SURE * spread


def _inertia(
    arm: SerialArm, q: Float[np.ndarray, "samples joints"]
) -> Float[np.ndarray, " joints"]:
    """Inertia of each joint while the others are at rest, averaged over positions."""
    return np.diagonal(mass_matrices(arm, q), axis1=1, axis2=2).mean(axis=0)


def _torques(found: Fit, bodies: _Bodies) -> Float[np.ndarray, " joints"] | None:
    """Shares of the torque of drawn bodies if they are too small on all joints; otherwise None.

    The share is the coefficient of the drawn bodies' torque in a regression of the estimated
    bodies' torque, with the acceleration for a rotor, and a constant for an offset. Joints whose
    drawn torque apart from these two is small are left out.
    """
    try:
        loop = dataclasses.replace(found.loop, arm=bodies.arm)
        stacked, rows = stack_with_motion(loop, found.recordings)
    except JaxidError:
        return None
    chosen = linear_parameters(loop)
    own = np.repeat([p.place == ("arm", "base") for p in chosen], [p.size for p in chosen])
    drawn, estimated = np.asarray(bodies.drawn.base), np.asarray(bodies.arm.base)
    share, high, limit = np.full((3, bodies.arm.joints), np.nan)
    left = np.sqrt(np.mean(found.error_percent.to_numpy() ** 2, axis=0)) / 100
    for j in range(bodies.arm.joints):
        mine = stacked.columns[:, j][:, own]
        size = float(np.linalg.norm(rows["tau"][:, j]))
        least = min(_VISIBLE, _CLEAR * left[j]) * size
        weight = _weight(mine @ drawn, mine @ estimated, rows["a"][:, j], least)
        if weight is not None:
            slope = weight @ mine
            share[j] = slope @ estimated
            high[j] = share[j] + _SURE * np.sqrt(slope @ bodies.covariance @ slope)
            limit[j] = _LIGHT if 1 / np.linalg.norm(weight) > _VISIBLE * size else _GONE
    tested = np.isfinite(share)
    return share[tested] if tested.any() and np.all((high < limit)[tested]) else None


def _weight(
    expected: Float[np.ndarray, " samples"],
    estimated: Float[np.ndarray, " samples"],
    a: Float[np.ndarray, " samples"],
    least: float,
) -> Float[np.ndarray, " samples"] | None:
    """Weights of samples, 1/(N·m) or 1/N, for the coefficient of the expected torque in another.

    None if the expected torque is too small.

    **Arguments:**

    - `expected`, `estimated`: torque of drawn and of estimated bodies on a joint, N·m or N.
    - `a`: its acceleration, rad/s² or m/s². `least`: smallest norm of expected torque, N·m or N.
    """
    for others in (np.stack([a, np.ones_like(a)], axis=1), np.ones((len(a), 1))):
        basis = np.linalg.qr(others)[0]
        rest = expected - basis @ (basis.T @ expected)
        if not np.linalg.norm(rest) > least:
            return None
        weight = rest / (rest @ rest)
        left = estimated - (weight @ estimated) * expected
        # A rotor has no negative inertia.
        if others.shape[1] == 1 or np.linalg.lstsq(others, left)[0][0] >= 0:
            return weight
    return None
