"""Display of results in a notebook: the table, then the figure."""

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
        # Only IPython calls this method, so IPython is installed.
        from IPython.core.getipython import get_ipython  # type: ignore[import-not-found]
        from IPython.display import display  # type: ignore[import-not-found]

        display({"text/html": self._repr_html_(), "text/plain": repr(self)}, raw=True)
        # A terminal would open a browser for the figure.
        if hasattr(get_ipython(), "kernel"):
            display(self.plot())
