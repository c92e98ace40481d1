"""Friction that every model starts with: viscous and Coulomb."""

import equinox as eqx
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion, on_joint, smooth_sign


class Viscous(AbstractEffect):
    """Friction in proportion to speed: Fv v."""

    joint: int = eqx.field(static=True)
    coefficient: Scalar = parameter(0.0, symbol="Fv", unit="N·m·s/rad", lower=0.0, scale=0.05)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fv v on the joint, `(joints,)`."""
        return on_joint(self.joint, self.coefficient * motion.v[self.joint - 1], motion)


class Coulomb(AbstractEffect):
    """Dry friction, smoothed: Fc · 2/pi · arctan(gamma v)  (Brunot et al. 2016)."""

    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="Fc", unit="N·m", lower=0.0, scale=0.1)
    gamma: Scalar = parameter(
        100.0, symbol="gamma", unit="s/rad", lower=0.0, scale=100.0, free=False, linear=False
    )

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fc sigma(v) on the joint, `(joints,)`."""
        sign = smooth_sign(motion.v[self.joint - 1], self.gamma)
        return on_joint(self.joint, self.level * sign, motion)
