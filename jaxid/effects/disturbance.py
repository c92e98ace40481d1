"""Periodic torque from outside the robot."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion, on_joint
from ._scene import Scene


class PeriodicDisturbance(AbstractEffect):
    """A torque at one unknown frequency: A cos(2 pi f t) + B sin(2 pi f t)."""

    joint_fields = ("joint",)
    several = 2
    joint: int = eqx.field(static=True)
    A: Scalar = parameter(0.0, symbol="DA", unit="N·m", scale=0.1)
    B: Scalar = parameter(0.0, symbol="DB", unit="N·m", scale=0.1)
    frequency: Scalar = parameter(1.0, symbol="f", unit="Hz", lower=1e-3, scale=0.01, linear=False)
    on_link = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["PeriodicDisturbance"]:
        """Frequencies of peaks in the residual's spectrum, on each joint."""
        return [cls(joint=j, frequency=f) for j in scene.joints for f in scene.tones[j - 1]]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The wave on the joint, `(joints,)`."""
        angle = 2 * jnp.pi * self.frequency * motion.t
        wave = self.A * jnp.cos(angle) + self.B * jnp.sin(angle)
        return on_joint(self.joint, wave, motion)
