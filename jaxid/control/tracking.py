"""A virtual controller for robots whose real one is unknown."""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from scipy import signal

from ..recording import Recording
from ._base import AbstractController, Reading, Reference, Signals


class Tracking(AbstractController):
    """tau = M (a_m + 2 zeta w (v_m - v) + w² (q_m - q)): follows the recorded motion q_m.

    Only the tracking has to be alike for the simulated torque to be held against the measured one
    (Gautier, Janot, Vandanjon 2013). The recorded motion is low-passed, forward and backward, so
    that a stiff loop is not a noisy one; M is the model's mass matrix.

    **Arguments:**

    - `bandwidth`: of the virtual loop, Hz.
    - `cutoff`: of the low-pass on the recorded motion, Hz; by default an eighth of the sample
      rate, at most 20 Hz.
    - `damping`: ratio of the virtual loop.
    """

    bandwidth: float = 10.0
    damping: float = 1.0
    cutoff: float | None = eqx.field(static=True, default=None)

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

    def signals(self, recording: Recording) -> Signals:
        """The low-passed recorded motion, `(samples, joints)`."""
        rate = recording.rate
        cutoff = self.cutoff or min(20.0, rate / 8)
        even = np.linspace(recording.time[0], recording.time[-1], recording.samples)
        q = np.stack([np.interp(even, recording.time, column) for column in recording.q.T], axis=1)
        sections = signal.butter(4, cutoff, fs=rate, output="sos")
        smooth = signal.sosfiltfilt(sections, q, axis=0)
        back = np.stack([np.interp(recording.time, even, column) for column in smooth.T], axis=1)
        return Signals(back, np.zeros_like(recording.tau))
