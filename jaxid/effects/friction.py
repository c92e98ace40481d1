"""Friction that depends on speed alone."""

from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion, on_joint, smooth_sign
from ._scene import Scene


def smoothing_speed() -> Any:
    """A field for the speed at which a smoothed sign is 1/2; 1/100 rad/s (Brunot et al. 2016).

    Its estimate is zero, the bound, if friction changes sign faster than the samples resolve.
    """
    return parameter(
        0.01, symbol="eps", unit="rad/s", lower=0.0, scale=0.01, free=False, linear=False
    )


def sign_form() -> Any:
    """A field for the form of a smoothed sign (`smooth_sign`): 0, the arctan, to 3/2, a ramp."""
    return parameter(
        0.0, symbol="form", unit="1", lower=0.0, upper=1.5, scale=1.0, free=False, linear=False
    )


class Viscous(AbstractEffect):
    """Friction proportional to velocity: Fv v."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    coefficient: Scalar = parameter(0.0, symbol="Fv", unit="N·m·s/rad", lower=0.0, scale=0.05)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fv v on the joint, `(joints,)`."""
        return on_joint(self.joint, self.coefficient * motion.v[self.joint - 1], motion)


class Coulomb(AbstractEffect):
    """Dry friction, smoothed: Fc sigma(v), sigma = 2/pi arctan(v/eps) (Brunot et al. 2016).

    `form` selects the function: the arctan at 0, (v/eps) / sqrt(3 + (v/eps)²) at 1/2,
    tanh(v/eps · artanh(1/2)) at 1, and v/(2 eps) up to rounded corners at 3/2. For all of them
    sigma is 1/2 at v = eps.

    `lead` is the time by which friction precedes velocity: sigma(v + lead a). That of real
    friction is zero. The dry friction of simulators with soft constraints depends on the velocity
    that the joint would reach: MuJoCo's `frictionloss` has a lead of dmax · timeconst / 2, 9.5 ms
    by default (MuJoCo documentation, "Solver parameters"). It acts only along an imposed motion
    (unknown law), where acceleration is known.
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="Fc", unit="N·m", lower=0.0, scale=0.1)
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()
    lead: Scalar = parameter(
        0.0, symbol="lead", unit="s", lower=0.0, upper=0.02, scale=0.01, free=False, linear=False
    )

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fc sigma(v) on the joint, `(joints,)`."""
        v = motion.v[self.joint - 1]
        if motion.imposed:
            v = v + self.lead * motion.a[self.joint - 1]
        sign = smooth_sign(v, self.smoothing, self.form)
        return on_joint(self.joint, self.level * sign, motion)


# Square of a relative speed, or a sign, at which its power has a derivative by the exponent.
_STILL = 1e-12
# Share of a Stribeck peak below which the peak has ended.
_ENDED = 0.25


class Stribeck(AbstractEffect):
    """Friction that decreases with speed: Fs exp(-|v/vs|^δs) sigma(v) (Armstrong-Hélouvry 1991).

    The exponent is held unless freed: 2 is a Gaussian, 1 an exponential (Tustin 1947), and 1/2 was
    also measured (Bo, Pavelescu 1982).
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="Fs", unit="N·m", lower=0.0, scale=0.1)
    velocity: Scalar = parameter(
        0.1, symbol="vs", unit="rad/s", lower=1e-4, scale=0.1, linear=False
    )
    exponent: Scalar = parameter(
        2.0, symbol="ds", unit="1", lower=0.4, upper=4.0, scale=1.0, free=False, linear=False
    )
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()

    @classmethod
    def spoken(cls) -> str:
        """Name in a sentence, with a capital."""
        return "Stribeck friction"

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Stribeck"]:
        """Velocities from a fiftieth to a half of the highest speed."""
        shares = np.geomspace(0.02, 0.5, 7)
        return [
            cls(joint=j, velocity=share * scene.speed[j - 1], **scene.sign(j))
            for j in scene.joints
            for share in shares
        ]

    def genuine(self, scene: Scene, beside: Sequence[AbstractEffect]) -> bool:
        """Whether the peak ends in the lower half of the recorded speeds, or friction falls.

        Otherwise the term only bends a rising curve, as drag does.
        """
        speeds = np.linspace(0.0, scene.speed[self.joint - 1], 200)[1:]
        peak = np.exp(-((speeds / float(self.velocity)) ** float(self.exponent)))
        own = [e for e in beside if isinstance(e, Viscous) and e.joint == self.joint]
        curve = float(self.level) * peak + sum(float(e.coefficient) for e in own) * speeds
        return bool(peak[len(peak) // 2] < _ENDED or np.any(np.diff(curve) < 0))

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fs exp(-|v/vs|^δs) sigma(v) on the joint, `(joints,)`."""
        v = motion.v[self.joint - 1]
        fall = jnp.exp(-(((v / self.velocity) ** 2 + _STILL) ** (self.exponent / 2)))
        return on_joint(
            self.joint, self.level * fall * smooth_sign(v, self.smoothing, self.form), motion
        )


class AsymmetricFriction(AbstractEffect):
    """Friction that differs by direction: dFv |v| + dFc |sigma(v)|^da (Janot et al. 2017).

    dFv and dFc are added to viscous and Coulomb friction forward and subtracted backward. The
    exponent is held unless freed: at 1 the friction of each direction has the shape of sigma, at 2
    the difference is smooth where the velocity changes sign.
    """

    joint_fields = ("joint",)
    optional = ("viscous",), ("coulomb",)
    joint: int = eqx.field(static=True)
    viscous: Scalar = parameter(0.0, symbol="dFv", unit="N·m·s/rad", scale=0.05)
    coulomb: Scalar = parameter(0.0, symbol="dFc", unit="N·m", scale=0.1)
    exponent: Scalar = parameter(
        1.0, symbol="da", unit="1", lower=0.5, upper=4.0, scale=1.0, free=False, linear=False
    )
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["AsymmetricFriction"]:
        """Every joint."""
        return [cls(joint=j, **scene.sign(j)) for j in scene.joints]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """dFv |v| + dFc |sigma(v)|^da on the joint, `(joints,)`."""
        v = motion.v[self.joint - 1]
        sign = smooth_sign(v, self.smoothing, self.form)
        dry = self.coulomb * (sign**2 + _STILL) ** (self.exponent / 2)
        return on_joint(self.joint, self.viscous * jnp.abs(v) + dry, motion)


class QuadraticDrag(AbstractEffect):
    """Drag that grows with the square of speed: Fq v |v| (fluid, fan-cooled motors)."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    coefficient: Scalar = parameter(0.0, symbol="Fq", unit="N·m·s²/rad²", lower=0.0, scale=0.01)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Fq v |v| on the joint, `(joints,)`."""
        v = motion.v[self.joint - 1]
        return on_joint(self.joint, self.coefficient * v * jnp.abs(v), motion)
