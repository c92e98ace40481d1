"""The integral method: a second-order integral operator instead of derivatives."""

import math
from typing import Literal

import equinox as eqx

from ..recording import Recording, Recordings
from ..signals.smoothing import signal_cutoff
from ..simulation.loop import ClosedLoop
from ._operators import Operator
from ._split import EncoderWeights, fit_rows, split_rows
from .result import AbstractMethod, Fit
from .states import AbstractStates, LowPass


def default_pole(recording: Recording) -> float:
    """Angular frequency above which the recorded motion is noise, 1/s."""
    return min(2 * math.pi * signal_cutoff(recording), 0.3 * math.pi * recording.rate)


class IntegralLS(AbstractMethod):
    """Least squares on the split regression through a second-order integral operator.

    Every term is filtered by F(s) = λ1 λ2 / ((s + λ1)(s + λ2)). First and second derivatives become
    the filters s F(s) and s² F(s), integrated exactly over each sample. No acceleration is needed,
    and the inertial terms depend on position only (Li, Peng, Juang 2023, equation (42) and Appendix
    A).

    **Arguments:**

    - `lambda1`, `lambda2`: poles, 1/s; by default the frequency above which the motion's spectrum
      is noise.
    - `transient`: the response to the unknown initial state is `"modelled"` by two columns for each
      joint, `"dropped"` with the first ten time constants, or `"ignored"`.
    - `states`: source of velocities.
    - `weights`: `"joint"` (each joint by its own deviation), or `"encoder"` (Appendix C: the
      covariance that follows from the recordings' resolution).
    """

    lambda1: float | None = eqx.field(static=True, default=None)
    lambda2: float | None = eqx.field(static=True, default=None)
    transient: Literal["modelled", "dropped", "ignored"] = eqx.field(
        static=True, default="modelled"
    )
    states: AbstractStates = LowPass()
    weights: EncoderWeights = eqx.field(static=True, default="joint")
    rigid = True

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the parameters in which torque is linear; called by `jaxid.fit`."""

        def rows(recording: Recording):
            first = self.lambda1 or self.lambda2 or default_pole(recording)
            operator = Operator.of((first, self.lambda2 or first), recording)
            return split_rows(loop, recording, self, self.states, operator, self.transient)

        return fit_rows(loop, recordings, self, self.weights, rows)
