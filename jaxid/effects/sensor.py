"""Sensor errors."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect


class EncoderEccentricity(AbstractEffect):
    """Eccentric encoder disc: q is read as q + A sin q + B cos q."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    A: Scalar = parameter(0.0, symbol="EA", unit="rad", scale=0.01)
    B: Scalar = parameter(0.0, symbol="EB", unit="rad", scale=0.01)

    def read(self, q: Float[Array, " joints"]) -> Float[Array, " joints"]:
        """The reading, `(joints,)`."""
        angle = q[self.joint - 1]
        return q.at[self.joint - 1].add(self.A * jnp.sin(angle) + self.B * jnp.cos(angle))
