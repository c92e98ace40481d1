"""Computed torque with a PID law, on a model that may differ from the arm."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import KNOWN
from ._base import AbstractController, Reading, Reference
from .pd import _vector


@runtime_checkable
class Body(Protocol):
    """Equations of motion inside a law."""

    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """Inertia at q."""
        ...

    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Torque besides that for acceleration."""
        ...


class ComputedTorque(AbstractController):
    """tau = M̂ (a_ref + Kd e' + Kp e + Ki ∫e) + ĥ(q, v), with e = q_ref - q.

    M̂ and ĥ are those of `model`, whose values a fit does not change (Li, Peng, Juang 2023).

    **Arguments:**

    - `model`: the model of the arm inside the law.
    - `Kp`, `Ki`, `Kd`: gains, `(joints,)`, 1/s², 1/s³ and 1/s.
    - `every`: period, s, of a sampled law that has encoders only: velocity is the difference of
      readings `window` ticks apart, and the torque is constant until the next tick. None for a
      continuous law with measured velocities.
    - `window`: ticks.
    """

    model: Body = eqx.field(metadata=KNOWN)
    Kp: Float[Array, " joints"] = eqx.field(converter=_vector)
    Ki: Float[Array, " joints"] = eqx.field(converter=_vector)
    Kd: Float[Array, " joints"] = eqx.field(converter=_vector)
    every: float | None = eqx.field(static=True, default=None)
    window: int = eqx.field(static=True, default=1)

    @property
    def period(self) -> float | None:
        """Time between two ticks, s; None for a continuous law."""
        return self.every

    def initial_state(self, reading: Reading) -> Float[Array, " states"]:
        """Zero integral; for a sampled law also zero torque and the last readings, newest first."""
        zero = jnp.zeros_like(reading.q)
        if self.every is None:
            return zero
        past = [reading.q - k * self.every * reading.v for k in range(1, self.window + 1)]
        return jnp.concatenate([zero, zero, *past])

    def _law(self, reading: Reading, reference: Reference, integral) -> Float[Array, " joints"]:
        error, rate = reference.q - reading.q, reference.v - reading.v
        asked = reference.a + self.Kd * rate + self.Kp * error + self.Ki * integral
        torque = self.model.mass_matrix(reading.q) @ asked
        return torque + self.model.bias(reading.q, reading.v) + reference.tau

    def derivative(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """Derivative of the integral of a continuous law: the error."""
        return jnp.zeros_like(state) if self.every else reference.q - reading.q

    def tick(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """Integral, the torque to hold, and the readings."""
        assert self.every is not None
        integral, _, *past = jnp.split(state, 2 + self.window)
        seen = Reading(reading.q, (reading.q - past[-1]) / (self.window * self.every))
        integral = integral + self.every * (reference.q - reading.q)
        torque = self._law(seen, reference, integral)
        return jnp.concatenate([integral, torque, reading.q, *past[:-1]])

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The law's torque, `(joints,)`, N·m or N; for a sampled law that of the last tick."""
        if self.every is None:
            return self._law(reading, reference, state)
        return jnp.split(state, 2 + self.window)[1]
