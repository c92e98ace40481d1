"""A free-form spline of one coordinate, which assumes no physical formula."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, as_float64, parameter
from ._base import AbstractEffect, Motion, on_joint, smooth_sign
from .friction import sign_form, smoothing_speed

Coordinate = Literal["q", "v", "a", "tau", "t"]


class Curve(AbstractEffect):
    """A torque on one joint that is a smooth function of one coordinate, of any joint.

    A cubic B-spline on even knots between `low` and `high`, constant beyond them.

    - `joint`: the joint on which the torque acts. `coordinate`: position `"q"`, velocity `"v"`,
      acceleration `"a"` or torque `"tau"` of joint `of`, or time `"t"`.
    - `signed`: whether to multiply by the sign of this joint's velocity, as for friction.
    """

    joint_fields = ("joint", "of")
    joint: int = eqx.field(static=True)
    coordinate: Coordinate = eqx.field(static=True)
    of: int = eqx.field(static=True, default=1)
    low: Scalar = eqx.field(converter=as_float64, default=-1.0)
    high: Scalar = eqx.field(converter=as_float64, default=1.0)
    signed: bool = eqx.field(static=True, default=False)
    coefficients: Float[Array, " knots"] = parameter((0.0,) * 12, symbol="s", unit="N·m", scale=0.1)
    smoothing: Scalar = smoothing_speed()
    form: Scalar = sign_form()
    needs_acceleration = True

    @property
    def label(self) -> str:
        """The coordinate with its joint, such as `v2`; `t` for time."""
        return "t" if self.coordinate == "t" else f"{self.coordinate}{self.of}"

    @property
    def spoken_coordinate(self) -> str:
        """The coordinate in words, such as `velocity of joint 2`."""
        words = {"q": "position", "v": "velocity", "a": "acceleration", "tau": "drive torque"}
        return "time" if self.coordinate == "t" else f"{words[self.coordinate]} of joint {self.of}"

    def basis(self, x: Float[Array, ""]) -> Float[Array, " knots"]:
        """The value of each B-spline at a coordinate, `(knots,)`; they sum to one."""
        n = self.coefficients.shape[0]
        place = jnp.clip((x - self.low) / (self.high - self.low), 0.0, 1.0) * (n - 3)
        return cubic_bump(place - (jnp.arange(n) - 1.0))

    def value(self, x: Float[Array, ""]) -> Float[Array, ""]:
        """The curve at a coordinate, N·m or N."""
        return self.basis(x) @ self.coefficients

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """The curve's torque on its joint, `(joints,)`."""
        x = motion.t if self.coordinate == "t" else getattr(motion, self.coordinate)[self.of - 1]
        value = self.value(x)
        if self.signed:
            value = value * smooth_sign(motion.v[self.joint - 1], self.smoothing, self.form)
        return on_joint(self.joint, value, motion)


def cubic_bump(d: Float[Array, "..."]) -> Float[Array, "..."]:
    """The cubic B-spline of unit knots centred at zero (de Boor 1978)."""
    d = jnp.abs(d)
    near = 2 / 3 - d**2 + d**3 / 2
    far = (2 - d) ** 3 / 6
    return jnp.where(d < 1, near, jnp.where(d < 2, far, 0.0))


def curve_over(values: Float[np.ndarray, " samples"]) -> tuple[float, float]:
    """Range of a curve over recorded values, without 0.1 % of them at each end."""
    low, high = np.quantile(values, [0.001, 0.999])
    width = max(float(high - low), 1e-9)
    return float(low) - 1e-3 * width, float(high) + 1e-3 * width


def coordinate_unit(curve: Curve, torque: Sequence[str], position: Sequence[str]) -> str:
    """The unit of a curve's coordinate, from the units of each joint's torque and position."""
    if curve.coordinate == "t":
        return "s"
    if curve.coordinate == "tau":
        return torque[curve.of - 1]
    return position[curve.of - 1] + {"v": "/s", "a": "/s²"}.get(curve.coordinate, "")
