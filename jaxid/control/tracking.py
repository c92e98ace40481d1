"""A virtual controller for robots whose real one is unknown."""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..recording import Recording
from ..signals.smoothing import even_times, resampled, signal_cutoff, smooth_motion
from ._base import AbstractController, Reading, Reference, Signals


class Tracking(AbstractController):
    """tau = M (a_m + 2 zeta w (v_m - v) + w² (q_m - q)): follows the recorded motion q_m.

    Only the tracking has to be alike for the simulated torque to be held against the measured one
    (Gautier, Janot, Vandanjon 2013); M is the model's mass matrix. The recorded motion is
    low-passed, forward and backward, so that noise is not differentiated into torque. The measured
    torque holds what that motion cannot explain, so it and the simulated one pass the same filter
    before they are compared (the parallel filter of Gautier 1997).

    **Arguments:**

    - `bandwidth`: of the virtual loop, Hz; above `cutoff`, for what it does not follow is lost.
    - `damping`: ratio of the virtual loop.
    - `cutoff`: of the low-pass, Hz; by default where the recorded motion's spectrum sinks into
      noise.
    """

    bandwidth: float = 40.0
    damping: float = 1.0
    cutoff: float | None = eqx.field(static=True, default=None)

    @property
    def pace(self) -> float:
        """The virtual loop's, 1/s."""
        return 2 * math.pi * self.bandwidth

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The virtual law's torque, `(joints,)`, N·m or N."""
        w = 2 * math.pi * self.bandwidth
        rate = 2 * self.damping * w * (reference.v - reading.v)
        return mass @ (reference.a + rate + w**2 * (reference.q - reading.q)) + reference.tau

    def comparable(self, recording: Recording) -> float:
        """The low-pass's cutoff, Hz."""
        return self.cutoff or signal_cutoff(recording)

    def signals(self, recording: Recording) -> Signals:
        """The low-passed recorded motion, `(samples, joints)`."""
        smooth = smooth_motion(recording, self.comparable(recording))
        q = resampled(even_times(recording), smooth, recording.time)
        return Signals(q, np.zeros_like(recording.tau))
