"""A virtual controller for robots whose real one is unknown."""

import dataclasses
import math
from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from ..recording import Recording
from ..signals.smoothing import even_times, resampled, signal_cutoff, smooth_motion
from ._base import AbstractController, Reading, Reference, Signals


class Tracking(AbstractController):
    """tau = M (a_m + 2 zeta w (v_m - v) + w² (q_m - q)) + h: follows the recorded motion q_m.

    Where no effect gives the arm a motion of its own, q_m is imposed, and nothing is simulated.
    Otherwise only the tracking has to be alike for the simulated torque to be held against the
    measured one (Gautier, Janot, Vandanjon 2013). M is the model's mass matrix and h all else that
    its motion takes, friction included: the torque is that of inverse dynamics along the recorded
    motion, and feedback is left with what gives the arm a motion of its own. The recorded motion
    is low-passed, forward and backward, so that noise is not differentiated into torque. The
    measured torque holds what that motion cannot explain, so it and the simulated one pass the
    same filter before they are compared (the parallel filter of Gautier 1997).

    **Arguments:**

    - `bandwidth`: of the virtual loop, Hz; above `cutoff`, for what feedback does not follow is
      lost.
    - `damping`: ratio of the virtual loop.
    - `delay`: how much later than it was recorded torque acts, s: half a period for the commands of
      a law that is computed as often as it is recorded, and held in between.
    - `cutoff`: of the low-pass, Hz; by default where the recorded motion's spectrum sinks into
      noise, and once fitted the lowest of these.
    - `still`: share of its highest speed below which a joint stands still. Friction holds it then
      with any torque up to that of breaking away, which no motion tells, so neither then nor within
      a period of the cutoff, 30 ms at the least, is its torque compared; nil compares it all.
    """

    bandwidth: float = 40.0
    damping: float = 1.0
    cutoff: float | None = eqx.field(static=True, default=None)
    delay: float = eqx.field(static=True, default=0.0)
    still: float = eqx.field(static=True, default=0.01)

    @property
    def pace(self) -> float:
        """The virtual loop's, 1/s."""
        return 2 * math.pi * self.bandwidth

    @property
    def imposes(self) -> bool:
        """It does, so that torque does not lag behind the motion that takes it."""
        return True

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The virtual law's torque without what the model adds to it, `(joints,)`, N·m or N."""
        w = 2 * math.pi * self.bandwidth
        rate = 2 * self.damping * w * (reference.v - reading.v)
        return mass @ (reference.a + rate + w**2 * (reference.q - reading.q)) + reference.tau

    def comparable(self, recording: Recording) -> float:
        """The low-pass's cutoff, Hz."""
        return self.cutoff or signal_cutoff(recording)

    def moving(
        self, recording: Recording, cutoff: float
    ) -> Bool[np.ndarray, "samples joints"] | None:
        """At which samples a joint moves, and has moved for as long as the low-pass remembers.

        Of a joint that turns so often that little would be left, nearer samples are taken as well.
        """
        if self.still <= 0:
            return None
        time = even_times(recording)
        speed = np.gradient(smooth_motion(recording, cutoff), time, axis=0)
        standing = np.abs(speed) < self.still * np.abs(speed).max(axis=0)
        # Fast turns are over between two samples.
        turns = speed[1:] * speed[:-1] < 0
        standing[1:] |= turns
        standing[:-1] |= turns
        memory = recording.rate * max(1 / cutoff, _PRESLIDING)
        return np.stack([_far_from(column, memory) for column in standing.T], axis=1)

    def settled(self, recordings: Iterable[Recording]) -> "Tracking":
        """With one cutoff for all: the lowest up to which any of their motions is known."""
        return dataclasses.replace(self, cutoff=min(map(self.comparable, recordings)))

    def signals(self, recording: Recording) -> Signals:
        """The low-passed recorded motion, `(samples, joints)`."""
        smooth = smooth_motion(recording, self.comparable(recording))
        times = even_times(recording)
        # The motion that a torque takes is that of when it acts; at the end nothing is known of it.
        at = np.clip(recording.time + self.delay, times[0], times[-1])
        q = resampled(times, smooth, at)
        return Signals(q, np.zeros_like(recording.tau))


# How long after a turn dry friction takes to build up, s, however wide the band is.
_PRESLIDING = 0.03
# Share of the samples at which a joint moves that are compared at the least.
_LEAST = 0.6


def _far_from(there: Bool[np.ndarray, " samples"], reach: float) -> Bool[np.ndarray, " samples"]:
    """What is further from something than a reach, or a part of it that leaves enough."""
    import scipy

    if there.mean() > 0.95:
        # A joint that is held: its noise is all that there is to compare.
        return np.ones_like(there)
    for part in (1.0, 0.5, 0.25):
        width = 2 * round(part * reach) + 1
        found = ~scipy.ndimage.binary_dilation(there, np.ones(width, bool))
        if found.sum() > _LEAST * (~there).sum():
            return found
    return ~there
