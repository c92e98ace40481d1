"""What cables and hoses along an arm do: they pull on several joints."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion
from ._scene import Scene


class CableDrag(AbstractEffect):
    """A bundle of cables past two joints: each pulls on one as the other turns.

    It is clamped before joint i and behind joint j, and bends with both. To the second order of the
    angles its elastic energy has a term k q_i q_j + t_i q_i + t_j q_j, so that what joint j does to
    joint i, joint i does to joint j. What it does to each alone is a `Spring`.

    **Arguments:**

    - `joint`: the first that it passes, i. `following`: the second, j.
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
        """Neighbours that turn, of arms in space."""
        if scene.planar:
            return []
        turning = [not slides for slides in scene.slides]
        pairs = [j for j in scene.joints if j < len(turning) and turning[j - 1] and turning[j]]
        return [cls(joint=j, following=j + 1) for j in pairs]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """What the bundle asks of both joints, `(joints,)`."""
        i, j = self.joint - 1, self.following - 1
        first = self.shared * motion.q[j] + self.preload
        second = self.shared * motion.q[i] + self.other_preload
        return jnp.zeros_like(motion.v).at[i].set(first).at[j].set(second)
