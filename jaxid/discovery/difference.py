"""Comparison of two models on the same recordings: which is better, and how certainly."""

import dataclasses
import html
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..display.shown import AbstractShown
from ..errors import ModelError, RecordingError
from ..estimate import Fit
from ..estimate.refit import drawn_noise, noise_strengths
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from .comparison import Comparison, compare
from .diagnosis import over_recordings
from .hypotheses import effect_on
from .landscape import form
from .likelihood import noise_filters, score_of
from .text import wrapped

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go

Rows = Sequence[Float[np.ndarray, "_samples joints"]]
Model = Fit | ClosedLoop
Given = Recording | Recordings | Iterable[Recording]

# Half width of a 95 % interval of a normal distribution, in standard deviations.
_WIDE = 1.96


class Change(eqx.Module):
    """A difference with its standard deviation over redrawn noise."""

    value: float
    std: float

    @property
    def interval(self) -> tuple[float, float]:
        """Ends of the 95 % interval."""
        return self.value - _WIDE * self.std, self.value + _WIDE * self.std

    @property
    def sure(self) -> bool:
        """Whether the 95 % interval excludes zero."""
        return abs(self.value) > _WIDE * self.std


class ModelDifference(AbstractShown):
    """First model minus second on the same recordings; a negative difference favours the first.

    The intervals are for redrawn noise on the same motions, with the parameter values of both
    models unchanged. The noise is that of the model with the smaller residual. The intervals do
    not cover model errors on other motions.

    - `names`: names of the two models.
    - `first`, `second`: their comparisons with the recordings.
    - `score`: difference of S on the recordings that both were fitted to; None if these differ.
    - `errors`: difference of the relative error by joint, %.
    """

    names: tuple[str, str] = eqx.field(static=True)
    first: Comparison
    second: Comparison
    score: Change | None
    errors: tuple[Change, ...]

    def table(self) -> "pd.DataFrame":
        """Relative error of both models by joint, their difference and its 95 % interval, %."""
        import pandas as pd

        one, other = (
            over_recordings(x.error_percent.to_numpy()) for x in (self.first, self.second)
        )
        rows = [
            {"first": a, "second": b, "difference": c.value, "low": low, "high": high}
            for a, b, c in zip(one, other, self.errors, strict=True)
            for low, high in [c.interval]
        ]
        joints = self.first.error_percent.columns
        return pd.DataFrame(rows, index=pd.Index(joints, name="relative error, %"))

    def plot(self) -> "go.Figure":
        """The difference of the relative error by joint with its 95 % interval."""
        from ..display import figures

        values = np.array([c.value for c in self.errors])
        half = np.array([_WIDE * c.std for c in self.errors])
        joints = list(self.first.error_percent.columns)
        name = f"error of {self.names[0]} minus that of {self.names[1]}"
        return figures.differences(joints, values, half, x_name=name, x_unit="%")

    def to_dict(self) -> dict[str, Any]:
        """Both models, the differences and their 95 % intervals as plain JSON."""

        def told(change: Change) -> dict[str, Any]:
            return {"difference": change.value, "interval": list(change.interval)}

        return {
            "first": self.names[0],
            "second": self.names[1],
            "recordings": list(self.first.recordings.names),
            "score": None if self.score is None else told(self.score),
            "error_percent": [told(change) for change in self.errors],
        }

    def __repr__(self) -> str:
        lines = [x for line in self._head() for x in wrapped(line)]
        return "\n".join([*lines, "", self._rows().to_string()])

    def _repr_html_(self) -> str:
        head = "".join(f"<p>{html.escape(line)}</p>" for line in self._head())
        return f"{head}{self._rows().to_html()}"

    def _head(self) -> list[str]:
        lines = [f"first:  {self.names[0]}", f"second: {self.names[1]}"]
        if self.score is not None:
            lines.append(
                f"score, first minus second: {self.score.value:.1f} ({_interval(self.score, 1)}): "
                f"{_better(self.score)}"
            )
        names = ", ".join(self.first.recordings.names)
        lines.append(f"relative error on {names}, %, and first minus second, with 95 % intervals:")
        return lines

    def _rows(self) -> "pd.DataFrame":
        """The table as text."""
        import pandas as pd

        table, joints = self.table(), self.errors
        columns = {
            **{name: [f"{x:.3f}" for x in table[name]] for name in ("first", "second")},
            "difference": [f"{x.value:+.3f}" for x in joints],
            "95 % interval": [_interval(x, 3) for x in joints],
            "": [_better(x) for x in joints],
        }
        return pd.DataFrame(columns, index=table.index.rename(None))


def compare_models(
    first: Model,
    second: Model,
    recordings: Given | None = None,
    *,
    window: float | None = None,
) -> ModelDifference:
    """Compares two models on the same recordings: which is better, and how certainly.

    Noise is redrawn from an autoregressive filter of the better model's residual. Both models are
    compared with each draw, with their parameter values unchanged. The standard deviation of the
    differences gives the intervals. A difference of S is available for two fits of the same
    recordings.

    **Arguments:**

    - `first`, `second`: fits or loops.
    - `recordings`: recordings on which errors are compared, preferably held-out ones; by default
      those that both were fitted to.
    - `window`: as for `compare`.

    **Raises:** `RecordingError` if there are no recordings to compare on; `ModelError` if the two
    models do not predict the same signal; `FitError` if a loop cannot be simulated.
    """
    shared = _shared(first, second)
    if recordings is None:
        if shared is None:
            raise RecordingError(
                "these two models were not fitted to the same recordings: give recordings for the "
                "comparison, compare_models(first, second, recordings)"
            )
        recordings = shared[0].recordings
    recordings = Recordings.of(recordings)
    one, other = (compare(m, recordings, window=window) for m in (first, second))
    if one.signal != other.signal or _sizes(one.residuals) != _sizes(other.residuals):
        raise ModelError(
            f"{one.loop.name} and {other.loop.name} do not predict the same samples of the same "
            "signal: give both the same controller"
        )
    score = None if shared is None else _score_change(*shared)
    names = _names(one.loop, other.loop)
    return ModelDifference(names, one, other, score, _error_changes(one, other))


def _better(change: Change) -> str:
    """The better model in words; smaller scores and errors are better."""
    if not change.sure:
        return "not distinguished"
    return f"the {'first' if change.value < 0 else 'second'} is better"


def _interval(change: Change, digits: int) -> str:
    low, high = change.interval
    return f"{low:.{digits}f} to {high:.{digits}f}"


def _shared(first: Model, second: Model) -> tuple[Fit, Fit] | None:
    """The two models as fits of the same recordings; None if they are not."""
    if not (isinstance(first, Fit) and isinstance(second, Fit)):
        return None
    pairs = list(zip(first.recordings, second.recordings, strict=False))
    alike = len(first.recordings) == len(second.recordings) and all(
        a.same_samples(b) for a, b in pairs
    )
    same = alike and _sizes(first.residuals) == _sizes(second.residuals)
    return (first, second) if same else None


def _sizes(rows: Rows) -> list[tuple[int, ...]]:
    return [r.shape for r in rows]


def _names(one: ClosedLoop, other: ClosedLoop) -> tuple[str, str]:
    """Names of two models, by the effects that the other model does not have."""
    had = [Counter(form(e) for e in loop.effects) for loop in (one, other)]
    more = [had[0] - had[1], had[1] - had[0]]
    said = [
        " + ".join([loop.name, *(effect_on(name, joint) for name, joint, _ in extra)])
        for loop, extra in zip((one, other), more, strict=True)
    ]
    if said[0] == said[1]:
        said = [f"{said[0]} (first)", f"{said[1]} (second)"]
    return said[0], said[1]


def _score_change(first: Fit, second: Fit) -> Change:
    def score(rows: tuple[Rows, Rows]) -> Float[np.ndarray, " values"]:
        one, other = (
            score_of(dataclasses.replace(fit, residuals=tuple(r))).value
            for fit, r in zip((first, second), rows, strict=True)
        )
        return np.array([one - other])

    return changes((first.residuals, second.residuals), score)[0]


def _error_changes(one: Comparison, other: Comparison) -> tuple[Change, ...]:
    left = [np.stack([np.linalg.norm(r, axis=0) for r in x.residuals]) for x in (one, other)]
    # From the model with the larger residual, because a zero residual gives no scale.
    larger = one if left[0].sum() > left[1].sum() else other
    scale = larger.error_percent.to_numpy() / np.maximum(left[larger is other], 1e-300)

    def error(rows: tuple[Rows, Rows]) -> Float[np.ndarray, " values"]:
        sizes = (np.stack([np.linalg.norm(r, axis=0) for r in part]) for part in rows)
        a, b = (over_recordings(scale * size) for size in sizes)
        return a - b

    return changes((one.residuals, other.residuals), error)


def changes(
    rows: tuple[Rows, Rows],
    statistic: Callable[[tuple[Rows, Rows]], Float[np.ndarray, " values"]],
    draws: int = 200,
    seed: int = 0,
) -> tuple[Change, ...]:
    """Values of a statistic of two models' residuals, and standard deviations for redrawn noise.

    The two residuals differ by the difference of the predictions, which is independent of the
    noise. The same redrawn noise is therefore used in both.

    **Arguments:**

    - `rows`: residuals of both models on the same recordings, in the unit of the signal.
    - `statistic`: function of such residuals that returns its values.
    - `draws`: number of noise draws. `seed`: seed of the noise.
    """
    power = [sum(float(np.sum(r**2)) for r in part) for part in rows]
    better = int(power[1] < power[0])
    near = rows[better]
    apart = [b - a for a, b in zip(near, rows[1 - better], strict=True)]
    # Rows at which a joint is at rest are zero and must remain zero.
    there = [(a != 0) | (b != 0) for a, b in zip(*rows, strict=True)]
    noise = noise_filters(near)
    strengths = noise_strengths(near, noise)
    rng = np.random.default_rng(seed)
    made = drawn_noise(noise, [len(r) for r in near], draws, rng, strengths)
    found = []
    for k in range(draws):
        drawn = [np.where(t, x[k], 0.0) for x, t in zip(made, there, strict=True)]
        pair = drawn, [a + b for a, b in zip(drawn, apart, strict=True)]
        found.append(statistic(pair if better == 0 else (pair[1], pair[0])))
    values, std = statistic(rows), np.std(found, axis=0, ddof=1)
    return tuple(Change(float(v), float(s)) for v, s in zip(values, std, strict=True))
