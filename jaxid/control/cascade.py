"""The position and velocity cascade of the EMPS benchmark."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import AbstractController, Reading, Reference


class Cascade(AbstractController):
    """vir = kp kv (q_ref - q) - kv dq in volts, sampled, saturated; force = gtau · vir. One joint.

    `dq` is the backward difference of the position averaged over the last two samples (Janot,
    Gautier, Brunot 2019). A known torque (`tau_ff`) is added before the saturation.

    **Arguments:**

    - `kp`: position gain, 1/s. `kv`: velocity gain, V/(m/s). `gtau`: drive gain, N/V.
    - `limit`: saturation, V. `every`: period, s.
    - `delay`: whether a command acts one period later.
    """

    kp: float = 160.18
    kv: float = 243.45
    gtau: float = 35.15065
    limit: float = 10.0
    every: float = eqx.field(static=True, default=1e-3)
    delay: bool = eqx.field(static=True, default=False)

    @property
    def period(self) -> float:
        """Time between two ticks, s."""
        return self.every

    def initial_state(self, reading: Reading) -> Float[Array, " states"]:
        """Positions at the last two ticks, the command to record and the one that acts, `(4,)`."""
        q, step, zero = reading.q[0], reading.v[0] * self.every, jnp.zeros(())
        return jnp.stack([q - step, q - 2 * step, zero, zero])

    def tick(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """The cascade's law, `(4,)`."""
        q, last, before, command = reading.q[0], state[0], state[1], state[2]
        dq = (q - before) / (2 * self.every)
        volts = self.kp * self.kv * (reference.q[0] - q) - self.kv * dq
        volts = jnp.clip(volts + reference.tau[0] / self.gtau, -self.limit, self.limit)
        new = self.gtau * volts
        return jnp.stack([q, last, new, command if self.delay else new])

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The force of the last tick, as recorded, `(1,)`, N."""
        return state[2:3]

    def acting(
        self, command: Float[Array, " joints"], state: Float[Array, " states"]
    ) -> Float[Array, " joints"]:
        """The force that acts, `(1,)`, N."""
        return state[3:4]
