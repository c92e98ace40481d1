"""The noise floor of a fit from its recordings alone: the part that no model can explain."""

from collections.abc import Iterable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..noise import Level, above_motion, from_repeats
from ..recording import Recording, Recordings
from ..signals.smoothing import signal_cutoff
from ..signals.standstill import Standstill
from ..simulation.batch import band_of, compared
from ..simulation.loop import ClosedLoop

# The sources in words.
SPOKEN = {
    "repeats": "from recordings that repeat a reference",
    "above the motion": "from the torque above the motion's frequencies",
    "unpredicted": "from a residual that does not depend on the motion",
    "rich model": "from the residual of a model with all effects that matter",
}


class Floor(eqx.Module):
    """Relative error by recording and joint due to the noise of the recorded torque, %.

    - `percent`, `low`, `high`: its estimate and 95 % interval; NaN if the recordings do not
      determine it.
    - `sources`: by recording and joint, "repeats", "above the motion" or "unpredicted"; empty if
      not determined.
    """

    percent: Float[np.ndarray, "recordings joints"]
    low: Float[np.ndarray, "recordings joints"]
    high: Float[np.ndarray, "recordings joints"]
    sources: tuple[tuple[str, ...], ...] = eqx.field(static=True)

    @property
    def coloured(self) -> Bool[np.ndarray, " joints"]:
        """Joints whose noise is coloured, so that its level above the motion is too low."""
        return np.asarray(np.all(np.array(self.sources) == "unpredicted", axis=0))


def floor_of(
    loop: ClosedLoop, recordings: Recordings, beside: Iterable[Recording] = ()
) -> Floor | None:
    """The noise floor of compared signals, from repeats of a reference or above the motion.

    None if positions are compared.

    **Arguments:**

    - `loop`: its controller determines the compared signals; its model is not used.
    - `beside`: further recordings of the robot. They may repeat a reference, or show that noise is
      not white.
    """
    if loop.controller.judged == "position":
        return None
    asked = len(recordings)
    recordings = Recordings.of((*recordings, *beside))
    repeats = from_repeats(recordings, lambda pair, rows: compared(loop, pair, list(rows)))
    band = band_of(loop, recordings)
    torque = compared(loop, recordings, [r.tau for r in recordings])
    cutoffs = [loop.controller.comparable(r) or signal_cutoff(r) for r in recordings]
    moving = [Standstill().moving(r, cutoff) for r, cutoff in zip(recordings, cutoffs, strict=True)]
    gains = np.ones((len(cutoffs), 1)) if band is None else [np.asarray(x) for x in band.gain]
    shares = [float(np.mean(np.square(gain))) for gain in gains]
    levels = [
        tuple(x or y for x, y in zip(repeats.get(r.name, above), above, strict=True))
        for r, above in zip(
            recordings, above_motion(recordings, cutoffs, moving, shares), strict=True
        )
    ]
    return _relative(levels[:asked], torque[:asked])


def _relative(levels: Sequence[tuple[Level | None, ...]], torque: Sequence[np.ndarray]) -> Floor:
    """Levels over the size of the compared torque; rows that are not compared are zero."""
    shape = len(levels), len(levels[0])
    numbers = np.full((3, *shape), np.nan)
    for k, (row, tau) in enumerate(zip(levels, torque, strict=True)):
        for j, level in enumerate(row):
            there, size = np.count_nonzero(tau[:, j]), np.linalg.norm(tau[:, j])
            if level is not None and size > 0:
                values = np.array([level.value, level.low, level.high])
                numbers[:, k, j] = 100 * values * np.sqrt(there) / size
    sources = tuple(tuple("" if x is None else x.source for x in row) for row in levels)
    percent, low, high = numbers
    return Floor(percent, low, high, sources)
