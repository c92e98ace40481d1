"""A virtual controller for robots whose control law is unknown."""

import dataclasses
import math
from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..parameters import Scalar, as_float64, parameter
from ..recording import Recording
from ..signals.smoothing import signal_cutoff, smooth_samples
from ._base import AbstractController, Reading, Reference, Signals

# Largest cutoff on the motion as a share of the sample rate. There the second derivative of a cubic
# spline is 22 % too large.
_KNOWN = 1 / 4


class Tracking(AbstractController):
    """tau = M (a_m + 2 zeta w (v_m - v) + w² (q_m - q)) + h: follows the recorded motion q_m.

    Torque is that of inverse dynamics along the recorded motion: M is the model's mass matrix, and
    h is all other torque that the model needs, including friction. If no effect makes the arm
    deviate from q_m, the motion is imposed and nothing is simulated. Otherwise the loop is
    simulated and feedback corrects the deviation. Simulated and measured torque can be compared if
    both loops track equally well (Gautier, Janot, Vandanjon 2013). The recorded motion is
    low-passed forward and backward before differentiation, at the frequency up to which it is
    known (`known`). Another low-pass, at `cutoff`, is applied to measured and simulated torque
    before they are compared (the parallel filter of Gautier 1997). The delay advances the simulated
    torque there; a simulation gives it at the time at which it acts.

    **Arguments:**

    - `bandwidth`: bandwidth of the virtual loop, Hz; must be above `cutoff`.
    - `damping`: damping ratio of the virtual loop.
    - `delay`: time by which torque acts later than recorded, s; estimated by a fit. It is half a
      period for a law that is computed at every sample and held in between.
    - `cutoff`: cutoff of the low-pass on the torque, Hz. By default the frequency above which the
      recorded motion is noise, at most an eighth of the sample rate; a fit determines it from all
      its recordings.
    """

    bandwidth: float = 40.0
    damping: float = 1.0
    # Not static: it is used before any program runs, and programs would depend on it.
    cutoff: Scalar | None = eqx.field(converter=as_float64, default=None)
    delay: Scalar = parameter(0.0, symbol="delay", unit="s", scale=1e-3, linear=False)

    @property
    def pace(self) -> float:
        """Bandwidth of the virtual loop, 1/s."""
        return 2 * math.pi * self.bandwidth

    @property
    def late(self) -> Float[Array, ""]:
        """The delay of the torque, s."""
        return self.delay

    @property
    def imposes(self) -> bool:
        """True; torque then does not lag behind the motion."""
        return True

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """Torque of the virtual law without h, `(joints,)`, N·m or N."""
        w = 2 * math.pi * self.bandwidth
        rate = 2 * self.damping * w * (reference.v - reading.v)
        return mass @ (reference.a + rate + w**2 * (reference.q - reading.q)) + reference.tau

    def likely(self, period: float) -> dict[str, float]:
        """A period for the delay: a logger rarely takes torque and position further apart."""
        return {"delay": period}

    def comparable(self, recording: Recording) -> float:
        """Cutoff of the low-pass, Hz."""
        return float(self.cutoff or signal_cutoff(recording))

    def known(self, recording: Recording) -> float:
        """Cutoff of the low-pass on a recorded motion, Hz: that on the torque, or higher.

        Near a reversal friction depends on higher frequencies of the velocity than are compared.
        """
        return max(self.comparable(recording), signal_cutoff(recording, highest=_KNOWN))

    def settled(self, recordings: Iterable[Recording]) -> "Tracking":
        """The controller with one cutoff for all recordings."""
        return dataclasses.replace(self, cutoff=self.cutoff or signal_cutoff(*recordings))

    def signals(self, recording: Recording) -> Signals:
        """The low-passed recorded motion, `(samples, joints)`."""
        q = self.smoothed(recording, recording.q)
        return Signals(q, np.zeros_like(recording.tau))

    def smoothed(
        self, recording: Recording, q: Float[np.ndarray, "samples joints"]
    ) -> Float[np.ndarray, "samples joints"]:
        """Positions at the times of a recording, low-passed like its own, rad or m."""
        return smooth_samples(recording, self.known(recording), q=q)
