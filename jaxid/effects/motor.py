"""A motor that is driven by voltage."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion


class DCMotor(AbstractEffect):
    """Torque kt i of a commanded voltage u, with the current i = (u - kt v) / R, at most `limit`.

    The joint's command and the recorded torque of that joint are then voltages. All quantities
    refer to the joint: a motor of torque constant k behind a gear of ratio n has kt = n k. While
    the drive is off (`on` in the recording), no current flows and the motor does not brake.

    If the voltage is never off in a recording, R and viscous friction cannot be distinguished,
    except while the current is at its limit.
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    constant: Scalar = parameter(symbol="kt", unit="N·m/A", lower=1e-6, scale=0.1, linear=False)
    resistance: Scalar = parameter(symbol="R", unit="ohm", lower=1e-6, scale=1.0, linear=False)
    limit: Scalar = parameter(
        jnp.inf, symbol="imax", unit="A", lower=0.0, scale=1.0, free=False, linear=False
    )

    @classmethod
    def effect_name(cls) -> str:
        """Its name in tables."""
        return "dc_motor"

    @classmethod
    def spoken(cls) -> str:
        """Its name in a sentence."""
        return "DC motor"

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """The motor's torque on its joint, N·m or N, and the others' commands, `(joints,)`."""
        j = self.joint - 1
        current = (motion.tau[j] - self.constant * motion.v[j]) / self.resistance
        current = jnp.clip(current, -self.limit, self.limit)
        powered = motion.held["on"][j] if "on" in motion.held else 1.0
        return motion.tau.at[j].set(powered * self.constant * current)
