"""Proportional-derivative laws, continuous and sampled."""

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

    - `Kp`, `Kv`: gains, `(joints,)`, N·m/rad and N·m·s/rad (N/m and N·s/m where a joint slides);
      1/s² and 1/s where `Kg` is given.
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


class Sampled(AbstractController):
    """Another law, computed every `every` seconds and held in between.

    **Arguments:**

    - `law`: a continuous controller without states of its own.
    - `every`: period, s.
    """

    law: AbstractController
    every: float = eqx.field(static=True)

    @property
    def period(self) -> float:
        """Time between two ticks, s."""
        return self.every

    def initial_state(self, reading: Reading) -> Float[Array, " states"]:
        """No torque before the first tick, `(joints,)`."""
        return jnp.zeros_like(reading.q)

    def tick(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """The command to hold, `(joints,)`."""
        identity = jnp.eye(reading.q.shape[0])
        return self.law.command(reading, reference, jnp.zeros(0), identity)

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The held command, `(joints,)`."""
        return state
