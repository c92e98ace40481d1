"""A proportional-derivative law."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import AbstractController, Reading, Reference


def _vector(value: object) -> Float[Array, " joints"]:
    return jnp.atleast_1d(jnp.asarray(value, dtype=jnp.float64))


class PD(AbstractController):
    """tau = Kg (Kp (q_ref - q) - Kv v) + tau_ff, equation (12) of Brunot et al. 2016.

    It damps the measured velocity, not its error; `tau_ff` is the recordings' feed-forward.

    **Arguments:**

    - `Kp`, `Kv`: gains, `(joints,)`, N·m/rad and N·m·s/rad (N/m and N·s/m for a sliding joint);
      1/s² and 1/s if `Kg` is given.
    - `Kg`: `(joints,)`, kg·m² (or kg); 1 by default.
    """

    Kp: Float[Array, " joints"] = eqx.field(converter=_vector)
    Kv: Float[Array, " joints"] = eqx.field(converter=_vector)
    Kg: Float[Array, " joints"] = eqx.field(converter=_vector, default=1.0)

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The law's torque, `(joints,)`, N·m or N."""
        error = reference.q - reading.q
        return self.Kg * (self.Kp * error - self.Kv * reading.v) + reference.tau
