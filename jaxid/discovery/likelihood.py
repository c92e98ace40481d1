"""The one score of all models: how likely the recordings are, and the price of what was chosen."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..estimate import Fit
from ..noise import ARFilter, fit_ar
from .score import Data

# Largest order of a model's noise filters.
_HIGHEST = 30


class Score(eqx.Module):
    """S = -2 log L + k log n + 2 log(models of that size), with the filters that belong to it.

    Less is better: exp(-S/2) is a model's weight (Schwarz 1978; Chen and Chen 2008).
    """

    value: float
    noise: tuple[ARFilter, ...]


def score(
    data: Data,
    rest: Float[np.ndarray, "recordings samples outputs"],
    freedom: int,
    size: int,
    offered: int,
) -> Score:
    """The score of a model, with noise filters of its own.

    **Arguments:**

    - `data`: which samples there are, and how loud noise is in each recording.
    - `rest`: what the model leaves.
    - `freedom`: how many physical values were estimated.
    - `size`: how many effects were chosen, of `offered` that could have been.
    """
    series = [data.series(rest, j) for j in range(rest.shape[2])]
    return _scored(series, freedom, price(size, offered))


def score_of(
    fit: Fit,
    level: Float[np.ndarray, "recordings outputs"] | None = None,
    size: int = 0,
    offered: int = 0,
) -> Score:
    """The score of a fit, as `score` has it for what was predicted."""
    residuals, outputs = fit.residuals, fit.residuals[0].shape[1]
    alike = np.ones((len(residuals), outputs)) if level is None else level
    series = [
        [r[:, j] / loud[j] for r, loud in zip(residuals, alike, strict=True)]
        for j in range(outputs)
    ]
    return _scored(series, len(fit.names), price(size, offered))


def _scored(series: Sequence[Sequence[np.ndarray]], freedom: int, paid: float) -> Score:
    total, value, noise = 0, 0.0, []
    for rows in series:
        # A mean is the model's to explain, and not taken off.
        found = fit_ar(rows, highest=_HIGHEST, criterion="bic")
        count = sum(len(s) for s in rows)
        value += count * math.log(max(found.variance, 1e-300))
        freedom += found.order
        total += count
        noise.append(found)
    if not math.isfinite(value):
        return Score(math.inf, tuple(noise))
    return Score(value + freedom * math.log(total) + paid, tuple(noise))


def price(size: int, offered: int) -> float:
    """2 log of how many sets of that size there are: what it costs to have searched."""
    return 2 * math.log(math.comb(max(offered, size), size))


def weights(values: Sequence[float]) -> Float[np.ndarray, " models"]:
    """Posterior weights of models by their scores (Madigan and Raftery 1994)."""
    array = np.asarray(values, float)
    raw = np.exp(-0.5 * (array - array.min()))
    return raw / raw.sum()
