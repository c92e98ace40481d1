"""What every arm gives: its equations of motion, in base parameters."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linear_algebra import smallest_eigenvalue
from ..parameters import list_parameters, read_values, write_values


class Split(eqx.Module):
    """A regressor without accelerations: d²/dt² `second` + d/dt `first` + `zeroth`.

    Each is `(joints, parameters)`. `second` holds positions alone, the others positions and
    velocities (Li, Peng, Juang 2023).
    """

    second: Float[Array, "joints parameters"]
    first: Float[Array, "joints parameters"]
    zeroth: Float[Array, "joints parameters"]


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

    def inverse(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Torque that a motion takes, `(joints,)`, N·m or N."""
        return self.mass_matrix(q) @ a + self.bias(q, v)

    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Derivative of the torque by the base parameters, in the order of the fields.

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

        By default from Lagrange's equations: momentum is what is differentiated, once. An arm
        whose momentum has a part that is itself the rate of a position says so in its own.

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

    def prismatic(self) -> tuple[bool, ...]:
        """Which joints slide, one a joint; the others turn."""
        return (False,) * self.joints

    def planar(self) -> bool:
        """Whether its links move in one plane, their angles there the sums of the joints'."""
        return True

    def couplings(self) -> tuple[tuple[int, int, float], ...]:
        """Pairs of joints whose speeds some shaft may add, and its turns for one of the first."""
        return ()

    def link_lengths(self) -> tuple[float, ...]:
        """Lengths of the links before the last, m; without them no payload is looked for."""
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
        if self.joints == 2:
            return np.stack([np.zeros(25), turn], axis=1)
        # A lattice over many joints would be too many; how the first stands does not matter.
        drawn = np.random.default_rng(0).uniform(-np.pi, np.pi, (25 * self.joints, self.joints))
        return drawn * (np.arange(self.joints) > 0)

    def smallest_inertia(self) -> Float[Array, ""]:
        """Smallest eigenvalue of the mass matrix over the workspace; above zero when physical."""

        def at(q: Float[Array, " joints"]) -> Float[Array, ""]:
            return smallest_eigenvalue(self.mass_matrix(q))

        return jnp.min(jax.vmap(at)(jnp.asarray(self.workspace())))
