"""Score statistics: what each hypothesis explains of the whitened residual, and by what chance."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy import signal, stats
from scipy.linalg.blas import dsyrk  # type: ignore[attr-defined]

from ..noise import ARFilter, fit_ar

Rows = Float[np.ndarray, "recordings samples outputs"]
Table = Float[np.ndarray, "recordings samples outputs columns"]


class Data(eqx.Module):
    """Residual and sensitivities at the samples; zero where there is no sample.

    `base` are the columns that the model's own parameters and initial states can absorb, `table`
    the signatures, `mask` says which samples are there.
    """

    residual: Rows
    base: Float[np.ndarray, "recordings samples outputs absorbed"]
    table: Table
    mask: Bool[np.ndarray, "recordings samples"]

    def series(self, rows: Rows, output: int) -> list[np.ndarray]:
        """One output's rows, one series a recording."""
        return [r[m, output] for r, m in zip(rows, self.mask, strict=True)]


def whitened(
    x: Float[np.ndarray, "recordings samples outputs *columns"],
    noise: Sequence[ARFilter],
    mask: Bool[np.ndarray, "recordings samples"],
) -> Float[np.ndarray, "recordings samples outputs *columns"]:
    """Each output through its noise filter's inverse and over its innovations' deviation."""
    out = np.empty_like(x)
    for j, filt in enumerate(noise):
        level = np.sqrt(filt.variance) if filt.variance > 0 else 1.0
        out[:, :, j] = signal.lfilter(filt.polynomial / level, [1.0], x[:, :, j], axis=1)
        # The filter does not know what came before the first sample; to call it zero would make
        # outliers of the first rows, which anything that starts with a step then explains.
        for row, there in zip(out[:, :, j], mask, strict=True):
            row[: int(np.argmax(there)) + filt.order] = 0.0
    return out * mask.reshape(*mask.shape, *(1,) * (x.ndim - 2))


class Gram(eqx.Module):
    """The whitened problem in the space of signatures, what the base absorbs projected out.

    `gram` and `score` are X'X and X'r of columns scaled by `size`, their length before the
    projection; `rest` is what the base leaves of the squared residual, `count` its freedom.
    """

    gram: Float[np.ndarray, "columns columns"]
    score: Float[np.ndarray, " columns"]
    size: Float[np.ndarray, " columns"]
    rest: float
    count: float

    def without(self, columns: Sequence[int]) -> "Gram":
        """The same with some columns moved into the base."""
        chosen = list(columns)
        inverse = _inverse(self.gram[np.ix_(chosen, chosen)])
        across = self.gram[:, chosen] @ inverse
        gain = float(self.score[chosen] @ inverse @ self.score[chosen])
        return Gram(
            self.gram - across @ self.gram[chosen],
            self.score - across @ self.score[chosen],
            self.size,
            self.rest - gain,
            self.count - len(chosen),
        )

    def explained(self, columns: Sequence[int]) -> tuple[float, int]:
        """The score statistic of a block of columns and its degrees of freedom."""
        chosen = list(columns)
        if len(chosen) == 1:
            power = self.gram[chosen[0], chosen[0]]
            return (float(self.score[chosen[0]] ** 2 / power), 1) if power > WEAK else (0.0, 0)
        values, vectors = np.linalg.eigh(self.gram[np.ix_(chosen, chosen)])
        strong = values > WEAK
        along = vectors[:, strong].T @ self.score[chosen]
        return float(np.sum(along**2 / values[strong])), int(strong.sum())

    def amplitude(self, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Estimated amplitudes of a block, in its own units, and their covariance."""
        chosen = list(columns)
        inverse = _inverse(self.gram[np.ix_(chosen, chosen)])
        scale = self.size[chosen]
        return inverse @ self.score[chosen] / scale, inverse / np.outer(scale, scale)


# A signature of which the base parameters absorb all but this share of the power says nothing.
WEAK = 1e-6


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    values, vectors = np.linalg.eigh(matrix)
    strong = values > WEAK
    return (vectors[:, strong] / values[strong]) @ vectors[:, strong].T


def gram_of(data: Data, noise: Sequence[ARFilter]) -> Gram:
    """Whitens, projects the base out, and forms the products that every test needs."""
    r = whitened(data.residual, noise, data.mask).reshape(-1)
    z = whitened(data.base, noise, data.mask).reshape(len(r), -1)
    x = whitened(data.table, noise, data.mask).reshape(len(r), -1)
    size = np.linalg.norm(x, axis=0)
    size[size == 0] = 1.0
    x = x / size
    norms = np.linalg.norm(z, axis=0)
    basis, values, _ = np.linalg.svd(z[:, norms > 0] / norms[norms > 0], full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]] if len(values) else basis
    x -= basis @ (basis.T @ x)
    r = r - basis @ (basis.T @ r)
    outputs = data.residual.shape[2]
    unknown = len(data.mask) * sum(f.order for f in noise)
    count = float(data.mask.sum() * outputs - unknown - basis.shape[1])
    return Gram(products(x), x.T @ r, size, float(r @ r), count)


def products(x: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns columns"]:
    """X'X, of which BLAS need only do half."""
    upper = dsyrk(1.0, x.T) if x.flags.c_contiguous else dsyrk(1.0, x, trans=1)
    return np.triu(upper) + np.triu(upper, 1).T


def noise_of(data: Data, leftover: Rows, lost: float) -> tuple[ARFilter, ...]:
    """One AR filter an output, its variance corrected for the freedom the model has taken.

    **Arguments:**

    - `leftover`: the residual with what a model explains taken out.
    - `lost`: how many parameters that model has.
    """
    outputs = leftover.shape[2]
    total = float(data.mask.sum())
    share = 1 / (1 - min(lost / outputs / total, 0.5))
    filters = []
    for j in range(outputs):
        series = [s - s.mean() for s in data.series(leftover, j)]
        found = fit_ar(series, highest=30, criterion="bic")
        filters.append(ARFilter(found.coefficients, max(found.variance * share, 1e-300)))
    return tuple(filters)


def leftover(data: Data, noise: Sequence[ARFilter], columns: Sequence[int], ridge: float) -> Rows:
    """The residual less the best combination of base and some signatures, whitened by `noise`.

    **Arguments:**

    - `ridge`: added to the squared length of every signature, as a share of it.
    """
    picked = data.table[..., list(columns)]
    wide = np.concatenate([data.base, picked], axis=-1)
    w = whitened(wide, noise, data.mask).reshape(-1, wide.shape[-1])
    r = whitened(data.residual, noise, data.mask).reshape(-1)
    size = np.linalg.norm(w, axis=0)
    size[size == 0] = 1.0
    w /= size
    normal = products(w)
    damp = np.full(len(size), 1e-12)
    damp[data.base.shape[-1] :] += ridge
    theta = np.linalg.solve(normal + np.diag(damp), w.T @ r) / size
    return (data.residual - wide @ theta) * data.mask[..., None]


def select(gram: Gram, blocks: Sequence[Sequence[int]], most: int, margin: float) -> list[int]:
    """Blocks picked greedily while each explains more than chance, by a margin.

    **Arguments:**

    - `most`: how many at the most.
    - `margin`: what a block must explain beyond log(samples) for each of its columns.
    """
    chosen: list[int] = []
    price = np.log(gram.count)
    for _ in range(most):
        best, place = margin, -1
        for k, block in enumerate(blocks):
            if k in chosen:
                continue
            value, freedom = gram.explained(block)
            if value - freedom * price > best:
                best, place = value - freedom * price, k
        if place < 0:
            break
        chosen.append(place)
        gram = gram.without(blocks[place])
    return chosen


def estimate_noise(
    data: Data, blocks: Sequence[Sequence[int]]
) -> tuple[tuple[ARFilter, ...], list[int]]:
    """The noise filter with everything in the model that could be physics.

    Two starts: what the base leaves, whose filter may take a spring's slow pull for noise, and what
    a rich model leaves (base and all signatures, slightly ridged), which takes a share of the noise
    with it. From each, the few signatures that matter are picked and the filter is estimated again
    with those alone in the model; the likelier of the two ends, by BIC, is believed.

    **Returns:** the filters, and the blocks that were picked.
    """
    flat = tuple(
        ARFilter(np.zeros(0), float(np.mean(np.concatenate(data.series(data.residual, j)) ** 2)))
        for j in range(data.residual.shape[2])
    )
    every = range(data.table.shape[-1])
    starts = [leftover(data, flat, (), 1e-9), leftover(data, flat, every, 1e-4)]
    ends = [_settle(data, blocks, noise_of(data, start, 0.0)) for start in starts]
    _, noise, chosen = min(ends, key=lambda end: end[0])
    return noise, chosen


def _settle(
    data: Data, blocks: Sequence[Sequence[int]], noise: tuple[ARFilter, ...]
) -> tuple[float, tuple[ARFilter, ...], list[int]]:
    """Picks signatures and estimates the filter in turn; BIC, filters and blocks at the end."""
    chosen: list[int] = []
    columns: list[int] = []
    for _ in range(2):
        before = chosen
        chosen = select(gram_of(data, noise), blocks, 12, 10.0)
        columns = [c for k in chosen for c in blocks[k]]
        rest = leftover(data, noise, columns, 1e-9)
        noise = noise_of(data, rest, data.base.shape[-1] + len(columns))
        if chosen == before:
            break
    count = float(data.mask.sum())
    spread = sum(count * np.log(f.variance) for f in noise)
    free = len(columns) + sum(f.order for f in noise)
    return float(spread + free * np.log(count * len(noise))), noise, chosen


# --- p-values that count how many were asked ---------------------------------------------------


def chance(value: float, freedom: int) -> float:
    """Probability that noise alone explains that much (upper tail of chi squared)."""
    return float(stats.chi2.sf(value, freedom)) if freedom else 1.0


def effective_tests(
    gram: Gram, blocks: Sequence[Sequence[int]], draws: int = 400, seed: int = 0
) -> float:
    """How many independent tests the blocks amount to, by drawing noise in their own space.

    The smallest p-value of correlated tests is distributed as that of fewer independent ones.
    """
    n = len(gram.gram)
    root = np.linalg.cholesky(gram.gram + 1e-10 * np.eye(n))
    noise = root @ np.random.default_rng(seed).standard_normal((n, draws))
    smallest = np.ones(draws)
    for block in blocks:
        chosen = list(block)
        inner, axes = np.linalg.eigh(gram.gram[np.ix_(chosen, chosen)])
        strong = inner > WEAK
        if not strong.any():
            continue
        along = axes[:, strong].T @ noise[chosen]
        value = np.sum(along**2 / inner[strong][:, None], axis=0)
        smallest = np.minimum(smallest, stats.chi2.sf(value, int(strong.sum())))
    # The mean of -log(1 - smallest) of m independent tests is 1/m.
    return max(1.0, 1 / float(np.mean(-np.log1p(-np.minimum(smallest, 1 - 1e-12)))))


def corrected(p: float, tests: float) -> float:
    """The p-value of the smallest of so many tests (Šidák 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))
