"""The recorded torque as input, without feedback."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..recording import Recording
from ._base import AbstractController, Reading, Reference, Signals


class OpenLoop(AbstractController):
    """The recorded torque drives the arm; position is compared instead of torque."""

    @property
    def judged(self) -> Literal["torque", "position"]:
        """Position, because the recorded torque is the input."""
        return "position"

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The recorded torque, `(joints,)`, N·m or N."""
        return reference.tau + jnp.zeros_like(reading.q)

    def signals(self, recording: Recording) -> Signals:
        """The recorded motion (not used) and torque, `(samples, joints)`."""
        return Signals(recording.q, recording.tau)
