"""Progress of a search: the current activity, the time left, and the error of each model."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..display import figures
from ..display.progress import Pace
from .models import Model

# Expected activities after the fit of a set, and from the start of a search: fits, screening of the
# whole catalogue, exploration of sets in the linear system.
ROUND = ("screen", "look")
_COURSE = ("fit", "screen", "fit", "screen", "look", "fit", *ROUND)


class Watched:
    """Reports the activity of a search, and draws the error of each fitted model.

    **Arguments:**

    - `say`: function of a text and `left`, the time left in s.
    - `draw`: function of a function that makes a figure.
    """

    def __init__(self, say: Callable[..., None], draw: Callable[[Callable[[], Any]], None]) -> None:
        self.say, self._draw = say, draw
        self._pace = Pace(_COURSE)
        self._labels: list[str] = []
        self._errors: list[np.ndarray] = []

    def begin(self, kind: str, text: str, then: Sequence[str] | None = None) -> None:
        """Reports the start of an activity, and the expected time left for the search.

        **Arguments:**

        - `kind`: `"fit"`, `"screen"` or `"look"`.
        - `then`: activities expected after it, if these have changed.
        """
        self.say(text, left=self._pace.begin(kind, then))

    def fitted(self, model: Model) -> None:
        """Adds a fitted model, and draws the errors of all fitted models."""
        assert model.left is not None
        self._labels.append(model.label)
        self._errors.append(model.left)
        errors = {"fitted": np.stack(self._errors)}
        self._draw(
            lambda: figures.error_falling(self._labels, errors, title="error of each fitted model")
        )
