"""A search as it is watched: what is tried, the time left, and the error of each model."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..display import figures
from ..display.progress import Pace
from .models import Model

# What a search is expected to do from its start, and what after the fit of a set: fits, screening
# of the whole catalogue, a look at sets in the linear system.
ROUND = ("screen", "look")
_COURSE = ("fit", "screen", "fit", "screen", "look", "fit", *ROUND)


class Watched:
    """Tells what a search does, and draws the error of each model that it has fitted.

    **Arguments:**

    - `say`: takes a text and `left`, the time left in s.
    - `draw`: takes what makes a figure.
    """

    def __init__(self, say: Callable[..., None], draw: Callable[[Callable[[], Any]], None]) -> None:
        self.say, self._draw = say, draw
        self._pace = Pace(_COURSE)
        self._labels: list[str] = []
        self._errors: list[np.ndarray] = []

    def begin(self, kind: str, text: str, then: Sequence[str] | None = None) -> None:
        """Says what begins, and how long all is likely to take from there.

        **Arguments:**

        - `kind`: `"fit"`, `"screen"` or `"look"`.
        - `then`: what is expected after it, where that has changed.
        """
        self.say(text, left=self._pace.begin(kind, then))

    def fitted(self, model: Model) -> None:
        """Draws the errors of all models that were fitted, with one more of them."""
        assert model.left is not None
        self._labels.append(model.label)
        self._errors.append(model.left)
        errors = {"fitted": np.stack(self._errors)}
        self._draw(lambda: figures.error_falling(self._labels, errors, title="model by model"))
