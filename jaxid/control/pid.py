"""A proportional-integral-derivative law."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import AbstractController, Reading, Reference
from .pd import _vector


class PID(AbstractController):
    """tau = Kp e + Ki ∫e + Kd e' + tau_ff, with e = q_ref - q and e' = v_ref - v.

    `Sampled(PID(...), every=...)` is the law of a drive, with anti-windup if it has a limit.

    **Arguments:**

    - `Kp`, `Ki`, `Kd`: gains, `(joints,)`, N·m/rad, N·m/(rad·s) and N·m·s/rad; for a sliding joint
      N/m, N/(m·s) and N·s/m.
    """

    Kp: Float[Array, " joints"] = eqx.field(converter=_vector)
    Ki: Float[Array, " joints"] = eqx.field(converter=_vector)
    Kd: Float[Array, " joints"] = eqx.field(converter=_vector)

    def initial_state(self, reading: Reading) -> Float[Array, " joints"]:
        """Zero integral, `(joints,)`."""
        return jnp.zeros_like(reading.q)

    def derivative(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """The error, rad or m."""
        return reference.q - reading.q

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The law's torque, `(joints,)`, N·m or N."""
        error, rate = reference.q - reading.q, reference.v - reading.v
        return self.Kp * error + self.Ki * state + self.Kd * rate + reference.tau
