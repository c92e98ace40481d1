"""Least squares along a Fourier series fitted to periodic motion."""

import equinox as eqx

from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ._split import EncoderWeights, fit_rows, motion_rows
from .result import AbstractMethod, Fit
from .states import FourierStates


class FourierLS(AbstractMethod):
    """Least squares along the position, velocity and acceleration of a fitted Fourier series.

    For periodic excitation (Swevers et al. 1997; Li, Peng, Juang 2023). The number of harmonics is
    chosen by BIC, with joints weighted by the errors of their encoders.

    **Arguments:**

    - `period`: period of the motion, s; detected if None.
    - `harmonics`: number of harmonics; chosen if None.
    - `weights`: `"joint"` (each joint by its own deviation), or `"encoder"` (the covariance that
      follows from the recordings' resolution, to first order). With `"encoder"` motion outside the
      series counts as noise: deviations are too large for fine encoders and too small for coarse
      ones.
    """

    period: float | None = eqx.field(static=True, default=None)
    harmonics: int | None = eqx.field(static=True, default=None)
    weights: EncoderWeights = eqx.field(static=True, default="joint")
    rigid = True

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the parameters in which torque is linear; called by `jaxid.fit`."""
        states = FourierStates(self.period, self.harmonics)

        def rows(recording: Recording):
            return motion_rows(loop, recording, states)

        return fit_rows(loop, recordings, self, self.weights, rows)
