"""A constant torque: amplifier offset, a balance weight that is off."""

import equinox as eqx
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion, on_joint


class TorqueOffset(AbstractEffect):
    """A constant torque at one joint."""

    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="offset", unit="N·m", scale=0.1)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The offset on the joint, `(joints,)`."""
        return on_joint(self.joint, self.level, motion)
