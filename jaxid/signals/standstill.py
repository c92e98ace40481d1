"""The samples at which a joint moves, where its torque is a function of the motion."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..recording import Recording
from .smoothing import smooth_samples

# Share of its highest speed below which a joint stands still.
STILL = 0.01
# Reach of standstill in periods of the cutoff. After one period the low-pass leaves about a
# hundredth of a jump of friction, after two periods a thousandth.
REACH = 1.0
# Time in which dry friction builds up after a reversal, s, for any cutoff.
_PRESLIDING = 0.03
# Smallest share of a joint's moving samples that is compared.
_LEAST = 0.6


class Standstill(eqx.Module):
    """Where a joint counts as standing still; its torque is not compared there.

    At standstill, static friction may be any torque up to the breakaway torque. It depends on the
    other torques, and motion does not determine it.

    **Arguments:**

    - `still`: share of its highest speed below which a joint counts as standing still, one for all
      joints or one per joint. Zero compares all samples. By default it is a hundredth if the
      control law is unknown, and zero if a law is simulated. A fit raises it if torque at low speed
      is no function of motion.
    - `reach`: time from such samples within which torque is not compared either, in periods of the
      cutoff of the motion, or of 30 ms if they are shorter; one for all joints or one per joint. By
      default one. A fit raises it to two if a jump of friction visibly spreads further.
    - `speed`: speed of each joint that `still` refers to in recordings with a lower highest speed,
      rad/s or m/s. A fit sets it by its recordings (`within`).
    """

    still: float | Float[Any, " joints"] | None = None
    reach: float | Float[Any, " joints"] | None = None
    speed: Float[Any, " joints"] | None = None

    @property
    def chosen(self) -> bool:
        """Whether the settings are chosen by a fit."""
        return self.still is None and self.reach is None

    def settled(self, joints: int, imposed: bool) -> "Standstill":
        """The same with a number for each joint.

        **Arguments:**

        - `imposed`: whether the recorded motion is imposed on the model.
        """
        each, still = np.zeros(joints), STILL if imposed else 0.0
        return dataclasses.replace(
            self,
            still=each + np.asarray(still if self.still is None else self.still),
            reach=each + np.asarray(REACH if self.reach is None else self.reach),
        )

    def within(self, recordings: Iterable[Recording], cutoff: float) -> "Standstill":
        """The same, for use on other recordings after a fit of these.

        The friction at speeds below the slowest compared samples is not known from these
        recordings, so such samples of other recordings are not compared.

        **Arguments:**

        - `cutoff`: frequency up to which the recorded motion is known, Hz.
        """
        highest = [np.abs(_speed(r, cutoff)).max(axis=0) for r in recordings]
        return dataclasses.replace(self, speed=np.min(highest, axis=0))

    def moving(self, recording: Recording, cutoff: float) -> Bool[np.ndarray, "samples joints"]:
        """Samples at which a joint moves, further from standstill than the reach.

        If a joint reverses so often that few samples remain, samples nearer to a reversal are used.

        **Arguments:**

        - `cutoff`: frequency up to which the recorded motion is known, Hz.
        """
        settled = self.settled(recording.joints, imposed=True)
        still, reach = np.asarray(settled.still), np.asarray(settled.reach)
        speed = _speed(recording, cutoff)
        highest = np.abs(speed).max(axis=0)
        if self.speed is not None:
            highest = np.maximum(highest, np.asarray(self.speed))
        standing = np.abs(speed) < still * highest
        # A fast reversal may be between two samples.
        turns = (speed[1:] * speed[:-1] < 0) & (still > 0)
        standing[1:] |= turns
        standing[:-1] |= turns
        memory = recording.rate * max(1 / cutoff, _PRESLIDING)
        pairs = zip(standing.T, memory * reach, strict=True)
        return np.stack([_far_from(column, span) for column, span in pairs], axis=1)


def _speed(recording: Recording, cutoff: float) -> Float[np.ndarray, "samples joints"]:
    """The speed of the low-passed motion at the samples."""
    return np.gradient(smooth_samples(recording, cutoff), recording.time, axis=0)


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
