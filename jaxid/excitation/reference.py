"""An excitation: a reference that determines the parameters, with its predicted accuracy."""

import html
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..display.shown import AbstractShown
from ..recording import Recording
from ..signals.fourier import FourierSeries
from ..simulation.loop import ClosedLoop
from ._information import torque_along
from .limits import Limits, margins_along

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


class Excitation(AbstractShown):
    """A reference that determines the parameters, with its predicted accuracy.

    - `series`: the reference as a Fourier series; `reference()` samples it.
    - `std`: predicted standard deviations of the parameters `names`, for one period and the assumed
      torque noise.
    - `margins`: margin by limit and joint, in percent; for the workspace the value of its function,
      usually in m. No margin is negative.
    - `score`: logarithm of the criterion, with parameters in units of their scales; for the
      determinant and p parameters, of det(covariance)^(1 / 2p), the size of one deviation.
    """

    loop: ClosedLoop
    series: FourierSeries
    limits: Limits
    covariance: Float[np.ndarray, "parameters parameters"]
    names: tuple[str, ...] = eqx.field(static=True)
    undetermined: tuple[str, ...] = eqx.field(static=True)
    margins: "pd.DataFrame"
    score: float
    rate: float = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    @property
    def std(self) -> Float[np.ndarray, " parameters"]:
        """Predicted standard deviations, in the units of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def reference(self, periods: int = 1, rate: float | None = None) -> Recording:
        """The reference sampled, with the torque that it needs as `tau`.

        **Arguments:**

        - `periods`: number of repetitions. `rate`: Hz; by default the rate of the design.
        """
        rate = rate or self.rate
        time = np.arange(round(periods * self.series.period * rate) + 1) / rate
        signals = np.asarray(self.series(time))
        tau = np.asarray(torque_along(self.loop, jnp.asarray(time), jnp.asarray(signals)))
        return Recording(time, signals[0], tau, q_ref=signals[0], v=signals[1], name="excitation")

    def table(self) -> "pd.DataFrame":
        """Predicted deviations."""
        import pandas as pd

        known = {
            name: unit
            for p in self.loop.parameters
            for name, unit in zip(p.names, self.loop.units(p), strict=True)
        }
        units = [known[name] for name in self.names]
        return pd.DataFrame(
            {"std": self.std, "unit": units}, index=pd.Index(self.names, name="parameter")
        )

    def plot(self) -> "go.Figure":
        """The reference in time."""
        from ..display import figures

        r = self.reference()
        units = self.loop.arm.units()[1]
        panels = [
            [figures.Trace(f"joint {j}", column, unit, "reference")]
            for j, (column, unit) in enumerate(zip(r.q.T, units, strict=True), start=1)
        ]
        return figures.signals(r.time, panels)

    def __repr__(self) -> str:
        lines = [
            self._head(),
            self.table().to_string(float_format=lambda x: f"{x:.3g}"),
            "margins to the limits, %:",
            self.margins.to_string(float_format=lambda x: f"{x:.3g}"),
        ]
        return "\n".join([*lines, *self.undetermined])

    def _repr_html_(self) -> str:
        foot = "".join(f"<p>{html.escape(s)}</p>" for s in self.undetermined)
        return (
            f"<p>{html.escape(self._head())}</p>"
            f"{self.table().to_html(float_format=lambda x: f'{x:.3g}')}"
            f"<p>margins to the limits, %</p>{self.margins.to_html(float_format='%.3g')}{foot}"
        )

    def _head(self) -> str:
        return (
            f"a reference of {self.series.period:g} s and {self.series.harmonics} harmonics for "
            f"{self.loop.name}, by its {self.kind} information"
        )


def margins_on(
    excitation: Excitation, time: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "points kinds"]:
    """Margin of a reference to each limit at times, s, as a fraction of it."""
    signals = jnp.asarray(excitation.series(time))
    tau = torque_along(excitation.loop, jnp.asarray(time), signals)
    rows, inside = margins_along(excitation.limits, signals, tau)
    return np.concatenate([np.asarray(rows).reshape(len(rows), -1), np.asarray(inside)], axis=1)
