"""The figure of an explorer: torque and residual of one joint, as fitted and with an effect."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..display import figures

# Samples of a recording that are drawn: more than a screen has columns, few enough to send at once.
_DRAWN = 1500
# Which traces change with the effect.
_PREDICTED, _REST = 2, 4


class Picture:
    """A plotly widget of one recording and joint, two lines of which follow the effect.

    A widget that is not on a screen yet loses what is changed in it, so there is a new one for
    each view.

    **Arguments:**

    - `time`: s. `measured`, `simulated`: the model as fitted, in `unit`.
    - `name`: of the signal, as its axis has it.
    """

    def __init__(
        self,
        time: Float[np.ndarray, " rows"],
        measured: Float[np.ndarray, " rows"],
        simulated: Float[np.ndarray, " rows"],
        rest: Float[np.ndarray, " rows"],
        name: str,
        unit: str,
    ) -> None:
        import plotly.graph_objects as go

        self._rows = slice(None, None, max(1, -(-len(time) // _DRAWN)))
        self._measured = measured
        time, before, left, rest = (
            x[self._rows] for x in (time, measured, measured - simulated, rest)
        )
        panels = [
            [
                figures.Trace("measured", before, unit),
                figures.Trace("as fitted", before - left, unit, "reference"),
                figures.Trace("with the effect", before - rest, unit, "simulated"),
            ],
            [
                figures.Trace("residual as fitted", left, unit, "measured"),
                figures.Trace("residual with the effect", rest, unit, "residual"),
            ],
        ]
        drawn = figures.signals(time, panels, titles=[name, "residual"])
        drawn.update_layout(height=470, autosize=True, margin={"l": 70, "r": 10, "b": 45})
        # The axes stay while the effect moves; else nothing but their numbers would be seen to.
        low, high = float(left.min()), float(left.max())
        room = 0.4 * (high - low)
        drawn.update_yaxes(range=[low - room, high + room], row=2, col=1)
        self.widget: Any = go.FigureWidget(drawn)

    def follow(self, rest: Float[np.ndarray, " rows"]) -> None:
        """Draws what the model says with the effect.

        **Arguments:**

        - `rest`: measured less predicted at all rows, in the unit of the signal.
        """
        drawn = rest[self._rows].astype(np.float32)
        predicted = self._measured[self._rows].astype(np.float32) - drawn
        with self.widget.batch_update():
            self.widget.data[_PREDICTED].y = predicted
            self.widget.data[_REST].y = drawn
