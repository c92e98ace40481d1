"""Two links under gravity: the manipulator of Li, Peng and Juang, and double pendulums."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..errors import ModelError
from ..parameters import Scalar, parameter
from ._base import AbstractArm, Split


class TwoLink(AbstractArm):
    """Two links in a vertical plane (Li, Peng, Juang 2023).

    `q[0]` is the first link's angle from hanging down, `q[1]` the second's relative to the first,
    in rad. `p3` is the product of the first link's length and the second's first moment. With
    `link_length` (m), p3 = link_length · p5 is not a parameter.
    """

    p1: Scalar = parameter(0.1, symbol="p1", unit="kg·m²", lower=0.0, scale=0.1)
    p2: Scalar = parameter(0.05, symbol="p2", unit="kg·m²", lower=0.0, scale=0.05)
    p4: Scalar = parameter(0.3, symbol="p4", unit="kg·m", scale=0.3)
    p5: Scalar = parameter(0.1, symbol="p5", unit="kg·m", scale=0.1)
    p3: Scalar | None = parameter(None, symbol="p3", unit="kg·m²", scale=0.05)
    link_length: float | None = eqx.field(static=True, default=None)
    g: float = eqx.field(static=True, default=9.81)

    def __post_init__(self):
        if self.p3 is None and self.link_length is None:
            # Corresponds to links of a quarter metre; only a start value.
            self.p3 = 0.25 * self.p5
        elif self.p3 is not None and self.link_length is not None:
            raise ModelError(
                "TwoLink has both p3 and link_length: give one, because p3 = link_length · p5"
            )

    @property
    def joints(self) -> int:
        """Two joints."""
        return 2

    @property
    def coupling(self) -> Scalar:
        """p3 as given, or from the link's length, kg·m²."""
        if self.p3 is not None:
            return self.p3
        assert self.link_length is not None
        return self.link_length * self.p5

    def link_lengths(self) -> tuple[float, ...]:
        """Length of the first link as given, or p3 / p5, m."""
        return (self.link_length or float(self.coupling / self.p5),)

    def first_moments(self) -> tuple[tuple[float, float] | None, ...]:
        """First moments of both links, kg·m."""
        return (float(self.p4), 0.0), (float(self.p5), 0.0)

    def gravity(self) -> float:
        """Gravity as given, m/s²."""
        return self.g

    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """Inertia at q, `(2, 2)`, kg·m²."""
        c = self.coupling * jnp.cos(q[1])
        off = self.p2 + c
        return jnp.stack([jnp.stack([self.p1 + self.p2 + 2 * c, off]), jnp.stack([off, self.p2])])

    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Coriolis, centrifugal and gravity torque, `(2,)`, N·m."""
        s = self.coupling * jnp.sin(q[1])
        outer = self.g * self.p5 * jnp.sin(q[0] + q[1])
        return jnp.stack(
            [
                -s * v[1] * (2 * v[0] + v[1]) + self.g * self.p4 * jnp.sin(q[0]) + outer,
                s * v[0] ** 2 + outer,
            ]
        )

    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Torque by (p1, p2, p4, p5[, p3]), `(2, 4)` with a known link length, else `(2, 5)`."""
        c, s = jnp.cos(q[1]), jnp.sin(q[1])
        zero = jnp.zeros_like(a[0])
        outer = self.g * jnp.sin(q[0] + q[1])
        coupled = jnp.stack(
            [
                (2 * a[0] + a[1]) * c - v[1] * (2 * v[0] + v[1]) * s,
                a[0] * c + v[0] ** 2 * s,
            ]
        )
        columns = [
            jnp.stack([a[0], zero]),
            jnp.stack([a[0] + a[1], a[0] + a[1]]),
            jnp.stack([self.g * jnp.sin(q[0]), zero]),
            jnp.stack([outer, outer]),
        ]
        if self.p3 is None:
            assert self.link_length is not None
            columns[3] = columns[3] + self.link_length * coupled
        else:
            columns.append(coupled)
        return jnp.stack(columns, axis=1)

    def split(self, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> Split:
        """The regressor in parts that need no acceleration, by (p1, p2, p4, p5[, p3])."""
        c, s = jnp.cos(q[1]), jnp.sin(q[1])
        zero, both = jnp.zeros_like(c), q[0] + q[1]
        outer = self.g * jnp.sin(both)
        nothing = jnp.zeros((2, 4))
        second = jnp.array([[q[0], both, zero, zero], [zero, both, zero, zero]])
        zeroth = jnp.array([[zero, zero, self.g * jnp.sin(q[0]), outer], [zero] * 3 + [outer]])
        momentum = jnp.stack([(2 * v[0] + v[1]) * c, v[0] * c])
        swing = jnp.stack([zero, v[0] * (v[0] + v[1]) * s])
        if self.p3 is None:
            assert self.link_length is not None
            first = nothing.at[:, 3].set(self.link_length * momentum)
            return Split(second, first, zeroth.at[:, 3].add(self.link_length * swing))
        return Split(
            jnp.pad(second, ((0, 0), (0, 1))),
            jnp.concatenate([nothing, momentum[:, None]], axis=1),
            jnp.concatenate([zeroth, swing[:, None]], axis=1),
        )
