"""Counterbalance: a cylinder or a spring between two links that carries weight."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion, on_joint
from ._scene import Scene


class Counterbalance(AbstractEffect):
    """A cylinder between two links: T sin(q - qc) / l, with l² = 1 + r² - 2 r cos(q - qc).

    A constant force between a point of the previous link and one of the joint's own link. The ratio
    of their distances from the axis is r (hydro-pneumatic balancers of large arms; Weigand et al.
    2021). The lever arm is zero at qc, where the points are nearest. r = 0 is a counterweight.

    **Arguments:**

    - `joint`: the joint on which it acts.
    - `level`: force times the shorter distance, N·m. `angle`: qc, rad. `ratio`: r, below one.
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="Tc", unit="N·m", scale=1.0)
    angle: Scalar = parameter(
        0.0, symbol="qc", unit="rad", lower=-2 * np.pi, upper=2 * np.pi, scale=0.3, linear=False
    )
    ratio: Scalar = parameter(
        0.25, symbol="rc", unit="1", lower=0.0, upper=0.95, scale=0.1, free=False, linear=False
    )
    on_link = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Counterbalance"]:
        """Turning joints of a spatial arm; angles over half a turn, because the sign is free."""
        if scene.planar:
            return []
        angles = np.arange(8) * np.pi / 8 - np.pi / 2
        return [
            cls(joint=j, angle=angle)
            for j in scene.joints
            if not scene.slides[j - 1]
            for angle in angles
        ]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The cylinder's torque about the joint, `(joints,)`."""
        turned = motion.q[self.joint - 1] - self.angle
        square = 1 + self.ratio**2 - 2 * self.ratio * jnp.cos(turned)
        return on_joint(self.joint, self.level * jnp.sin(turned) / jnp.sqrt(square), motion)
