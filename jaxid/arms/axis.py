"""One axis: a drive that moves a mass along a line."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractArm, Split


class Axis(AbstractArm):
    """One prismatic joint (EMPS: Janot, Gautier, Brunot 2019). Position in m, force in N."""

    M: Scalar = parameter(100.0, symbol="M", unit="kg", lower=0.0, scale=100.0)

    @property
    def joints(self) -> int:
        """One joint."""
        return 1

    def prismatic(self) -> tuple[bool, ...]:
        """The joint slides."""
        return (True,)

    def workspace(self) -> Float[np.ndarray, "points joints"]:
        """One position: the inertia does not depend on it."""
        return np.zeros((1, 1))

    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """The mass, `(1, 1)`, kg."""
        return self.M[None, None]

    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Zero, `(1,)`, N."""
        return jnp.zeros_like(q)

    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Force by M, `(1, 1)`."""
        return a[:, None]

    def split(self, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> Split:
        """M a = d²/dt² (M q)."""
        zero = jnp.zeros((1, 1))
        return Split(q[:, None], zero, zero)
