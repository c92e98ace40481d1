"""What every arm gives: its equations of motion, in base parameters."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class AbstractArm(eqx.Module):
    """Rigid bodies: `tau = mass_matrix(q) a + bias(q, v)`, linear in the base parameters.

    Friction is not here: it is an effect like any other.
    """

    @property
    @abc.abstractmethod
    def joints(self) -> int:
        """How many joints it has."""

    @abc.abstractmethod
    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """Inertia at q, `(joints, joints)`, kg·m² or kg."""

    @abc.abstractmethod
    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Coriolis, centrifugal and gravity torque, `(joints,)`, N·m or N."""

    @abc.abstractmethod
    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Derivative of the torque by the base parameters, in the order of the fields."""

    def prismatic(self) -> tuple[bool, ...]:
        """Which joints slide, one a joint; the others turn."""
        return (False,) * self.joints

    def link_lengths(self) -> tuple[float, ...]:
        """Lengths of the links before the last, m; what a payload's torque needs."""
        return ()

    def first_moments(self) -> tuple[tuple[float, float] | None, ...]:
        """First moments (MX, MY) of each link in its own frame, kg·m; None where not known."""
        return (None,) * self.joints

    def gravity(self) -> float:
        """Gravity in the plane of motion, m/s²."""
        return 0.0

    def units(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Units of torque and of position, one a joint each."""
        slides = self.prismatic()
        return (
            tuple("N" if slide else "N·m" for slide in slides),
            tuple("m" if slide else "rad" for slide in slides),
        )

    def workspace(self) -> Float[np.ndarray, "points joints"]:
        """Positions over which the mass matrix must be positive definite, `(points, joints)`."""
        turn = np.linspace(-np.pi, np.pi, 25)
        if self.joints == 1:
            return turn[:, None]
        return np.stack([np.zeros((25, self.joints - 1)).T[0], turn], axis=1)

    def smallest_inertia(self) -> Float[Array, ""]:
        """Smallest eigenvalue of the mass matrix over the workspace; above zero when physical."""
        matrices = jax.vmap(self.mass_matrix)(jnp.asarray(self.workspace()))
        return jnp.min(jnp.linalg.eigvalsh(matrices))
