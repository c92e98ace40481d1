"""Friction that depends on more than speed: load, angle, temperature, history."""

import math
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, as_float64, parameter
from ._base import AbstractEffect, Motion, on_joint, smooth_sign
from ._scene import Scene
from .friction import sign_form, smoothing_speed


class LoadDependentFriction(AbstractEffect):
    """Coulomb friction that grows with the transmitted torque: alpha |tau_load| sigma(v).

    The load is tau_load = tau - kappa alpha |tau_load| sigma(v), which is solved in closed form.
    With kappa = 1 it is the torque that reaches the link (Hamon, Gautier, Garrec 2010), with
    kappa = 0 that of the drive. The two differ in how much more friction a joint has that drives
    its load than one that its load drives, as the efficiencies of a gear do.

    **Arguments:**

    - `ratio`: alpha, 1. `behind`: kappa, from 0 to 1, held unless freed.
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    ratio: Scalar = parameter(0.0, symbol="alpha", unit="1", lower=0.0, upper=0.95, scale=0.1)
    behind: Scalar = parameter(
        1.0, symbol="kappa", unit="1", lower=0.0, upper=1.0, scale=0.5, free=False, linear=False
    )
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()
    loaded = geared = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["LoadDependentFriction"]:
        """Every joint."""
        return [cls(joint=j, **scene.sign(j)) for j in scene.joints]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """alpha |tau_load| sigma(v) on the joint, `(joints,)`."""
        j = self.joint - 1
        share = self.ratio * smooth_sign(motion.v[j], self.smoothing, self.form)
        available = motion.tau[j]
        load = jnp.abs(available) / (1 + self.behind * share * jnp.sign(available))
        return on_joint(self.joint, share * load, motion)


class PositionDependentFriction(AbstractEffect):
    """Friction that varies with the angle, once and twice a turn (bent shafts, worn gears).

    (A1 cos q + B1 sin q + A2 cos 2q + B2 sin 2q) sigma(v). For a sliding joint the travel counts
    as half a turn, so friction may rise from one end to the other.
    """

    joint_fields = ("joint",)
    optional = ("A1", "B1"), ("A2", "B2")
    joint: int = eqx.field(static=True)
    A1: Scalar = parameter(0.0, symbol="FA1_", unit="N·m", scale=0.1)
    B1: Scalar = parameter(0.0, symbol="FB1_", unit="N·m", scale=0.1)
    A2: Scalar = parameter(0.0, symbol="FA2_", unit="N·m", scale=0.1)
    B2: Scalar = parameter(0.0, symbol="FB2_", unit="N·m", scale=0.1)
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()
    # Not static: programs would depend on it, and it varies with the simulated travel.
    turn: Scalar = eqx.field(converter=as_float64, default=2 * np.pi)

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["PositionDependentFriction"]:
        """Every joint."""
        return [
            cls(
                joint=j,
                **scene.sign(j),
                turn=2 * scene.travel(j) if scene.slides[j - 1] else 2 * np.pi,
            )
            for j in scene.joints
        ]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The wave times sigma(v) on the joint, `(joints,)`."""
        j = self.joint - 1
        angle = 2 * jnp.pi / self.turn * motion.q[j]
        wave = self.A1 * jnp.cos(angle) + self.B1 * jnp.sin(angle)
        wave = wave + self.A2 * jnp.cos(2 * angle) + self.B2 * jnp.sin(2 * angle)
        return on_joint(
            self.joint, wave * smooth_sign(motion.v[j], self.smoothing, self.form), motion
        )


# A lubricant takes minutes to warm. Torque that fades within a second, s, has another cause.
_FASTEST = 1.0
# Share of it that is left when a drift has faded.
_FADED = 0.1


class ThermalDrift(AbstractEffect):
    """Friction that relaxes as the joint warms: (Fvt v + Fct sigma(v)) exp(-t/T)."""

    joint_fields = ("joint",)
    optional = ("viscous",), ("coulomb",)
    joint: int = eqx.field(static=True)
    viscous: Scalar = parameter(0.0, symbol="Fvt", unit="N·m·s/rad", scale=0.05)
    coulomb: Scalar = parameter(0.0, symbol="Fct", unit="N·m", scale=0.1)
    time_constant: Scalar = parameter(
        10.0, symbol="T", unit="s", lower=_FASTEST, scale=10.0, linear=False
    )
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["ThermalDrift"]:
        """Time constants from a twentieth of the recordings to twice their length."""
        return [
            cls(joint=j, time_constant=time, **scene.sign(j))
            for j in scene.joints
            for time in scene.duration * np.geomspace(0.06, 1.5, 5)
            if time > _FASTEST
        ]

    def genuine(self, scene: Scene, beside: Sequence[AbstractEffect]) -> bool:
        """Whether friction still fades when the joint moves in its other direction.

        Otherwise the term may describe another torque at the start of the motion.
        """
        if not scene.returned:
            return True
        after = scene.returned[self.joint - 1]
        return math.exp(-after / float(self.time_constant)) > _FADED

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The fading part of friction on the joint, `(joints,)`."""
        v = motion.v[self.joint - 1]
        friction = self.viscous * v + self.coulomb * smooth_sign(v, self.smoothing, self.form)
        return on_joint(self.joint, friction * jnp.exp(-motion.t / self.time_constant), motion)


def _bends_visibly(scene: Scene, joint: int, slide: float) -> bool:
    """Whether a joint moves less than a presliding distance within a sample after a reversal.

    Otherwise friction with memory is a sharp sign of velocity. The acceleration at the reversal is
    that of a sine over the travel with the highest speed.
    """
    acceleration = 2 * float(scene.speed[joint - 1]) ** 2 / max(scene.travel(joint), 1e-300)
    return slide > acceleration * scene.period**2 / 2


class Hysteresis(AbstractEffect):
    """Presliding friction after Dahl 1968: Fh z, with z' = (v - |v| z) / slide."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="Fh", unit="N·m", lower=0.0, scale=0.1)
    slide: Scalar = parameter(
        0.01, symbol="slide", unit="rad", lower=1e-6, scale=0.01, linear=False
    )

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Hysteresis"]:
        """Distances from a five-hundredth to a fifteenth of the travel."""
        return [
            cls(joint=j, slide=share * scene.travel(j))
            for j in scene.joints
            for share in np.geomspace(0.002, 0.06, 5)
        ]

    def genuine(self, scene: Scene, beside: Sequence[AbstractEffect]) -> bool:
        """Whether the bristle bends for longer than a sample."""
        return _bends_visibly(scene, self.joint, float(self.slide))

    def initial_state(self) -> Float[Array, " states"]:
        """The bristle unloaded, `(1,)`."""
        return jnp.zeros(1)

    def derivative(self, motion: Motion) -> Float[Array, " states"]:
        """Rate of the bristle's deflection, `(1,)`, 1/s."""
        v = motion.v[self.joint - 1]
        return (v - jnp.abs(v) * motion.state) / self.slide

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fh z on the joint, `(joints,)`."""
        return on_joint(self.joint, self.level * motion.state[0], motion)


class LuGre(AbstractEffect):
    """Presliding friction with a Stribeck curve (Canudas de Wit et al. 1995).

    Fh (z + d z'), with z' = (v - |v| z / g(v)) / slide and g = 1 + r exp(-(v/vs)²).
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="Fh", unit="N·m", lower=0.0, scale=0.1)
    slide: Scalar = parameter(
        0.01, symbol="slide", unit="rad", lower=1e-6, scale=0.01, linear=False
    )
    excess: Scalar = parameter(0.4, symbol="r", unit="1", lower=0.0, scale=0.4, linear=False)
    velocity: Scalar = parameter(
        0.1, symbol="vs", unit="rad/s", lower=1e-4, scale=0.1, linear=False
    )
    damping: Scalar = parameter(0.0, symbol="d", unit="s", lower=0.0, scale=0.01, linear=False)

    @classmethod
    def effect_name(cls) -> str:
        """`hysteresis`: this is one of its forms."""
        return "hysteresis"

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["LuGre"]:
        """Distances as for Dahl's form, with one medium Stribeck velocity."""
        return [
            cls(joint=j, slide=share * scene.travel(j), velocity=0.15 * scene.speed[j - 1])
            for j in scene.joints
            for share in np.geomspace(0.004, 0.03, 3)
        ]

    def genuine(self, scene: Scene, beside: Sequence[AbstractEffect]) -> bool:
        """Whether the bristle bends for longer than a sample."""
        return _bends_visibly(scene, self.joint, float(self.slide))

    def initial_state(self) -> Float[Array, " states"]:
        """The bristle unloaded, `(1,)`."""
        return jnp.zeros(1)

    def derivative(self, motion: Motion) -> Float[Array, " states"]:
        """Rate of the bristle's deflection, `(1,)`, 1/s."""
        v = motion.v[self.joint - 1]
        steady = 1 + self.excess * jnp.exp(-((v / self.velocity) ** 2))
        return (v - jnp.abs(v) * motion.state / steady) / self.slide

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fh (z + d z') on the joint, `(joints,)`."""
        bristle = motion.state[0] + self.damping * self.derivative(motion)[0]
        return on_joint(self.joint, self.level * bristle, motion)
