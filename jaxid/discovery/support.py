"""Cross-validation of effects: stretches of the recordings are left out of their estimate."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ..effects import AbstractEffect
from .data import Data
from .explore import Candidate
from .hypotheses import free_of
from .predict import Predictor

# Smallest number of stretches that are left out in turn, of all recordings and of each recording.
_STRETCHES, _LEAST = 6, 2
# Smallest ratio of what an effect explains of left-out stretches to what it explains of the same
# stretches if they are fitted.
# For noise the ratio is negative. For an effect that acts in some stretches only, such as friction
# in slow motion, it is near one.
_SUPPORTED = 0.3
# Share of a column's power that the other stretches must contain to determine its value.
_WEAK = 1e-4
# Number of the rows of a prior, which belong to every estimate.
_ALWAYS = -1


def unsupported(predictor: Predictor, c: Candidate) -> tuple[AbstractEffect, ...]:
    """Effects of a set that do not explain stretches that were left out of their estimate.

    The score assumes that the residual is noise with a stationary spectrum. On a real arm the
    residual of a rigid model depends on the motion, and an effect with many values can follow a
    stretch of it. Therefore each stretch is predicted in the linear system from values that are
    estimated on all other stretches. Effects that may act in a single stretch, such as stops and
    torque limits (`local`), are not tested.

    **Arguments:**

    - `predictor`: the linear system of the fitted model.
    - `c`: a set of additional effects with values estimated in that system.
    """
    stretch = _stretches(predictor.data)
    return tuple(
        effect
        for k, effect in enumerate(c.effects)
        if not effect.local and _share(predictor, c, k, stretch) < _SUPPORTED
    )


def _share(
    predictor: Predictor, c: Candidate, which: int, stretch: Int[np.ndarray, " rows"]
) -> float:
    """Ratio of what an effect explains of left-out stretches to what it explains of fitted ones."""
    data = predictor.data
    shown = predictor.shown(c.effects[which])[..., 0]
    # The target is the residual without the effect. An amplitude that the other stretches do not
    # determine is then estimated as zero, not as its value in the fit.
    target = data.white_residual(c.rest + shown, c.noise, c.taken)
    parts = data.base, c.prediction.moved
    columns = data.white_columns(np.concatenate(parts, axis=-1), c.noise, slice(None))
    own = data.base.shape[-1] + _values_of(c.effects, which)
    others = np.setdiff1d(np.arange(columns.shape[1]), own)
    less = _errors(target, columns[:, others], stretch)
    more = _errors(target, columns, stretch)
    return float((less[1] - more[1]) / max(less[0] - more[0], 1e-300))


def _values_of(effects: Sequence[AbstractEffect], which: int) -> Int[np.ndarray, " values"]:
    """Places of an effect's free values among those of the set."""
    counts = [sum(p.size for p in free_of(e)) for e in effects]
    return sum(counts[:which]) + np.arange(counts[which])


def _stretches(data: Data) -> Int[np.ndarray, " rows"]:
    """The number of the stretch of each whitened row, the rows of a prior last."""
    each = max(_LEAST, -(-_STRETCHES // len(data.mask)))
    # Each recording is cut by its own compared rows, since short ones are padded.
    passed = np.cumsum(data.mask, axis=1) - data.mask
    number = passed * each // np.maximum(data.mask.sum(axis=1, keepdims=True), 1)
    both = np.minimum(number, each - 1) + each * np.arange(len(data.mask))[:, None]
    rows = np.repeat(both.reshape(-1), data.residual.shape[2])
    return np.append(rows, np.full(len(data.known_left()), _ALWAYS))


def _errors(
    target: Float[np.ndarray, " rows"],
    columns: Float[np.ndarray, "rows columns"],
    stretch: Int[np.ndarray, " rows"],
) -> tuple[float, float]:
    """Squared errors of least squares on all rows, and of the prediction of left-out stretches."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    gram, along = columns.T @ columns, columns.T @ target
    weak = _WEAK * np.eye(len(gram))
    fitted = target - columns @ np.linalg.solve(gram + weak, along)
    measured = stretch != _ALWAYS
    apart = 0.0
    for k in np.unique(stretch[measured]):
        rows, y = columns[stretch == k], target[stretch == k]
        values = np.linalg.solve(gram - rows.T @ rows + weak, along - rows.T @ y)
        apart += float(np.sum((y - rows @ values) ** 2))
    return float(fitted[measured] @ fitted[measured]), apart
