"""The law of quasi-direct drives, whose gains come with every command (their "MIT mode")."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import ModelError
from ..recording import Recording
from ._base import AbstractController, Reading, Reference, Signals
from .pd import _vector


class Impedance(AbstractController):
    """tau = clip(kp (q_ref - q) + kd (v_ref - v) + tau_ff, ±limit), commanded by the recording.

    Position, velocity, both gains and torque are commanded with every sample and are constant until
    the next, as for actuators with the protocol of Mini Cheetah (Katz 2018).
    While the drive is off (`on`), it gives no torque.

    **Arguments:**

    - `limit`: largest torque, `(joints,)`, N·m or N.
    """

    limit: Float[Array, " joints"] = eqx.field(converter=_vector, default=np.inf)

    def signals(self, recording: Recording) -> Signals:
        """Commanded positions and torques, `(samples, joints)`.

        **Raises:** `ModelError` if the recording has no reference or no gains.
        """
        for name in ("kp", "kd"):
            if getattr(recording, name) is None:
                raise ModelError(
                    f"{recording.name} has no {name}, which Impedance needs: name its column, or "
                    f"give one number for the recording ({name}=...)"
                )
        return dataclasses.replace(super().signals(recording), hold=True)

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The law's torque, `(joints,)`, N·m or N."""
        held = reference.held
        told = reference.tau + held.get("kp", 0.0) * (reference.q - reading.q)
        told = told + held.get("kd", 0.0) * (held.get("v_ref", 0.0) - reading.v)
        return held.get("on", 1.0) * jnp.clip(told, -self.limit, self.limit)
