"""Torque that depends on position: ripple, springs, end stops, gravity."""

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, Vector, as_float64, parameter
from ._base import AbstractEffect, Motion, on_joint
from ._scene import Scene

# Standard deviation of an offset before any recording, relative to the recorded torque.
_LIKELY = 0.1
# Largest share of the travel over which a stop acts; over more of it, it is a spring.
_SPRING = 0.75
# With fewer waves over the travel, ripple is not distinct from a spring. Those of an estimated
# ripple may be fewer than those that are screened.
_SCREENED, _FEWEST = 1.5, 1.25


class TorqueRipple(AbstractEffect):
    """Cogging and gear ripple: A cos(n q) + B sin(n q), n unknown."""

    joint_fields = ("joint",)
    # Three of them, of few waves over the travel, approximate any bump.
    several = 2
    joint: int = eqx.field(static=True)
    A: Scalar = parameter(0.0, symbol="RA", unit="N·m", scale=0.1)
    B: Scalar = parameter(0.0, symbol="RB", unit="N·m", scale=0.1)
    harmonic: Scalar = parameter(1.0, symbol="n", unit="1/rad", lower=1e-3, scale=5.0, linear=False)

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["TorqueRipple"]:
        """Harmonics up to thirty waves over the travel, a third of a wave apart."""
        return [
            cls(joint=j, harmonic=2 * np.pi * waves / scene.travel(j))
            for j in scene.joints
            for waves in np.arange(_SCREENED, 30.0, 1 / 3)
        ]

    def genuine(self, scene: Scene, beside: Sequence[AbstractEffect]) -> bool:
        """Whether there are enough waves over the travel. A part of a wave is any smooth curve."""
        return float(self.harmonic) * scene.travel(self.joint) > _FEWEST * 2 * np.pi

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The wave on the joint, `(joints,)`."""
        angle = self.harmonic * motion.q[self.joint - 1]
        wave = self.A * jnp.cos(angle) + self.B * jnp.sin(angle)
        return on_joint(self.joint, wave, motion)


class TorqueOffset(AbstractEffect):
    """A constant torque at one joint: amplifier offset, wrong balance weight.

    An offset of much more than a tenth of the recorded torque is unlikely: it rather stands for a
    torque that changes little along the recorded motion. Estimates are drawn to zero accordingly,
    which matters only where the recordings hardly tell the two apart.
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="offset", unit="N·m", scale=0.1)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The offset on the joint, `(joints,)`."""
        return on_joint(self.joint, self.level, motion)

    def likely(self, torque: Float[np.ndarray, " joints"]) -> dict[str, float]:
        """A tenth of the recorded torque."""
        return {"level": _LIKELY * float(torque[self.joint - 1])}


class Spring(AbstractEffect):
    """Hoses and cables: k (q - q0), with the preload k q0 as parameter."""

    joint_fields = ("joint",)
    optional = (("preload",),)
    joint: int = eqx.field(static=True)
    stiffness: Scalar = parameter(0.0, symbol="k", unit="N·m/rad", scale=0.1)
    preload: Scalar = parameter(0.0, symbol="kq0_", unit="N·m", scale=0.1)
    on_link = True

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """k q - k q0 on the joint, `(joints,)`."""
        pull = self.stiffness * motion.q[self.joint - 1] - self.preload
        return on_joint(self.joint, pull, motion)


class EndStop(AbstractEffect):
    """A stiff spring beyond an angle: k (q - qe) where q is beyond qe.

    `side` is 1 for the upper end, -1 for the lower.
    """

    joint_fields = ("joint",)
    several = 2
    joint: int = eqx.field(static=True)
    stiffness: Scalar = parameter(0.0, symbol="ke", unit="N·m/rad", lower=0.0, scale=1.0)
    angle: Scalar = parameter(0.0, symbol="qe", unit="rad", scale=0.1, linear=False)
    side: int = eqx.field(static=True, default=1)
    on_link = True
    local = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["EndStop"]:
        """Angles in the outer quarter of the travel, at both ends."""
        return [
            cls(joint=j, angle=end - side * share * scene.travel(j), side=side)
            for j in scene.joints
            for side, end in ((1, scene.q_high[j - 1]), (-1, scene.q_low[j - 1]))
            for share in (0.03, 0.07, 0.12, 0.18, 0.25)
        ]

    def genuine(self, scene: Scene, beside: Sequence[AbstractEffect]) -> bool:
        """Whether a part of the travel is free of the stop; otherwise it is a spring."""
        j = self.joint - 1
        end = scene.q_high[j] if self.side > 0 else scene.q_low[j]
        return self.side * (float(end) - float(self.angle)) < _SPRING * scene.travel(self.joint)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque of the stop on the joint, `(joints,)`."""
        beyond = jnp.maximum(self.side * (motion.q[self.joint - 1] - self.angle), 0.0)
        return on_joint(self.joint, self.side * self.stiffness * beyond, motion)


class Gravity(AbstractEffect):
    """Gravity on a planar arm of turning joints, such as that of a base that is not level.

    Every link adds G cos(phi) + H sin(phi), with phi its angle in the plane, to its own joint and
    all previous ones.
    """

    G: Vector = parameter((0.0, 0.0), symbol="G", unit="N·m", scale=0.1)
    H: Vector = parameter((0.0, 0.0), symbol="H", unit="N·m", scale=0.1)
    on_link = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Gravity"]:
        """One instance for arms that turn; on a sliding joint gravity is an offset."""
        if any(scene.slides) or not scene.planar:
            return []
        zeros = (0.0,) * len(scene.slides)
        return [cls(zeros, zeros)]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Gravity of each link and of those it carries, `(joints,)`."""
        angle = jnp.cumsum(motion.q)
        own = self.G * jnp.cos(angle) + self.H * jnp.sin(angle)
        return jnp.cumsum(own[::-1])[::-1]


class Tilt(AbstractEffect):
    """Gravity in the plane of an arm whose first moments are known except for the first link's.

    Each link of moments (MX, MY) and angle phi in the plane adds
    gx (MX sin phi + MY cos phi) - gy (MX cos phi - MY sin phi) to its own joint and all
    previous ones; the first link's moment is along the link. This is a form of `Gravity` with one
    parameter fewer.
    """

    gx: Scalar = parameter(0.0, symbol="gx", unit="m/s²", scale=0.1)
    gy: Scalar = parameter(0.0, symbol="gy", unit="m/s²", scale=0.1)
    first: Scalar | None = parameter(None, symbol="S1", unit="kg·m", scale=1.0, linear=False)
    moments: Float[Array, "joints 2"] = eqx.field(converter=as_float64, default=((0.0, 0.0),))
    on_link = True

    @classmethod
    def effect_name(cls) -> str:
        """`gravity`: this is one of its forms."""
        return "gravity"

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Tilt"]:
        """First moments from one to sixteen times that of the last link, if it is not known."""
        known = [m for m in scene.moments if m is not None]
        flat = scene.planar and not any(scene.slides)
        if not flat or not known or None in scene.moments[1:]:
            return []
        if scene.moments[0] is not None:
            return [cls(moments=scene.moments)]
        size = float(np.hypot(*known[-1])) or 0.1
        rows = ((0.0, 0.0), *scene.moments[1:])
        return [cls(first=share * size, moments=rows) for share in (1.0, 4.0, 16.0)]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Gravity of each link and of those it carries, `(joints,)`."""
        mx, my = self.moments[:, 0], self.moments[:, 1]
        if self.first is not None:
            mx, my = mx.at[0].set(self.first), my.at[0].set(0.0)
        angle = jnp.cumsum(motion.q)
        c, s = jnp.cos(angle), jnp.sin(angle)
        own = self.gx * (mx * s + my * c) - self.gy * (mx * c - my * s)
        return jnp.cumsum(own[::-1])[::-1]
