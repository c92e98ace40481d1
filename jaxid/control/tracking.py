"""A virtual controller for robots whose control law is unknown."""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from ..recording import Recording
from ..signals.smoothing import even_times, resampled, signal_cutoff, smooth_motion
from ._base import AbstractController, Reading, Reference, Signals


class Tracking(AbstractController):
    """tau = M (a_m + 2 zeta w (v_m - v) + w² (q_m - q)) + h: follows the recorded motion q_m.

    Torque is that of inverse dynamics along the recorded motion: M is the model's mass matrix, and
    h is all other torque that the model needs, including friction. If no effect makes the arm
    deviate from q_m, the motion is imposed and nothing is simulated. Otherwise the loop is
    simulated and feedback corrects the deviation. Simulated and measured torque can be compared if
    both loops track equally well (Gautier, Janot, Vandanjon 2013). The recorded motion is
    low-passed forward and backward before differentiation. The same filter is applied to measured
    and simulated torque before they are compared (the parallel filter of Gautier 1997).

    **Arguments:**

    - `bandwidth`: bandwidth of the virtual loop, Hz; must be above `cutoff`.
    - `damping`: damping ratio of the virtual loop.
    - `delay`: time by which torque acts later than recorded, s. It is half a period for a law that
      is computed at every sample and held in between.
    - `cutoff`: cutoff of the low-pass, Hz. By default the frequency above which the recorded motion
      is noise; a fit uses the lowest of its recordings.
    - `still`: share of its highest speed below which a joint counts as standing still, one for all
      joints or one per joint. Motion does not determine static friction, which may be any torque up
      to the breakaway torque. The torque of such samples is therefore not compared. Zero compares
      all samples. By default it is a hundredth; a fit raises it if torque at low speed is no
      function of motion.
    - `reach`: time from such samples within which torque is not compared either, in periods of the
      cutoff, or of 30 ms if they are shorter; one for all joints or one per joint. By default one;
      a fit raises it to two if the low-pass visibly spreads a jump of friction further.
    """

    bandwidth: float = 40.0
    damping: float = 1.0
    cutoff: float | None = eqx.field(static=True, default=None)
    delay: float = eqx.field(static=True, default=0.0)
    still: float | Float[Any, " joints"] | None = None
    reach: float | Float[Any, " joints"] | None = None

    @property
    def pace(self) -> float:
        """Bandwidth of the virtual loop, 1/s."""
        return 2 * math.pi * self.bandwidth

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

    def comparable(self, recording: Recording) -> float:
        """Cutoff of the low-pass, Hz."""
        return self.cutoff or signal_cutoff(recording)

    def moving(
        self, recording: Recording, cutoff: float
    ) -> Bool[np.ndarray, "samples joints"] | None:
        """Samples at which a joint moves and has moved for the length of the low-pass.

        If a joint reverses so often that few samples remain, samples nearer to a reversal are used.
        """
        still = STILL if self.still is None else np.asarray(self.still)
        if np.all(still <= 0):
            return None
        time = even_times(recording)
        speed = np.gradient(smooth_motion(recording, cutoff), time, axis=0)
        standing = np.abs(speed) < still * np.abs(speed).max(axis=0)
        # A fast reversal may be between two samples.
        turns = speed[1:] * speed[:-1] < 0
        standing[1:] |= turns
        standing[:-1] |= turns
        memory = recording.rate * max(1 / cutoff, _PRESLIDING)
        reach = np.zeros(len(standing.T)) + np.asarray(REACH if self.reach is None else self.reach)
        pairs = zip(standing.T, memory * reach, strict=True)
        return np.stack([_far_from(column, span) for column, span in pairs], axis=1)

    def settled(self, recordings: Iterable[Recording]) -> "Tracking":
        """The controller with the lowest cutoff of all recordings, and settings of each joint."""
        recordings = list(recordings)
        each = np.zeros(recordings[0].q.shape[1])
        still = each + np.asarray(STILL if self.still is None else self.still)
        reach = each + np.asarray(REACH if self.reach is None else self.reach)
        cutoff = min(map(self.comparable, recordings))
        return dataclasses.replace(self, cutoff=cutoff, still=still, reach=reach)

    def signals(self, recording: Recording) -> Signals:
        """The low-passed recorded motion, `(samples, joints)`."""
        smooth = smooth_motion(recording, self.comparable(recording))
        times = even_times(recording)
        # Torque belongs to the motion at the time at which it acts; that is unknown at the end.
        at = np.clip(recording.time + self.delay, times[0], times[-1])
        q = resampled(times, smooth, at)
        return Signals(q, np.zeros_like(recording.tau))


# Share of its highest speed below which a joint stands still.
STILL = 0.01
# Reach of standstill in periods of the cutoff. After one period the low-pass leaves about a
# hundredth of a jump of friction, after two periods a thousandth.
REACH = 1.0
# Time in which dry friction builds up after a reversal, s, for any cutoff.
_PRESLIDING = 0.03
# Smallest share of a joint's moving samples that is compared.
_LEAST = 0.6


def _far_from(there: Bool[np.ndarray, " samples"], reach: float) -> Bool[np.ndarray, " samples"]:
    """Samples further than a reach from marked ones, with a shorter reach if few remain."""
    import scipy

    if there.mean() > 0.95:
        # The joint does not move: only its noise can be compared.
        return np.ones_like(there)
    for part in (1.0, 0.5, 0.25):
        width = 2 * round(part * reach) + 1
        found = ~scipy.ndimage.binary_dilation(there, np.ones(width, bool))
        if found.sum() > _LEAST * (~there).sum():
            return found
    return ~there
