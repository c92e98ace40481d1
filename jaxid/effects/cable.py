"""Effects of cables and hoses along an arm, which pull on several joints."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion
from ._scene import Scene


class CableDrag(AbstractEffect):
    """A bundle of cables past two joints, which couples them elastically.

    It is clamped before joint i and behind joint j, and bends with both. To second order in the
    angles its elastic energy has a term k q_i q_j + t_i q_i + t_j q_j, so the coupling is
    symmetric in i and j. Its effect on each joint alone is a `Spring`.

    **Arguments:**

    - `joint`: the first joint that it passes, i. `following`: the second, j.
    - `shared`: k, N·m/rad. `preload`, `other_preload`: t_i and t_j, N·m.
    """

    joint_fields = ("joint", "following")
    joint: int = eqx.field(static=True)
    following: int = eqx.field(static=True, default=2)
    shared: Scalar = parameter(0.0, symbol="kc", unit="N·m/rad", scale=0.1)
    preload: Scalar = parameter(0.0, symbol="tc", unit="N·m", scale=0.1)
    other_preload: Scalar = parameter(0.0, symbol="tcj", unit="N·m", scale=0.1)
    on_link = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["CableDrag"]:
        """Each pair of neighbouring turning joints, for spatial arms."""
        if scene.planar:
            return []
        turning = [not slides for slides in scene.slides]
        pairs = [j for j in scene.joints if j < len(turning) and turning[j - 1] and turning[j]]
        return [cls(joint=j, following=j + 1) for j in pairs]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque that the bundle requires of both joints, `(joints,)`."""
        i, j = self.joint - 1, self.following - 1
        first = self.shared * motion.q[j] + self.preload
        second = self.shared * motion.q[i] + self.other_preload
        return jnp.zeros_like(motion.v).at[i].set(first).at[j].set(second)
