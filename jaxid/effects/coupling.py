"""Coupling of two joints by a shaft of the drive that turns with both."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, as_float64, parameter
from ._base import AbstractEffect, Motion, smooth_sign
from ._scene import Scene
from .friction import sign_form, smoothing_speed


class SharedShaft(AbstractEffect):
    """Friction and inertia of a shaft that turns with one joint and drives the next.

    The motor of a wrist's last joint often drives it through the previous joint, and turns with
    w = share v_i + v_j. Its friction Fv w + Fc sigma(w) and inertia I w' load both joints
    (as in FIGAROH's model of a Stäubli TX40).

    **Arguments:**

    - `joint`: the one that the shaft passes, i. `driven`: the one that it drives, j.
    - `share`: turns of the shaft per turn of joint i, divided by those per turn of joint j.
    """

    joint_fields = ("joint", "driven")
    optional = ("viscous",), ("coulomb",), ("inertia",)
    joint: int = eqx.field(static=True)
    driven: int = eqx.field(static=True, default=2)
    viscous: Scalar = parameter(0.0, symbol="Fvs", unit="N·m·s/rad", lower=0.0, scale=0.05)
    coulomb: Scalar = parameter(0.0, symbol="Fcs", unit="N·m", lower=0.0, scale=0.1)
    inertia: Scalar = parameter(0.0, symbol="Ias", unit="kg·m²", lower=0.0, scale=0.01)
    share: Scalar = eqx.field(converter=as_float64, default=1.0)
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()
    inertial = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["SharedShaft"]:
        """The pairs of joints that gears couple, or may couple."""
        return [
            cls(joint=i, driven=j, share=share, **scene.sign(j)) for i, j, share in scene.couplings
        ]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque of the shaft on both joints, `(joints,)`."""
        way = jnp.zeros_like(motion.v).at[self.joint - 1].set(self.share)
        way = way.at[self.driven - 1].add(1.0)
        speed, rate = way @ motion.v, way @ motion.a
        friction = self.viscous * speed + self.coulomb * smooth_sign(
            speed, self.smoothing, self.form
        )
        return way * (friction + self.inertia * rate)
