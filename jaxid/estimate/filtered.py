"""The filtered regression model: a first-order low-pass instead of accelerations."""

from typing import Literal

import equinox as eqx

from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ._operators import Operator
from ._split import EncoderWeights, fit_rows, split_rows
from .integral import default_pole
from .result import AbstractMethod, Fit
from .states import AbstractStates, LowPass


class FilteredLS(AbstractMethod):
    """Least squares on the split regression through a first-order low-pass.

    Momentum is differentiated by s λ / (s + λ) (Slotine, Li 1987; Appendix D of Li, Peng, Juang
    2023). This needs velocities in terms for which `IntegralLS` needs positions.

    **Arguments:**

    - `pole`: λ, 1/s; by default the frequency above which the motion's spectrum is noise.
    - `transient`, `states`, `weights`: as for `IntegralLS`.
    """

    pole: float | None = eqx.field(static=True, default=None)
    transient: Literal["modelled", "dropped", "ignored"] = eqx.field(
        static=True, default="modelled"
    )
    states: AbstractStates = LowPass()
    weights: EncoderWeights = eqx.field(static=True, default="joint")
    rigid = True

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the parameters in which torque is linear; called by `jaxid.fit`."""

        def rows(recording: Recording):
            operator = Operator.of((self.pole or default_pole(recording),), recording)
            return split_rows(loop, recording, self, self.states, operator, self.transient)

        return fit_rows(loop, recordings, self, self.weights, rows)
