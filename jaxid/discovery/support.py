"""Whether effects explain stretches of the recordings from which they were not estimated."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ..effects import AbstractEffect, AbstractTransmission, TorqueSaturation
from .explore import Candidate
from .hypotheses import free_of
from .predict import Predictor

# Stretches that are left out one after the other, of all recordings together and of each at least.
_STRETCHES, _LEAST = 6, 2
# Share of what an effect explains that it must explain where it was not estimated. Noise that was
# taken for an effect explains less than nothing there; an effect that is at work in some of the
# stretches only, such as friction at slow motion, explains most of it.
_SUPPORTED = 0.3
# Share of a column's power that the other stretches must hold to determine its value.
_WEAK = 1e-4


def unsupported(predictor: Predictor, c: Candidate) -> tuple[AbstractEffect, ...]:
    """Effects of a set that do not explain stretches from which they were not estimated.

    The score takes what is left for noise of a known spectrum. What a rigid model leaves of a real
    arm is not: it repeats with the motion, and a flexible effect can follow a stretch of it. Each
    stretch is predicted from values that are estimated, in the linear system, on all the others.
    Contacts and limits, which one stretch alone may show, are not judged.

    **Arguments:**

    - `predictor`: the linear system of the fitted model.
    - `c`: a set beside that model, refined there.
    """
    stretch = _stretches(predictor)
    return tuple(
        effect
        for k, effect in enumerate(c.effects)
        if not isinstance(effect, AbstractTransmission | TorqueSaturation)
        and _share(predictor, c, k, stretch) < _SUPPORTED
    )


def _share(
    predictor: Predictor, c: Candidate, which: int, stretch: Int[np.ndarray, " rows"]
) -> float:
    """What an effect explains of stretches that were left out, over what it does where fitted."""
    data = predictor.data
    shown = predictor.shown(c.effects[which])[..., 0]
    # Without the effect: an amplitude that no other stretch tells is nothing, and not what it was.
    parts = (c.rest + shown)[..., None], data.base, c.prediction.moved
    rows = data.white(np.concatenate(parts, axis=-1), c.noise)
    target, columns = np.split(rows.reshape(-1, rows.shape[-1]), [1], axis=1)
    own = data.base.shape[-1] + _values_of(c.effects, which)
    others = np.setdiff1d(np.arange(columns.shape[1]), own)
    less = _errors(target[:, 0], columns[:, others], stretch)
    more = _errors(target[:, 0], columns, stretch)
    return float((less[1] - more[1]) / max(less[0] - more[0], 1e-300))


def _values_of(effects: Sequence[AbstractEffect], which: int) -> Int[np.ndarray, " values"]:
    """Places of an effect's free values among those of a set."""
    counts = [sum(p.size for p in free_of(e)) for e in effects]
    return sum(counts[:which]) + np.arange(counts[which])


def _stretches(predictor: Predictor) -> Int[np.ndarray, " rows"]:
    """The number of the stretch in which each whitened row is."""
    recordings, samples, outputs = predictor.data.residual.shape
    each = max(_LEAST, -(-_STRETCHES // recordings))
    number = np.arange(samples) * each // samples
    both = number[None, :] + each * np.arange(recordings)[:, None]
    return np.repeat(both.reshape(-1), outputs)


def _errors(
    target: Float[np.ndarray, " rows"],
    columns: Float[np.ndarray, "rows columns"],
    stretch: Int[np.ndarray, " rows"],
) -> tuple[float, float]:
    """Squared error of least squares on all rows, and of rows whose stretch was left out."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    gram, along = columns.T @ columns, columns.T @ target
    weak = _WEAK * np.eye(len(gram))
    fitted = target - columns @ np.linalg.solve(gram + weak, along)
    apart = 0.0
    for k in np.unique(stretch):
        rows, y = columns[stretch == k], target[stretch == k]
        values = np.linalg.solve(gram - rows.T @ rows + weak, along - rows.T @ y)
        apart += float(np.sum((y - rows @ values) ** 2))
    return float(fitted @ fitted), apart
