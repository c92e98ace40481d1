"""Friction in a gear that is loaded from both sides."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion, on_joint, smooth_sign
from ._scene import Scene
from .friction import sign_form, smoothing_speed


class GearFriction(AbstractEffect):
    """Load-dependent friction: (|Km tau + Ke load| + S (Fs + |Kms tau + Kes load|)) sigma(v).

    S = exp(-|v/vs|^power), tau is the torque of the drive minus other friction, and load is the
    torque that the links need without accelerating, such as gravity (Duclusaud, Passault, Padois,
    Ly 2025, whose tau_e is -load). Unlike `LoadDependentFriction`, it also acts if the load drives
    the gear back while the drive gives no torque.

    **Fields:**

    - `drive`, `back`: Km and Ke; `back` is None if one ratio holds for both.
    - `slow`, `slow_back`, `level`: Kms, Kes (None for Kms) and Fs.
    - `velocity`, `power`: vs and the power in S. If `velocity` is None, there is no S, and its
      fields are not used.
    """

    joint_fields = ("joint",)
    loaded = True
    # Where friction holds an arm under load, its slope at nothing tells a fraction of what it does.
    finite = True
    joint: int = eqx.field(static=True)
    drive: Scalar = parameter(0.0, symbol="Km", unit="1", lower=0.0, upper=0.9, scale=0.1)
    back: Scalar | None = parameter(None, symbol="Ke", unit="1", lower=0.0, upper=0.9, scale=0.1)
    slow: Scalar | None = parameter(None, symbol="Kms", unit="1", lower=0.0, upper=0.9, scale=0.1)
    slow_back: Scalar | None = parameter(
        None, symbol="Kes", unit="1", lower=0.0, upper=0.9, scale=0.1
    )
    level: Scalar | None = parameter(None, symbol="Fs", unit="N·m", lower=0.0, scale=0.1)
    velocity: Scalar | None = parameter(
        None, symbol="vs", unit="rad/s", lower=1e-4, scale=0.1, linear=False
    )
    power: Scalar = parameter(
        2.0, symbol="power", unit="1", lower=0.1, upper=4.0, scale=1.0, free=False, linear=False
    )
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["GearFriction"]:
        """Some ratios for both sides, and one that is twice as high below some velocities."""
        made = []
        for j in scene.joints:
            own = {"joint": j, **scene.sign(j)}
            made += [cls(drive=ratio, **own) for ratio in (0.05, 0.1, 0.2)]
            made += [
                cls(drive=0.1, slow=0.1, velocity=share * scene.speed[j - 1], **own)
                for share in (0.02, 0.1, 0.5)
            ]
        return made

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The friction on the joint, `(joints,)`."""
        j = self.joint - 1
        assert motion.load is not None
        tau, load, v = motion.tau[j], motion.load[j], motion.v[j]

        def of(drive: Scalar, back: Scalar | None) -> Float[Array, ""]:
            both = drive * tau + (drive if back is None else back) * load
            # At no friction its size has no slope by itself: that of two equal ratios.
            return both * jnp.sign(jnp.where(both == 0, tau + load, both))

        level = of(self.drive, self.back)
        if self.velocity is not None:
            # Kept away from zero, where a power below one has no finite slope.
            speed = jnp.sqrt(v**2 + 1e-12) / self.velocity
            peak = 0.0 if self.level is None else self.level
            peak = peak if self.slow is None else peak + of(self.slow, self.slow_back)
            level = level + jnp.exp(-(speed**self.power)) * peak
        return on_joint(self.joint, level * smooth_sign(v, self.smoothing, self.form), motion)
