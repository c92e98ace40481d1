"""Base class of arms: equations of motion in base parameters."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import InSpace
from ..linear_algebra import smallest_eigenvalue
from ..parameters import list_parameters, read_values, write_values


class Split(eqx.Module):
    """A regressor without accelerations: d²/dt² `second` + d/dt `first` + `zeroth`.

    Each is `(joints, parameters)`. `second` depends on positions only, the others depend on
    positions and velocities (Li, Peng, Juang 2023).
    """

    second: Float[Array, "joints parameters"]
    first: Float[Array, "joints parameters"]
    zeroth: Float[Array, "joints parameters"]


class AbstractArm(eqx.Module):
    """Rigid bodies: `tau = mass_matrix(q) a + bias(q, v)`, linear in the base parameters.

    Friction is not part of an arm: it is an effect.
    """

    @property
    @abc.abstractmethod
    def joints(self) -> int:
        """Number of joints."""

    @abc.abstractmethod
    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """Inertia at q, `(joints, joints)`, kg·m² or kg."""

    @abc.abstractmethod
    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Coriolis, centrifugal and gravity torque, `(joints,)`, N·m or N."""

    def inverse(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Torque needed for a motion (inverse dynamics), `(joints,)`, N·m or N."""
        return self.mass_matrix(q) @ a + self.bias(q, v)

    def inverse_slopes(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> tuple[Float[Array, "joints joints"], Float[Array, "joints joints"]]:
        """Derivatives of `inverse` by position and velocity, a row for each torque, SI units."""
        return jax.jacfwd(lambda q, v: self.inverse(q, v, a), argnums=(0, 1))(q, v)

    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Derivative of the torque with respect to the base parameters, in the order of the fields.

        **Arguments:**

        - `q`, `v`, `a`: position, velocity and acceleration, `(joints,)`, rad or m and per s.
        """
        parameters = list_parameters(self)

        def torque(values):
            arm = write_values(self, parameters, values)
            return arm.inverse(q, v, a)

        return jax.jacfwd(torque)(read_values(self, parameters))

    def split(self, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> Split:
        """The regressor in parts that need no acceleration.

        The default follows from Lagrange's equations and differentiates the momentum once. An arm
        whose momentum contains the rate of a function of position overrides this.

        **Arguments:**

        - `q`, `v`: position and velocity, `(joints,)`, rad or m and per s.
        """
        parameters = list_parameters(self)

        def momentum(values):
            return write_values(self, parameters, values).mass_matrix(q) @ v

        def rest(values):
            arm = write_values(self, parameters, values)
            kinetic = jax.grad(lambda at: 0.5 * v @ arm.mass_matrix(at) @ v)(q)
            return arm.bias(q, jnp.zeros_like(v)) - kinetic

        values = read_values(self, parameters)
        first, zeroth = jax.jacfwd(momentum)(values), jax.jacfwd(rest)(values)
        return Split(jnp.zeros_like(first), first, zeroth)

    def expected(
        self,
    ) -> tuple[Float[Array, " parameters"], Float[Array, "parameters parameters"]] | None:
        """Its parameters before any recording, and their covariance; None if nothing is known."""
        return None

    def prismatic(self) -> tuple[bool, ...]:
        """Whether each joint slides (prismatic); otherwise it turns."""
        return (False,) * self.joints

    def planar(self) -> bool:
        """Whether links move in one plane, link angles being sums of joint angles."""
        return True

    def in_space(self) -> InSpace | None:
        """Its joints and bodies in space, None if not known.

        They allow effects on spatial arms: a base that is not level, and payloads.
        """
        return None

    def couplings(self) -> tuple[tuple[int, int, float], ...]:
        """Pairs of joints that may share a shaft, and its turns per turn of the first joint."""
        return ()

    def link_lengths(self) -> tuple[float, ...]:
        """Lengths of all links but the last, m; without them payloads are not considered."""
        return ()

    def first_moments(self) -> tuple[tuple[float, float] | None, ...]:
        """First moments (MX, MY) of each link in its own frame, kg·m; None if not known."""
        return (None,) * self.joints

    def gravity(self) -> float:
        """Gravity in the plane of motion, m/s²."""
        return 0.0

    def units(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Units of torque and of position, one for each joint."""
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
        if self.joints == 2:
            return np.stack([np.zeros(25), turn], axis=1)
        # A grid over many joints would be too large; the first joint's position does not matter.
        drawn = np.random.default_rng(0).uniform(-np.pi, np.pi, (25 * self.joints, self.joints))
        return drawn * (np.arange(self.joints) > 0)

    def smallest_inertia(self) -> Float[Array, ""]:
        """Smallest eigenvalue of the mass matrix over the workspace; above zero if physical."""

        def at(q: Float[Array, " joints"]) -> Float[Array, ""]:
            return smallest_eigenvalue(self.mass_matrix(q))

        return jnp.min(jax.vmap(at)(jnp.asarray(self.workspace())))
