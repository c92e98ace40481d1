"""Physically consistent bodies for estimated base parameters."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import ModelError, require
from .serial import SerialArm

# Smallest allowed eigenvalue of a body's scaled pseudo-inertia; points and thin rods of a drawing
# count as consistent.
_LEAST = 1e-7
# Distance, in deviations, below which the estimate itself counts as physically consistent.
_THERE = 1e-2


class PhysicalBodies(eqx.Module):
    """The physically consistent bodies that are nearest to estimated base parameters.

    - `bodies`: `BODY` of each link, SI units. Among all bodies with these base parameters they are
      the nearest to the drawing.
    - `base`: their base parameters.
    - `distance`: distance from these to the estimate, in standard deviations; zero if the estimate
      is physically consistent.
    """

    bodies: Float[np.ndarray, "joints 10"]
    base: Float[np.ndarray, " base"]
    distance: float

    @property
    def possible(self) -> bool:
        """Whether the estimated base parameters are physically consistent."""
        return bool(self.distance == 0)


def physical_bodies(
    arm: SerialArm, covariance: Float[np.ndarray, "base base"] | None = None
) -> PhysicalBodies:
    """The physically consistent bodies nearest to an arm's base parameters.

    Solves a semidefinite program, which needs the extra `sdp`.

    A body is physical if its pseudo-inertia is positive definite (Wensing, Kim, Slotine 2018;
    Sousa, Cortesão 2014). Estimated base parameters may not belong to physical bodies, for example
    if they have absorbed an effect that the model lacks, such as a spring that balances the arm.

    **Arguments:**

    - `arm`: with estimated base parameters.
    - `covariance`: covariance of these parameters; if None, the standard deviation of each
      parameter is its magnitude.

    **Raises:** `ModelError` if the program has no solution; `MissingExtraError`.
    """
    cvxpy = require("cvxpy", "sdp")
    require("clarabel", "sdp")
    base, combined = np.asarray(arm.base), np.asarray(arm.combined)
    drawn = np.asarray(arm.bodies)
    scale = _scales(arm)
    if covariance is None:
        whiten = np.diag(1 / np.maximum(np.abs(base), 1e-3 * np.abs(base).max()))
    else:
        deviations, vectors = _axes(covariance)
        whiten = (vectors / deviations).T
    unknown, bodies, matter = _physical(cvxpy, arm)
    distance = _distances(cvxpy, arm, whiten, bodies, matter)(base)
    reached = base if distance == 0 else combined @ np.asarray(bodies.value)
    # Among all bodies with these base parameters, those most like the drawing.
    told = np.linalg.norm(combined, axis=1) * np.abs(scale).max()
    same = cvxpy.multiply(1 / told, combined @ bodies - reached)
    moved = unknown - (drawn / scale).ravel()
    _solved(cvxpy, cvxpy.sum_squares(moved) + 1e8 * cvxpy.sum_squares(same), matter)
    found = np.asarray(bodies.value)
    # Removes the error in the base parameters that is due to the program's tolerance, unless a body
    # that is drawn as a point would then not be physical.
    own = scale.ravel()
    rest = np.linalg.lstsq(combined * own, reached - combined @ found)[0] * own
    if smallest_eigenvalues((found + rest).reshape(drawn.shape)).min() > 0:
        found = found + rest
    return PhysicalBodies(found.reshape(drawn.shape), combined @ found, distance)


def chance_of(
    arm: SerialArm,
    covariance: Float[np.ndarray, "base base"],
    found: PhysicalBodies,
    draws: int = 99,
) -> float:
    """Probability that estimates of physical bodies are as far from any as an arm's parameters.

    The distance of estimates has no closed distribution: it is drawn, with the nearest physical
    bodies as the true ones (Monte Carlo test, Barnard 1963). Drawing ends with the first distance
    that is larger, because the probability is then above 1 / (`draws` + 1).

    **Arguments:**

    - `arm`, `covariance`: as for `physical_bodies`. `found`: its result.
    - `draws`: largest number of draws.
    """
    cvxpy = require("cvxpy", "sdp")
    deviations, vectors = _axes(covariance)
    _, bodies, matter = _physical(cvxpy, arm)
    distance = _distances(cvxpy, arm, (vectors / deviations).T, bodies, matter)
    rng = np.random.default_rng(0)
    for k in range(1, draws + 1):
        error = vectors @ (deviations * rng.standard_normal(len(deviations)))
        if distance(found.base + error) >= found.distance:
            return 2 / (k + 1)
    return 1 / (draws + 1)


def _axes(
    covariance: Float[np.ndarray, "base base"],
) -> tuple[Float[np.ndarray, " base"], Float[np.ndarray, "base base"]]:
    """Deviations along the eigenvectors of a covariance, and these eigenvectors."""
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(values, 1e-12 * values.max())), vectors


def _physical(cvxpy, arm: SerialArm):
    """Unknowns in units of `_scales`, the bodies, and the constraints that they are physical."""
    unknown = cvxpy.Variable(10 * arm.joints)
    matter = [
        pseudo_inertia(cvxpy, unknown[10 * k : 10 * (k + 1)]) >> _LEAST * np.eye(4)
        for k in range(arm.joints)
    ]
    return unknown, cvxpy.multiply(_scales(arm).ravel(), unknown), matter


def _distances(
    cvxpy, arm: SerialArm, whiten: Float[np.ndarray, "base base"], bodies, matter
) -> Callable[[Float[np.ndarray, " base"]], float]:
    """The function from base parameters to their distance from physical bodies, in deviations."""
    size = float(np.linalg.norm(whiten @ np.asarray(arm.base)))
    target = cvxpy.Parameter(len(whiten))
    away = (whiten @ np.asarray(arm.combined) / size) @ bodies - target
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.norm(away)), matter)

    def distance(base: Float[np.ndarray, " base"]) -> float:
        target.value = whiten @ base / size
        _solve(cvxpy, problem)
        found = size * float(np.linalg.norm(np.asarray(away.value)))
        return found if found > _THERE else 0.0

    return distance


def smallest_eigenvalues(bodies: Float[np.ndarray, "joints 10"]) -> Float[np.ndarray, " joints"]:
    """Smallest eigenvalue of each body's pseudo-inertia; above zero if the body is physical."""
    return np.array([np.linalg.eigvalsh(pseudo_inertia(np, body))[0] for body in bodies])


def pseudo_inertia(library, body):
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
    """Scales of each link's parameters: those of a ball of its mass and the size of the links."""
    drawn = np.asarray(arm.bodies)
    mass = np.maximum(drawn[:, 9], 0.05 * drawn[:, 9].max())
    moment = np.linalg.norm(drawn[:, 6:9], axis=1)
    length = np.maximum(moment / mass, 0.05)[:, None]
    powers = np.array([2] * 6 + [1] * 3 + [0])
    return mass[:, None] * length**powers


def _solved(cvxpy, objective, constraints) -> None:
    _solve(cvxpy, cvxpy.Problem(cvxpy.Minimize(objective), constraints))


def _solve(cvxpy, problem) -> None:
    try:
        problem.solve(solver="CLARABEL")
    except cvxpy.SolverError as error:
        raise ModelError(
            f"no physical bodies were found ({error}): fit other recordings"
        ) from error
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise ModelError(
            f"no physical bodies were found ({problem.status}): fit recordings with more motion"
        )
