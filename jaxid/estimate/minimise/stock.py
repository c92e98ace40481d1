"""The problem in a form without bounds, for optimistix' own solvers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ...errors import FitError
from ...parameters import Bounds
from .arrow import Unknowns
from .problem import Problem, point_around, residual_at


def check_solver(solver: Any, mesh: Mesh | None) -> None:
    """Checks that an object can minimise a squared error.

    **Raises:** `FitError` for an object that is not a solver of optimistix, or with a mesh, which
    only jaxid's own solver supports.
    """
    if solver is None:
        return
    if not isinstance(solver, (optx.AbstractLeastSquaresSolver, optx.AbstractMinimiser)):
        raise FitError(
            f"{solver!r} is not a solver: give an optimistix solver for least squares or "
            "minimisation, such as optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8), or None"
        )
    if mesh is not None:
        raise FitError(
            f"{type(solver).__name__} cannot share recordings over the devices of a mesh: fit "
            "without solver, or without mesh"
        )


class Transformed(eqx.Module):
    """A problem in coordinates without bounds.

    Forward and reverse mode both use one Jacobian, computed by forward mode through the simulation.

    - `bounds`: maps coordinates to parameter values.
    - `start`: initial states that are not estimated.
    """

    problem: Problem
    bounds: Bounds
    start: Float[Array, "recordings initials"]

    @classmethod
    def of(cls, problem: Problem, start: Float[Any, "recordings initials"]) -> "Transformed":
        """The transformed problem, with given initial states."""
        scale = Bounds.of(problem.loop.free_parameters).scale
        # Coefficients of a noise filter have no bounds, and are of order one.
        scale = jnp.append(scale, jnp.ones(problem.lower.shape[0] - scale.shape[0]))
        bounds = Bounds(problem.lower, problem.upper, scale)
        return cls(problem, bounds, jnp.asarray(start))

    def outside(
        self, theta: Float[Array, " parameters"], start: Float[Array, "recordings initials"]
    ) -> Unknowns:
        """Coordinates of values; those on a bound are moved just inside."""
        theta, estimated = self.problem.unknowns(theta, start)
        return self.bounds.outside(theta), estimated

    def inside(
        self, z: Unknowns
    ) -> tuple[Float[Array, " parameters"], Float[Array, "recordings initials"]]:
        """Parameter values and all initial states at coordinates."""
        return self.bounds.inside(z[0]), z[1] if self.problem.free_start else self.start

    def residual(self, z: Unknowns, args: None) -> tuple[Float[Array, " rows"], None]:
        """The filtered residual, with the rows of a prior."""
        at, prior = self.inside(z), self.problem.prior
        rows = _residual(at, self.problem)
        return (rows if prior is None else jnp.append(rows, prior.left(at[0]))), None

    def loss(self, z: Unknowns, args: None) -> tuple[Float[Array, ""], None]:
        """Half the squared residual."""
        residual, _ = self.residual(z, args)
        return 0.5 * jnp.sum(residual**2), None


@eqx.filter_custom_jvp
def _residual(at: Unknowns, problem: Problem) -> Float[Array, " rows"]:
    return residual_at(problem, *at).ravel()


@_residual.def_jvp
def _residual_along(primals, tangents):
    (theta, start), problem = primals
    d_theta, d_start = tangents[0]
    found = point_around(problem, theta, start).found
    along = jnp.zeros_like(found.residual)
    if d_theta is not None:
        along = along + found.jacobian @ d_theta
    if found.start is not None and d_start is not None:
        free = found.start * problem.free[:, None, None, None]
        along = along + jnp.einsum("rkoa,ra->rko", free, d_start)
    return found.residual.ravel(), along.ravel()
