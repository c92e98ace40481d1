"""J'J of a least-squares problem in which some unknowns belong to one recording each."""

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Float

from ...linear_algebra import solve

# Parameters, and the initial position and velocity of each recording. The latter has the shape
# `(0, 0)` if no initial states are estimated.
Unknowns = tuple[Float[Any, " parameters"], Float[Any, "started estimated"]]


class Arrow(lx.AbstractLinearOperator):
    """A symmetric positive semi-definite operator of arrow shape, on `Unknowns`.

    - `dense`: rows and columns of the parameters.
    - `blocks`: rows and columns of each recording's own unknowns.
    - `border`: rows of a recording's unknowns, columns of the parameters.
    """

    dense: Float[Any, "parameters parameters"]
    blocks: Float[Any, "started estimated estimated"]
    border: Float[Any, "started estimated parameters"]

    def mv(self, vector: Unknowns) -> Unknowns:
        """The product with a vector."""
        theta, start = vector
        down = jnp.einsum("rap,p->ra", self.border, theta)
        across = jnp.einsum("rap,ra->p", self.border, start)
        return self.dense @ theta + across, down + jnp.einsum("rab,rb->ra", self.blocks, start)

    def as_matrix(self) -> Float[Any, "size size"]:
        """The whole matrix, parameters first."""
        count, estimated, p = self.border.shape
        border = self.border.reshape(count * estimated, p)
        lower = jax.scipy.linalg.block_diag(*self.blocks) if count * estimated else border[:, :0]
        return jnp.block([[self.dense, border.T], [border, lower.reshape(len(border), -1)]])

    def transpose(self) -> "Arrow":
        """Itself."""
        return self

    def in_structure(self) -> tuple[jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
        """Shapes of its input."""
        count, estimated, p = self.border.shape
        kind = self.dense.dtype
        return jax.ShapeDtypeStruct((p,), kind), jax.ShapeDtypeStruct((count, estimated), kind)

    def out_structure(self) -> tuple[jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
        """Shapes of its output."""
        return self.in_structure()

    def diagonal(self) -> Unknowns:
        """Its diagonal, as unknowns."""
        return jnp.diag(self.dense), jnp.einsum("raa->ra", self.blocks)

    def damped(self, damping: Float[Any, ""], scales: Unknowns) -> "Arrow":
        """The operator with damping times the squared scales of the unknowns added to the diagonal.

        An unknown of zero scale does not affect the residual; one is added for it.
        """
        theta, start = (jnp.where(scale > 0, damping * scale, 1.0) for scale in scales)
        own = start[..., None] * jnp.eye(start.shape[-1])
        return Arrow(self.dense + jnp.diag(theta), self.blocks + own, self.border)

    def reduced(
        self, grad: Unknowns
    ) -> tuple[
        Float[Any, "parameters parameters"],
        Float[Any, " parameters"],
        Float[Any, "started estimated columns"],
    ]:
        """The system for the parameters after elimination of each recording's unknowns.

        **Arguments:**

        - `grad`: the right-hand side.

        **Returns:** matrix, right-hand side, and columns from which the eliminated unknowns follow:
        these are the last column minus the other columns times the parameters' solution.
        """
        theta, start = grad
        sides = jnp.concatenate([self.border, start[..., None]], axis=2)
        if not start.size:
            return self.dense, theta, sides
        inner = jax.vmap(solve)(self.blocks, sides)
        matrix = self.dense - jnp.einsum("rap,raq->pq", self.border, inner[..., :-1])
        return matrix, theta - jnp.einsum("rap,ra->p", self.border, inner[..., -1]), inner


def empty_arrow(unknowns: Unknowns) -> Arrow:
    """An operator of zeros for unknowns of these shapes."""
    (p,), (count, estimated) = (np.shape(part) for part in unknowns)
    shapes = (p, p), (count, estimated, estimated), (count, estimated, p)
    return Arrow(*(jnp.zeros(shape) for shape in shapes))


@lx.linearise.register(Arrow)
@lx.materialise.register(Arrow)
@lx.conj.register(Arrow)
def _(operator: Arrow) -> Arrow:
    return operator


@lx.diagonal.register(Arrow)
def _(operator: Arrow) -> Float[Any, " size"]:
    theta, start = operator.diagonal()
    return jnp.concatenate([theta, start.ravel()])


@lx.is_symmetric.register(Arrow)
@lx.is_positive_semidefinite.register(Arrow)
def _(operator: Arrow) -> bool:
    return True


@lx.is_diagonal.register(Arrow)
@lx.is_tridiagonal.register(Arrow)
@lx.has_unit_diagonal.register(Arrow)
@lx.is_lower_triangular.register(Arrow)
@lx.is_upper_triangular.register(Arrow)
@lx.is_negative_semidefinite.register(Arrow)
def _(operator: Arrow) -> bool:
    return False
