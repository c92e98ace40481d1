"""Which bodies, if any, have base parameters that were estimated."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import ModelError, require
from .serial import SerialArm

# Smallest eigenvalue of a body's scaled pseudo-inertia: bodies of the drawing that are points or
# thin rods stay possible up to that.
_LEAST = 1e-7
# Distance, in deviations, below which the estimate itself is that of bodies.
_THERE = 1e-2


class PhysicalBodies(eqx.Module):
    """Bodies with masses and inertias that matter can have, next to estimated base parameters.

    - `bodies`: `BODY` of each link, SI units. Among all with these base parameters they are those
      nearest to the drawing.
    - `base`: their base parameters.
    - `distance`: how far these are from the estimated ones, in standard deviations; nil where
      bodies have the estimated ones.
    """

    bodies: Float[np.ndarray, "joints 10"]
    base: Float[np.ndarray, " base"]
    distance: float

    @property
    def possible(self) -> bool:
        """Whether bodies have the estimated base parameters."""
        return bool(self.distance == 0)


def physical_bodies(
    arm: SerialArm, covariance: Float[np.ndarray, "base base"] | None = None
) -> PhysicalBodies:
    """Bodies whose base parameters are nearest to an arm's, by a semidefinite program.

    A body is physical where its pseudo-inertia is positive definite (Wensing, Kim, Slotine 2018;
    Sousa, Cortesão 2014). Base parameters of a regression need not be those of any bodies: they
    may stand for an effect that the model lacks, such as a spring that balances the arm. Asks for
    the extra `sdp`.

    **Arguments:**

    - `arm`: with estimated base parameters.
    - `covariance`: of these; each is as sure as it is large where None.

    **Raises:** `ModelError` where the program finds nothing; `MissingExtraError`.
    """
    cvxpy = require("cvxpy", "sdp")
    require("clarabel", "sdp")
    base, combined = np.asarray(arm.base), np.asarray(arm.combined)
    drawn = np.asarray(arm.bodies)
    scale = _scales(arm)
    if covariance is None:
        whiten = np.diag(1 / np.maximum(np.abs(base), 1e-3 * np.abs(base).max()))
    else:
        values, vectors = np.linalg.eigh(covariance)
        whiten = (vectors / np.sqrt(np.maximum(values, 1e-12 * values.max()))).T
    unknown = cvxpy.Variable(drawn.size)
    bodies = cvxpy.multiply(scale.ravel(), unknown)
    matter = [
        _pseudo_inertia(cvxpy, unknown[10 * k : 10 * (k + 1)]) >> _LEAST * np.eye(4)
        for k in range(arm.joints)
    ]
    away = whiten @ (combined @ bodies - base)
    size = np.linalg.norm(whiten @ base)
    _solved(cvxpy, cvxpy.norm(away / size), matter)
    distance = size * float(np.linalg.norm(np.asarray(away.value) / size))
    distance = float(distance) if distance > _THERE else 0.0
    reached = base if distance == 0 else combined @ np.asarray(bodies.value)
    # Of all bodies with these base parameters the ones most like the drawing.
    told = np.linalg.norm(combined, axis=1) * np.abs(scale).max()
    same = cvxpy.multiply(1 / told, combined @ bodies - reached)
    moved = unknown - (drawn / scale).ravel()
    _solved(cvxpy, cvxpy.sum_squares(moved) + 1e8 * cvxpy.sum_squares(same), matter)
    found = np.asarray(bodies.value)
    # What the program's tolerance leaves of the base parameters, unless only it keeps a body that
    # is drawn as a point from being none.
    own = scale.ravel()
    rest = np.linalg.lstsq(combined * own, reached - combined @ found)[0] * own
    if smallest_eigenvalues((found + rest).reshape(drawn.shape)).min() > 0:
        found = found + rest
    return PhysicalBodies(found.reshape(drawn.shape), combined @ found, distance)


def smallest_eigenvalues(bodies: Float[np.ndarray, "joints 10"]) -> Float[np.ndarray, " joints"]:
    """Of each body's pseudo-inertia; above zero where the body is physical."""
    return np.array([np.linalg.eigvalsh(_pseudo_inertia(np, body))[0] for body in bodies])


def _pseudo_inertia(library, body):
    """The 4 by 4 matrix of a body's second and first moments and its mass."""
    xx, xy, xz, yy, yz, zz, mx, my, mz, m = (body[k] for k in range(10))
    rows = [
        [(yy + zz - xx) / 2, -xy, -xz, mx],
        [-xy, (xx + zz - yy) / 2, -yz, my],
        [-xz, -yz, (xx + yy - zz) / 2, mz],
        [mx, my, mz, m],
    ]
    return library.array(rows) if library is np else library.bmat(rows)


def _scales(arm: SerialArm) -> Float[np.ndarray, "joints 10"]:
    """Sizes of each link's parameters: of a ball of its mass, as large as the arm's links are."""
    drawn = np.asarray(arm.bodies)
    mass = np.maximum(drawn[:, 9], 0.05 * drawn[:, 9].max())
    moment = np.linalg.norm(drawn[:, 6:9], axis=1)
    length = np.maximum(moment / mass, 0.05)[:, None]
    powers = np.array([2] * 6 + [1] * 3 + [0])
    return mass[:, None] * length**powers


def _solved(cvxpy, objective, constraints) -> None:
    problem = cvxpy.Problem(cvxpy.Minimize(objective), constraints)
    try:
        problem.solve(solver="CLARABEL")
    except cvxpy.SolverError as error:
        raise ModelError(
            f"no physical bodies were found ({error}): fit other recordings"
        ) from error
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise ModelError(
            f"no physical bodies were found ({problem.status}): fit recordings that move more"
        )
