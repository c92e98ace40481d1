"""Figure of an explorer: torque and residual of one joint, without and with an effect."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..display import figures

# Drawn samples of a recording: enough for the resolution of a screen, and fast to transfer.
_DRAWN = 1500
# Which traces change with the effect.
_PREDICTED, _REST = 2, 4


class Picture:
    """A plotly widget of one recording and joint, two lines of which follow the effect.

    A widget that is not on the screen yet loses changes; `changed` tells whether there were any.

    **Arguments:**

    - `time`: s. `measured`, `simulated`: signals of the recording and the fitted model, in `unit`.
    - `name`: name of the signal on its axis.
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

        time, before, left, rest = self._drawn(time, measured, measured - simulated, rest)
        self.changed = False
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
        drawn.update_yaxes(range=_around(left), row=2, col=1)
        self.widget: Any = go.FigureWidget(drawn)

    def show(
        self,
        time: Float[np.ndarray, " rows"],
        measured: Float[np.ndarray, " rows"],
        simulated: Float[np.ndarray, " rows"],
        rest: Float[np.ndarray, " rows"],
        name: str,
        unit: str,
    ) -> None:
        """Shows another recording or joint; the arguments are those of the constructor."""
        time, before, left, rest = self._drawn(time, measured, measured - simulated, rest)
        self.changed = True
        lines = before, before - left, before - rest, left, rest
        with self.widget.batch_update():
            for trace, y in zip(self.widget.data, lines, strict=True):
                trace.x, trace.y = time, y
            self.widget.layout.yaxis.title.text = f"{name} ({unit})"
            self.widget.layout.yaxis2.title.text = f"residual ({unit})"
            self.widget.layout.yaxis2.range = _around(left)

    def follow(self, rest: Float[np.ndarray, " rows"]) -> None:
        """Draws the prediction of the model with the effect.

        **Arguments:**

        - `rest`: measured minus predicted at all rows, in the unit of the signal.
        """
        drawn = rest[self._rows].astype(np.float32)
        self.changed = True
        with self.widget.batch_update():
            self.widget.data[_PREDICTED].y = self._before - drawn
            self.widget.data[_REST].y = drawn

    def _drawn(
        self, time: np.ndarray, measured: np.ndarray, *others: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Rows to draw, in single precision; the measured ones are cached."""
        self._rows = slice(None, None, max(1, -(-len(time) // _DRAWN)))
        found = [x[self._rows].astype(np.float32) for x in (time, measured, *others)]
        self._before = found[1]
        return tuple(found)


def _around(residual: np.ndarray) -> list[float]:
    """A fixed axis range for a residual; automatic scaling would hide its changes."""
    low, high = float(residual.min()), float(residual.max())
    room = 0.4 * (high - low)
    return [low - room, high + room]
