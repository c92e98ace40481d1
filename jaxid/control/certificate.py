"""Stability of computed torque on an uncertain model, by a linear matrix inequality.

Appendix B of Li, Peng and Juang 2023.
"""

import itertools
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..compiling import compiled
from ..errors import ModelError, require
from ..parameters import list_parameters, read_values, write_values
from .computed_torque import Body, ComputedTorque

# Margin for points between those for which the bound was computed.
_MARGIN = 1.02


class MassError(eqx.Module):
    """A bound on the mass-matrix error M~ = M⁻¹ (M - M̂): M~ M~' ⪯ mu, `(joints, joints)`.

    `worst` is the largest singular value of M~ found, `points` the number of points examined.
    """

    mu: Float[np.ndarray, "joints joints"]
    worst: float = eqx.field(static=True)
    points: int = eqx.field(static=True)


def _box(
    arm: Body, spread: float | Mapping[str, tuple[float, float]]
) -> tuple[list, Float[np.ndarray, " parameters"], Float[np.ndarray, " parameters"]]:
    """The arm's parameters that its mass matrix depends on, and their lowest and highest values."""
    parameters = list(list_parameters(arm))
    if isinstance(spread, Mapping):
        names = [p.name for p in parameters]
        for name, (low, high) in spread.items():
            if name not in names:
                raise ModelError(
                    f"there is no parameter {name!r} in this arm: it has {', '.join(names)}"
                )
            if not low <= high:
                raise ModelError(f"{name} is between {low:g} and {high:g}: exchange the two")
        chosen = [p for p in parameters if p.name in spread]
        low, high = (np.array([spread[p.name][k] for p in chosen], float) for k in (0, 1))
        return chosen, low, high
    if not 0 <= spread < 1:
        raise ModelError(f"spread is {spread:g}: give a share of the parameters, 0.2 for 20 %")
    values = np.asarray(read_values(arm, parameters))
    reach = np.abs(values) * spread
    return parameters, values - reach, values + reach


def mass_error(
    model: Body,
    workspace: Float[np.ndarray, "points joints"],
    spread: float | Mapping[str, tuple[float, float]] = 0.2,
    *,
    draws: int = 4000,
    seed: int = 0,
) -> MassError:
    """The mass-matrix error over the workspace, for arms whose parameters lie in a box.

    It is computed in every corner of the box and at random points inside, at all poses. The bound
    is the mu of smallest trace above all of these, plus 2 % for points between them.

    **Arguments:**

    - `model`: the arm as the controller models it, a module with declared parameters.
    - `workspace`: poses, `(points, joints)`; for instance `arm.workspace()`.
    - `spread`: share of each parameter by which the true one may differ, or its lowest and highest
      value by name.
    - `draws`: points inside the box. `seed`: of these.

    **Raises:** `ModelError` for a box in which the mass matrix is not positive definite;
        `MissingExtraError` without the extra `sdp`.
    """
    chosen, low, high = _box(model, spread)
    rng = np.random.default_rng(seed)

    def mass(values, q):
        return write_values(model, chosen, values).mass_matrix(q)

    slope = jax.jacfwd(mass)(jnp.asarray(low), jnp.asarray(workspace[0]))
    matters = np.asarray(jnp.any(slope != 0, axis=(0, 1)))
    corners = np.array(list(itertools.product(*[(0.0, 1.0) if m else (0.5,) for m in matters])))
    if len(corners) > 1024:
        corners = rng.integers(0, 2, (1024, len(low))).astype(float)
    inside = rng.uniform(size=(draws, len(low)))
    poses = np.asarray(workspace)
    shares = np.concatenate([np.repeat(corners, len(poses), axis=0), inside])
    drawn = poses[rng.integers(len(poses), size=draws)]
    at = np.concatenate([np.tile(poses, (len(corners), 1)), drawn])
    values = jnp.asarray(low + shares * (high - low))
    true = np.asarray(compiled(jax.vmap(mass))(values, jnp.asarray(at)))
    taken = np.asarray(compiled(jax.vmap(model.mass_matrix))(jnp.asarray(at)))
    if np.linalg.eigvalsh(true).min() <= 0:
        raise ModelError(
            "the mass matrix is not positive definite everywhere in this box of parameters: "
            "make spread smaller"
        )
    error = np.eye(true.shape[1]) - np.linalg.solve(true, taken)
    squares = error @ np.swapaxes(error, 1, 2)
    worst = float(np.sqrt(np.linalg.eigvalsh(squares).max()))
    return MassError(_MARGIN**2 * _smallest_above(squares, rng), worst, len(squares))


def _smallest_above(
    squares: Float[np.ndarray, "points n n"], rng: np.random.Generator
) -> Float[np.ndarray, "n n"]:
    """The matrix of least trace above all of these, computed from the extreme ones."""
    cvxpy = require("cvxpy", "sdp")
    require("clarabel", "sdp")
    n = squares.shape[1]
    directions = rng.normal(size=(64, n))
    sizes = np.einsum("di,kij,dj->dk", directions, squares, directions, optimize=True)
    extreme = np.unique(np.argmax(sizes, axis=1))
    mu = cvxpy.Variable((n, n), symmetric=True)
    problem = cvxpy.Problem(
        cvxpy.Minimize(cvxpy.trace(mu)), [mu - squares[k] >> 0 for k in extreme]
    )
    problem.solve(solver=cvxpy.CLARABEL)
    found = np.asarray(mu.value)
    floor = 1e-9 * np.eye(n)
    # Scaled up to include points that are outside by the program's tolerance.
    half = np.linalg.cholesky(found + floor)
    passed = np.linalg.solve(half, np.swapaxes(np.linalg.solve(half, squares), 1, 2))
    return max(1.0, float(np.linalg.eigvalsh(passed).max())) * (found + floor)


class Certificate(eqx.Module):
    """Result of a stability proof, with its certificate.

    The error dynamics x' = (A + B M~ K) x, x = (∫e, e, e') or (e, e') without integral gain, obey
    A'P + PA + epsilon P B mu B' P + K'K / epsilon + Q = 0 with P, Q positive definite, so that
    x'Px decreases for every M~ with M~ M~' ⪯ mu. The proof does not cover sampling. Disturbances
    cause errors in proportion to their size.

    - `certified`: whether stability is proved; False does not prove instability.
    - `reason`: a sentence.
    - `P`, `Q`, `epsilon`: the certificate, None if there is none. `mu`: the bound.
    """

    certified: bool = eqx.field(static=True)
    reason: str = eqx.field(static=True)
    mu: Float[np.ndarray, "joints joints"]
    P: Float[np.ndarray, "states states"] | None = None
    Q: Float[np.ndarray, "states states"] | None = None
    epsilon: float | None = None

    def __repr__(self) -> str:
        return f"{'certified' if self.certified else 'not certified'}: {self.reason}"


def error_dynamics(
    law: ComputedTorque,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, K of the tracking error under computed torque, equation (64)."""
    gains = [np.diag(np.asarray(k, float)) for k in (law.Ki, law.Kp, law.Kd)]
    if not np.any(gains[0]):
        gains = gains[1:]
    n, order = len(gains[0]), len(gains)
    K = np.concatenate(gains, axis=1)
    B = np.concatenate([np.zeros((n * (order - 1), n)), np.eye(n)])
    A = np.eye(n * order, k=n) - B @ K
    return A, B, K


def certify(law: ComputedTorque, error: MassError) -> Certificate:
    """Decides whether the closed loop provably stays stable (Appendix B).

    **Arguments:**

    - `law`: the law with the gains to examine.
    - `error`: bound on the mass-matrix error, from `mass_error`.

    **Raises:** `MissingExtraError` without the extra `sdp`.
    """
    A, B, K = error_dynamics(law)
    n = B.shape[1]
    if error.mu.shape != (n, n):
        raise ModelError(
            f"the bound is for {len(error.mu)} joints, but the gains are for {n}: compute it for "
            "the controller's own model"
        )
    slowest = np.linalg.eigvals(A).real.max()
    if slowest >= 0:
        return Certificate(
            False, "these gains are unstable even on the exact model: raise Kd or Kp", error.mu
        )
    # In units of the loop's time constant all numbers are of order one.
    order = len(A) // n
    w = float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(A))))))
    scale = np.repeat(w ** -np.arange(order, dtype=float), n)
    found = _solve(A * scale[:, None] / scale / w, B, K / scale / w**order, error.mu)
    if found is not None:
        p, epsilon = found
        P, epsilon = p * np.outer(scale, scale), epsilon * w ** (2 * order - 1)
        Q = _left(law, error.mu, P, epsilon)
        if positive(P / np.outer(scale, scale)) and positive(Q / np.outer(scale, scale)):
            reason = f"the error falls for every mass error within the bound ({error.worst:.3g})"
            return Certificate(True, reason, error.mu, P, Q, epsilon)
    return Certificate(
        False,
        f"no quadratic function proves stability for mass errors up to {error.worst:.3g}: "
        "raise the damping, or narrow the bound",
        error.mu,
    )


def _left(
    law: ComputedTorque,
    mu: Float[np.ndarray, "joints joints"],
    P: Float[np.ndarray, "states states"],
    epsilon: float,
) -> Float[np.ndarray, "states states"]:
    """The matrix Q that the inequality leaves, symmetric."""
    A, B, K = error_dynamics(law)
    Q = -(A.T @ P + P @ A + epsilon * P @ B @ mu @ B.T @ P + K.T @ K / epsilon)
    return (Q + Q.T) / 2


def positive(matrix: Float[np.ndarray, "n n"]) -> bool:
    """Whether a symmetric matrix is positive definite by more than rounding."""
    values = np.linalg.eigvalsh(matrix)
    return bool(values[0] > 1e-12 * abs(values[-1]))


def holds(certificate: Certificate, law: ComputedTorque) -> bool:
    """Checks a certificate by eigenvalues alone, without relying on the solver.

    **Arguments:**

    - `certificate`: from `certify`. `law`: with the gains it was given for.
    """
    c = certificate
    if not c.certified or c.P is None or c.Q is None or c.epsilon is None or c.epsilon <= 0:
        return False
    # Balanced, because with states of different units a small eigenvalue is lost in rounding.
    size = np.sqrt(np.diag(c.P))
    exact = bool(np.abs(_left(law, c.mu, c.P, c.epsilon) - c.Q).max() <= 1e-9 * np.abs(c.Q).max())
    return exact and all(positive(x / np.outer(size, size)) for x in (c.P, c.Q))


def _solve(
    A: np.ndarray, B: np.ndarray, K: np.ndarray, mu: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """P and epsilon of the inequality (107), with the smallest eigenvalue of Q maximised."""
    import scipy

    cvxpy = require("cvxpy", "sdp")
    require("clarabel", "sdp")
    size, n = B.shape
    P = cvxpy.Variable((size, size), symmetric=True)
    room, share = cvxpy.Variable(), cvxpy.Variable()
    half = np.real(scipy.linalg.sqrtm(mu))
    corner = P @ B @ half
    upper = A.T @ P + P @ A + share * (K.T @ K) + room * np.eye(size)
    block = cvxpy.bmat([[-upper, -corner], [-corner.T, share * np.eye(n)]])
    symmetric = (block + block.T) / 2
    constraints = [symmetric >> 0, P >> 1e-6 * np.eye(size), cvxpy.trace(P) <= size]
    problem = cvxpy.Problem(cvxpy.Maximize(room), constraints)
    try:
        problem.solve(solver=cvxpy.CLARABEL)
    except cvxpy.error.SolverError:
        return None
    if P.value is None or room.value is None or room.value <= 1e-9 or share.value <= 0:
        return None
    return (P.value + P.value.T) / 2, 1 / float(share.value)
