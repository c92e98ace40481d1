"""How a result shows itself in a notebook: its table, then its figure."""

import abc
from typing import TYPE_CHECKING

import equinox as eqx

if TYPE_CHECKING:
    import plotly.graph_objects as go


class AbstractShown(eqx.Module):
    """A result with a table in HTML and a figure."""

    @abc.abstractmethod
    def plot(self) -> "go.Figure":
        """The figure."""

    @abc.abstractmethod
    def _repr_html_(self) -> str:
        """The table, as HTML."""

    def _ipython_display_(self) -> None:
        # Called by IPython alone, and there is none without a user who has it.
        from IPython.core.getipython import get_ipython  # type: ignore[import-not-found]
        from IPython.display import display  # type: ignore[import-not-found]

        display({"text/html": self._repr_html_(), "text/plain": repr(self)}, raw=True)
        # At a terminal a figure would open a browser, which nobody asked for.
        if hasattr(get_ipython(), "kernel"):
            display(self.plot())
