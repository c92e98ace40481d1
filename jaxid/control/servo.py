"""A position servo that commands a duty cycle, such as hobby servos and smart actuators."""

import dataclasses
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Vector, parameter
from ..recording import Recording
from ._base import AbstractController, Reading, Reference, Signals
from .pd import _vector


class Servo(AbstractController):
    """volts = supply · clip(gain kp e - damping v, ±duty), with e = q_ref - q beyond the deadband.

    The recorded `tau` is in volts, and `jaxid.effects.DCMotor` converts it to torque. The voltage
    follows from the position, so fits compare positions. `kp` is taken from the recording if it has
    one, and is 1 otherwise. A recorded `supply` replaces the argument. While the drive is off (`on`
    in the recording), the voltage is zero. Goals are constant from sample to sample.
    `Sampled(Servo(...), every=...)` is a servo with a sampled law.

    **Arguments:**

    - `supply`: voltage at full duty, `(joints,)`, V.
    - `gain`: duty cycle per error for a recorded `kp` of one, `(joints,)`, 1/rad (1/m).
    - `damping`: duty cycle per measured velocity, `(joints,)`, s/rad (s/m).
    - `deadband`: errors up to this count as zero, `(joints,)`, rad (m).
    - `duty`: largest duty cycle, `(joints,)`.
    """

    supply: Float[Array, " joints"] = eqx.field(converter=_vector)
    gain: Vector = parameter(symbol="gain", unit="1/rad", lower=0.0, free=False, linear=False)
    damping: Float[Array, " joints"] = eqx.field(converter=_vector, default=0.0)
    deadband: Float[Array, " joints"] = eqx.field(converter=_vector, default=0.0)
    duty: Float[Array, " joints"] = eqx.field(converter=_vector, default=1.0)

    @property
    def judged(self) -> Literal["torque", "position"]:
        """Position, because the voltage is a gain times its error."""
        return "position"

    def signals(self, recording: Recording) -> Signals:
        """Goals and known voltage, `(samples, joints)`, V."""
        return dataclasses.replace(super().signals(recording), hold=True)

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The voltage, `(joints,)`, V."""
        held = reference.held
        error = reference.q - reading.q
        error = error - jnp.clip(error, -self.deadband, self.deadband)
        duty = self.gain * held.get("kp", 1.0) * error - self.damping * reading.v
        supply = held.get("supply", self.supply)
        volts = supply * jnp.clip(duty, -self.duty, self.duty) + reference.tau
        return held.get("on", 1.0) * jnp.clip(volts, -supply, supply)
