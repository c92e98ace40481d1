"""Direct differences, a baseline for all other methods."""

import equinox as eqx

from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ._split import EncoderWeights, fit_rows, motion_rows
from .result import AbstractMethod, Fit
from .states import AbstractStates, Differences


class DifferenceLS(AbstractMethod):
    """Least squares along velocity and acceleration by differences, without any filter.

    The direct difference model of Li, Peng and Juang 2023. Encoder errors are amplified by 1/T and
    1/T².

    **Arguments:**

    - `states`: the scheme of differences.
    - `weights`: `"joint"` (each joint by its own deviation), or `"encoder"` (the covariance that
      follows from the recordings' resolution).
    """

    states: AbstractStates = Differences()
    weights: EncoderWeights = eqx.field(static=True, default="joint")
    rigid = True

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the parameters in which torque is linear; called by `jaxid.fit`."""

        def rows(recording: Recording):
            return motion_rows(loop, recording, self.states)

        return fit_rows(loop, recordings, self, self.weights, rows)
