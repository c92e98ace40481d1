"""Separation of noise and physics: noise filters are estimated with all effects in the model."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..noise import ARFilter, centred, fit_ar
from .data import Data, Rows
from .score import Blocks, Whitened, by_width, explained_by, strong_directions

# Largest order of a model's noise filters.
HIGHEST = 30


class Separated(eqx.Module):
    """The noise filters, one per output, and the blocks that were selected with them.

    `data` has the noise level of each recording; `bic` is that of filters, levels and blocks.
    """

    data: Data
    noise: tuple[ARFilter, ...]
    chosen: list[int]
    bic: float


def estimate_noise(data: Data, blocks: Blocks, alike: bool = False) -> Separated:
    """The noise filters and levels, and the blocks that were selected with them.

    There are two starting points. The first is the residual of the base; its filter may model a
    slow missing effect, such as a spring, as noise. The second is the residual of the base and the
    blocks that plain least squares selects, which may have absorbed slow noise. From each, blocks
    are selected through the filter, and the filter is estimated again with these in the model. The
    result with the better BIC is used.

    **Arguments:**

    - `alike`: whether all data have one noise level, because they are windows of recordings.
    """
    flat = tuple(
        ARFilter(np.zeros(0), sum(float(x @ x) for x in data.series(data.residual, j)) / rows)
        for j, rows in enumerate(np.maximum(data.compared.sum(axis=0), 1))
    )
    plain = leftover(data, flat, ())
    white = noise_of(data, plain, data.base.shape[-1], highest=0)
    rich = columns_of(blocks, select(Whitened.of(data, white), blocks))
    ends = [_settle(*levelled(data, plain, 0.0, alike), blocks, alike)]
    if rich:
        start = leftover(data, white, rich)
        ends.append(_settle(*levelled(data, start, len(rich), alike), blocks, alike))
    return min(ends, key=lambda end: end.bic)


def _settle(data: Data, noise: tuple[ARFilter, ...], blocks: Blocks, alike: bool) -> Separated:
    """Alternates the selection of signatures and the estimation of the filter."""
    chosen: list[int] = []
    columns: list[int] = []
    for _ in range(2):
        before = chosen
        chosen = select(Whitened.of(data, noise), blocks)
        columns = columns_of(blocks, chosen)
        rest = leftover(data, noise, columns)
        data, noise = levelled(data, rest, data.base.shape[-1] + len(columns), alike)
        if chosen == before:
            break
    size = data.compared
    spread = float(size.sum(axis=0) @ np.log([f.variance for f in noise]))
    free = len(columns) + sum(f.order for f in noise)
    if data.level is not None:
        spread += 2 * float(np.sum(size * np.log(data.level)))
        free += (len(size) - 1) * np.sum(np.any(data.level != 1, axis=0))
    return Separated(data, noise, chosen, float(spread + free * np.log(size.sum())))


def columns_of(blocks: Blocks, chosen: Sequence[int]) -> list[int]:
    """Columns of the chosen blocks."""
    return [c for k in chosen for c in blocks[k]]


def noise_of(data: Data, rows: Rows, lost: float, highest: int = HIGHEST) -> tuple[ARFilter, ...]:
    """One AR filter per output, with the variance corrected for the model's degrees of freedom.

    **Arguments:**

    - `rows`: the residual of a model.
    - `lost`: number of parameters of that model.
    - `highest`: largest order.
    """
    outputs, counted = rows.shape[2], data.compared.sum(axis=0)
    filters = []
    for j in range(outputs):
        series = [centred(s) for s in data.series(rows, j)]
        found = filter_of(series, highest)
        free = max(counted[j] - lost / outputs, counted[j] / 2, 1)
        variance = found.variance * counted[j] / free
        filters.append(ARFilter(found.coefficients, max(variance, 1e-300)))
    return tuple(filters)


def filter_of(series: Sequence[Float[np.ndarray, " _"]], highest: int) -> ARFilter:
    """The AR filter of one output's residuals, with a memory much shorter than the recordings.

    Slower noise cannot be separated from a missing effect: a filter with a long memory would model
    the torque of a spring as noise.
    """
    found = fit_ar(series, highest=highest, criterion="bic")
    return found.forgetting(max(len(x) for x in series) / _MEMORIES, series)


# Smallest ratio of the length of the longest recording to the memory of a filter.
_MEMORIES = 10


def levelled(
    data: Data, rows: Rows, lost: float, alike: bool = False
) -> tuple[Data, tuple[ARFilter, ...]]:
    """The data with the noise level of each recording, and the common filters.

    An output has several levels if its recordings differ significantly (BIC). Slow and fast motions
    may have different noise; with a common level, p-values of effects in the noisier recording
    would be too small.

    **Arguments:** as for `noise_of`, and

    - `alike`: whether there is only one level.
    """
    data = dataclasses.replace(data, level=None)
    noise = noise_of(data, rows, lost)
    if alike:
        return data, noise
    white = data.white(rows, noise)
    count = data.compared
    power = np.sum(white**2, axis=1) / np.maximum(count, 1)
    total = np.maximum(count.sum(axis=0), 1)
    mean = np.sum(count * power, axis=0) / total
    ratio = np.maximum(power / np.where(mean > 0, mean, 1.0), 1e-4)
    gain = -np.sum(count * np.log(ratio), axis=0)
    differ = (mean > 0) & (gain > (len(ratio) - 1) * np.log(total))
    if not differ.any():
        return data, noise
    data = dataclasses.replace(data, level=np.sqrt(np.where(differ, ratio, 1.0)))
    return data, noise_of(data, rows, lost)


def leftover(data: Data, noise: Sequence[ARFilter], columns: Sequence[int]) -> Rows:
    """The residual minus the best combination of base and signatures, whitened by `noise`."""
    picked = data.columns(columns).astype(float)
    wide = np.concatenate([data.base, picked], axis=-1)
    w = data.white_columns(wide, noise, slice(None))
    r = data.white_residual(data.residual, noise)
    size = np.linalg.norm(w, axis=0)
    size[size == 0] = 1.0
    w /= size
    damp = np.full(len(size), 1e-12)
    damp[data.base.shape[-1] :] += 1e-9
    theta = np.linalg.solve(w.T @ w + np.diag(damp), w.T @ r) / size
    return (data.residual - wide @ theta) * data.mask[..., None]


def select(white: Whitened, blocks: Blocks, most: int = 12, margin: float = 10.0) -> list[int]:
    """Blocks selected greedily while each explains more than chance, by a margin.

    Signatures are not changed; the selected blocks are projected out of the products for the next
    selection.

    **Arguments:**

    - `most`: largest number of blocks.
    - `margin`: amount that a block must explain beyond log(samples) for each of its columns.
    """
    score, price = white.score(), float(np.log(white.count))
    grouped = [(places, columns, white.within(columns)) for places, columns in by_width(blocks)]
    residual, taken = white.residual, np.zeros((len(white.residual), 0))
    chosen: list[int] = []
    for _ in range(min(most, len(blocks))):
        gain = np.full(len(blocks), -np.inf)
        for places, columns, inner in grouped:
            value, freedom = explained_by(inner, score[columns][..., None])
            gain[places] = value[:, 0] - freedom * price
        gain[chosen] = -np.inf
        best = int(gain.argmax())
        if not gain[best] > margin:
            break
        chosen.append(best)
        own = white.columns(blocks[best])
        # OpenBLAS reports invalid operations on some finite arrays (numpy issue 24067).
        with np.errstate(invalid="ignore"):
            own = strong_directions(own - taken @ (taken.T @ own))
        taken = np.concatenate([taken, own], axis=1)
        across = white.products(own)
        score = score - (own.T @ residual) @ across
        residual = residual - own @ (own.T @ residual)
        for _, columns, inner in grouped:
            part = across[:, columns]
            inner -= np.einsum("kbi,kbj->bij", part, part)
    return chosen
