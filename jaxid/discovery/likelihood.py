"""The score by which models are compared: likelihood of the recordings, and price of the model."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..estimate import Fit
from ..estimate.prior import prior_of
from ..noise import ARFilter
from .data import Data
from .separate import HIGHEST, filter_of


class Score(eqx.Module):
    """The score S = -2 log L + r'r + k log n + 2 log C(P, s), and the noise filters of the model.

    L is the likelihood of the fitted recordings, n the number of compared samples of all joints, k
    the number of estimated values (minus combinations that the recordings do not determine) and
    filter coefficients, and C(P, s) the number of sets of s of P effects. r is the distance of the
    values from those that were expected before the recordings, in deviations. A smaller score is
    better: the weight of a model is proportional to exp(-S/2) (Schwarz 1978; Chen and Chen 2008).
    """

    value: float
    noise: tuple[ARFilter, ...]


def score(
    data: Data,
    rest: Float[np.ndarray, "recordings samples outputs"],
    freedom: int,
    size: int,
    offered: int,
    taken: Float[np.ndarray, " absorbed"] | None = None,
) -> Score:
    """The score of a model, with noise filters that are estimated from its residual.

    **Arguments:**

    - `data`: its mask says which samples are compared.
    - `rest`: the residual of the model.
    - `freedom`: number of estimated physical values.
    - `size`: number of chosen effects. `offered`: number of effects to choose from.
    - `taken`: changes of the base's values that belong to the residual; none if None.
    """
    outputs = range(rest.shape[2])
    series = [[r[m, j] for r, m in zip(rest, data.mask, strict=True)] for j in outputs]
    paid = price(size, offered) + float(np.sum(data.known_left(taken) ** 2))
    return _scored(series, freedom, paid)


def score_of(fit: Fit, size: int = 0, offered: int = 0) -> Score:
    """The score of a fit, comparable with that of a prediction by `score`."""
    series = [[r[:, j] for r in fit.residuals] for j in range(fit.residuals[0].shape[1])]
    paid, prior = price(size, offered), prior_of(fit.loop, fit.recordings)
    if prior is not None:
        paid += float(np.sum(np.square(prior.left(np.asarray(fit.theta)))))
    return _scored(series, len(fit.names) - len(fit.undetermined), paid)


def price_of_value(fit: Fit) -> float:
    """Price of one estimated value in a score: the logarithm of the number of compared samples."""
    return float(np.log(sum(map(np.count_nonzero, fit.residuals))))


def noise_filters(
    residuals: Sequence[Float[np.ndarray, "_samples joints"]],
) -> tuple[ARFilter, ...]:
    """The noise filters of residuals, one per joint, as in a score."""
    joints = range(residuals[0].shape[1])
    return tuple(filter_of([r[:, j] for r in residuals], HIGHEST) for j in joints)


def _scored(series: Sequence[Sequence[np.ndarray]], freedom: int, paid: float) -> Score:
    # Rows at which a joint is at rest are zero, and are not counted.
    total = max(sum(np.count_nonzero(s) for rows in series for s in rows), 1)
    value, noise = 0.0, []
    for rows in series:
        # The mean is not subtracted: the model must explain it.
        found = filter_of(rows, HIGHEST)
        size = np.array([np.count_nonzero(s) for s in rows])
        value += sum(found.starts(s != 0) for s in rows)
        # Each recording has its own noise level if that lowers the score.
        power = np.array([np.sum(found.innovations(s, s != 0) ** 2) for s in rows])
        power = np.maximum(power / np.maximum(size, 1), 1e-300)
        mean = max(float(size @ power) / max(size.sum(), 1), 1e-300)
        apart = float(size @ np.log(power)) + (len(rows) - 1) * math.log(total)
        value += min(size.sum() * math.log(mean), apart)
        freedom += found.order
        noise.append(ARFilter(found.coefficients, mean))
    if not math.isfinite(value):
        return Score(math.inf, tuple(noise))
    return Score(value + freedom * math.log(total) + paid, tuple(noise))


def price(size: int, offered: int) -> float:
    """2 log of the number of sets of that size: the price of the choice (Chen and Chen 2008)."""
    return 2 * math.log(math.comb(max(offered, size), size))


def weights(values: Sequence[float]) -> Float[np.ndarray, " models"]:
    """Posterior weights of models from their scores (Madigan and Raftery 1994)."""
    array = np.asarray(values, float)
    raw = np.exp(-0.5 * (array - array.min()))
    return raw / raw.sum()
