"""The SCARA prototype of Nantes: two parallel axes, no gravity."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractArm, Split


class SCARA(AbstractArm):
    """Two links that move in a horizontal plane (Gautier, Janot, Vandanjon 2013).

    `q[0]` is the first link's angle, `q[1]` the second's relative to the first, in rad.
    The default values are the CAD start of Brunot et al. 2016.
    """

    ZZ1r: Scalar = parameter(3.0, symbol="ZZ1r", unit="kg·m²", lower=0.0, scale=3.0)
    ZZ2: Scalar = parameter(0.5, symbol="ZZ2", unit="kg·m²", lower=0.0, scale=0.1)
    MX2: Scalar = parameter(0.0, symbol="MX2", unit="kg·m", scale=0.2)
    MY2: Scalar = parameter(0.0, symbol="MY2", unit="kg·m", scale=0.2)
    length: float = eqx.field(static=True, default=0.5)

    @property
    def joints(self) -> int:
        """Two joints."""
        return 2

    def link_lengths(self) -> tuple[float, ...]:
        """Length of the first link, m."""
        return (self.length,)

    def first_moments(self) -> tuple[tuple[float, float] | None, ...]:
        """First moment of the second link, kg·m; without gravity the first link's has no effect."""
        return None, (float(self.MX2), float(self.MY2))

    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """Inertia at q, `(2, 2)`, kg·m²."""
        coupling = self.length * (self.MX2 * jnp.cos(q[1]) - self.MY2 * jnp.sin(q[1]))
        off = self.ZZ2 + coupling
        return jnp.stack(
            [
                jnp.stack([self.ZZ1r + self.ZZ2 + 2 * coupling, off]),
                jnp.stack([off, self.ZZ2]),
            ]
        )

    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Coriolis and centrifugal torque, `(2,)`, N·m."""
        moment = self.length * (self.MX2 * jnp.sin(q[1]) + self.MY2 * jnp.cos(q[1]))
        return jnp.stack([-moment * v[1] * (2 * v[0] + v[1]), moment * v[0] ** 2])

    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Torque by (ZZ1r, ZZ2, MX2, MY2), `(2, 4)`."""
        c, s = jnp.cos(q[1]), jnp.sin(q[1])
        swing, cross = 2 * a[0] + a[1], v[1] * (2 * v[0] + v[1])
        zero = jnp.zeros_like(a[0])
        return jnp.stack(
            [
                jnp.stack(
                    [
                        a[0],
                        a[0] + a[1],
                        self.length * (swing * c - cross * s),
                        -self.length * (swing * s + cross * c),
                    ]
                ),
                jnp.stack(
                    [
                        zero,
                        a[0] + a[1],
                        self.length * (a[0] * c + v[0] ** 2 * s),
                        self.length * (v[0] ** 2 * c - a[0] * s),
                    ]
                ),
            ]
        )

    def split(self, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> Split:
        """The regressor in parts that need no acceleration, by (ZZ1r, ZZ2, MX2, MY2)."""
        c, s = self.length * jnp.cos(q[1]), self.length * jnp.sin(q[1])
        zero, both = jnp.zeros_like(c), q[0] + q[1]
        swing, turn = 2 * v[0] + v[1], v[0] * (v[0] + v[1])
        second = [[q[0], both, zero, zero], [zero, both, zero, zero]]
        first = [[zero, zero, swing * c, -swing * s], [zero, zero, v[0] * c, -v[0] * s]]
        zeroth = [[zero] * 4, [zero, zero, turn * s, turn * c]]
        return Split(jnp.array(second), jnp.array(first), jnp.array(zeroth))
