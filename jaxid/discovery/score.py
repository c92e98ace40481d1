"""Score statistics: the part of the whitened residual that hypotheses explain, and p-values."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..noise import ARFilter
from .data import Data, places_among

Blocks = Sequence[Sequence[int]]


def spanned(x: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows rank"]:
    """Orthonormal columns of the same span, for columns in any units."""
    size = np.linalg.norm(x, axis=0)
    basis, values, _ = np.linalg.svd(x[:, size > 0] / size[size > 0], full_matrices=False)
    return basis[:, values > 1e-9 * values[0]] if len(values) else basis


def strong_directions(x: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows rank"]:
    """Orthonormal columns of the span of signatures, without almost zero directions."""
    basis, size, _ = np.linalg.svd(x, full_matrices=False)
    return basis[:, size**2 > WEAK]


class Part(eqx.Module):
    """Some rows of a table of signatures, without columns that are zero there.

    `values` are in single precision, `columns` their numbers.
    """

    values: Float[np.ndarray, "rows some"]
    columns: Int[np.ndarray, " some"]

    def places(self, numbers: Int[np.ndarray, "*numbers"]) -> Int[np.ndarray, "*numbers"]:
        """Places of columns in `values`; -1 for those that are zero there."""
        at = np.searchsorted(self.columns, numbers)
        return np.where(np.append(self.columns, -1)[at] == numbers, at, -1)


class Whitened(eqx.Module):
    """Residual and signatures, whitened, with the base projected out.

    Most effects act on one joint, so most of a table of signatures is zero before the projection.
    It is stored in parts, one for each output and one for what is known of the base. `basis` and
    `across`, the product of basis and table, are for the projection. Signatures are scaled by
    `size`, their norm before the projection; `count` is the number of remaining degrees of freedom.
    """

    residual: Float[np.ndarray, " rows"]
    parts: tuple[Part, ...]
    basis: Float[np.ndarray, "rows rank"]
    across: Float[np.ndarray, "rank columns"]
    size: Float[np.ndarray, " columns"]
    count: float

    @classmethod
    def of(cls, data: Data, noise: Sequence[ARFilter]) -> "Whitened":
        """The problem of some data, through noise filters."""
        r = data.white_residual(data.residual, noise)
        basis = spanned(data.white_columns(data.base, noise, slice(None)))
        r = r - basis @ (basis.T @ r)
        outputs = [Part(*data.white_signatures(j, filt)) for j, filt in enumerate(noise)]
        nothing = np.zeros((len(data.known_left()), 0), outputs[0].values.dtype)
        parts = (*outputs, Part(nothing, np.zeros(0, int)))
        power = np.zeros(data.table.width)
        for part in parts:
            power[part.columns] += np.einsum("rc,rc->c", part.values, part.values)
        size = np.sqrt(np.where(power > 0, power, 1.0))
        for part in parts:
            part.values[...] /= size[part.columns].astype(part.values.dtype)
        count = data.compared.sum() + len(data.known_left()) - basis.shape[1]
        across = _products(parts, basis.astype(nothing.dtype), len(size))
        return cls(r, parts, basis, across, size, float(count))

    def columns(self, numbers: Sequence[int]) -> Float[np.ndarray, "rows some"]:
        """Some signatures without what the base absorbs."""
        chosen = np.array(list(numbers), int)
        found = -self.basis @ self.across[:, chosen]
        for j, part in enumerate(self.parts):
            at = part.places(chosen)
            _rows(found, j, self.parts)[:, at >= 0] += part.values[:, at[at >= 0]]
        return found

    def products(self, x: Float[np.ndarray, "rows some"]) -> Float[np.ndarray, "some columns"]:
        """Products of columns with the signatures, in single precision."""
        single = x.astype(self.parts[0].values.dtype)
        return _products(self.parts, single, len(self.size)) - (x.T @ self.basis) @ self.across

    def within(self, blocks: Int[np.ndarray, "blocks width"]) -> Float[np.ndarray, "blocks w w"]:
        """Products of the signatures of each block with each other."""
        # In double precision: the base may leave as little of a column as `WEAK`.
        along = self.across.T[blocks]
        found = -along @ along.transpose(0, 2, 1)
        for part in self.parts:
            at = part.places(blocks)
            some = np.flatnonzero((at >= 0).any(axis=1))
            own = part.values.T[at[some]] * (at[some, :, None] >= 0).astype(float)
            found[some] += own @ own.transpose(0, 2, 1)
        return found

    def gram(self) -> Float[np.ndarray, "columns columns"]:
        """Products of the signatures with each other."""
        found = -self.across.T @ self.across
        for part in self.parts:
            own = part.values.astype(float)
            found[np.ix_(part.columns, part.columns)] += own.T @ own
        if not np.isfinite(found).all():
            raise np.linalg.LinAlgError("the signatures or their products are not finite")
        return found

    def noise(self, draws: int = 1000, seed: int = 0) -> Float[np.ndarray, "columns draws"]:
        """Products of the signatures with white noise."""
        rng = np.random.default_rng(seed)
        found = np.zeros((len(self.size), draws))
        along = np.zeros((self.basis.shape[1], draws))
        for j, part in enumerate(self.parts):
            drawn = rng.standard_normal((len(part.values), draws), np.float32)
            found[part.columns] += part.values.T @ drawn
            along += _rows(self.basis, j, self.parts).T.astype(np.float32) @ drawn
        return found - self.across.T @ along

    def score(self) -> Float[np.ndarray, " columns"]:
        """Products of signatures and residual."""
        return self.products(self.residual[:, None])[0]

    def beside(self, columns: Float[np.ndarray, "rows more"]) -> "Whitened":
        """The same with more signatures, which are whitened and without the base already."""
        size = np.linalg.norm(columns, axis=0)
        size[size == 0] = 1.0
        more, known = columns / size, len(self.size)
        numbers = known + np.arange(len(size))
        parts = []
        for j, part in enumerate(self.parts):
            rows = _rows(more, j, self.parts)
            values = np.concatenate([part.values, rows.astype(part.values.dtype)], axis=1)
            parts.append(Part(values, np.append(part.columns, numbers)))
        across = np.concatenate([self.across, np.zeros((len(self.across), len(size)))], axis=1)
        size = np.append(self.size, size)
        return Whitened(self.residual, tuple(parts), self.basis, across, size, self.count)


def _rows(x: np.ndarray, part: int, parts: Sequence[Part]) -> np.ndarray:
    """The rows of one part, a view."""
    outputs = len(parts) - 1
    last = outputs * len(parts[0].values)
    return x[last:] if part == outputs else x[part:last:outputs]


def _products(
    parts: Sequence[Part], x: Float[np.ndarray, "rows some"], columns: int
) -> Float[np.ndarray, "some columns"]:
    """Products of columns with all parts, in the precision of the columns."""
    found = np.zeros((x.shape[1], columns))
    for j, part in enumerate(parts):
        values = part.values.astype(x.dtype, copy=False)
        found[:, part.columns] += _rows(x, j, parts).T @ values
    return found


class Gram(eqx.Module):
    """Products of the signatures with each other and with the residual, as `Whitened` has them.

    `rest` is the squared residual after projection of the base, `count` its degrees of freedom.
    `kept` are the numbers of the columns; None for all columns.
    """

    gram: Float[np.ndarray, "columns columns"]
    score: Float[np.ndarray, " columns"]
    size: Float[np.ndarray, " columns"]
    rest: float
    count: float
    kept: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def only(self, numbers: Sequence[int]) -> "Gram":
        """The same with only these columns."""
        at = places_among(numbers, self.kept)
        gram, score, size = self.gram[np.ix_(at, at)], self.score[at], self.size[at]
        return Gram(gram, score, size, self.rest, self.count, tuple(numbers))

    @classmethod
    def of(cls, data: Data, noise: Sequence[ARFilter]) -> "Gram":
        """Whitens, projects the base out, and computes the products for tests."""
        return cls.of_whitened(Whitened.of(data, noise))

    @classmethod
    def of_whitened(cls, white: Whitened) -> "Gram":
        """The products of whitened data."""
        rest = float(white.residual @ white.residual)
        return cls(white.gram(), white.score(), white.size, rest, white.count)

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

    def explained(self, blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
        """The score statistic of each block of columns, and its degrees of freedom."""
        value, freedom = np.zeros(len(blocks)), np.zeros(len(blocks), int)
        for places, columns in by_width(blocks):
            inner = self.gram[columns[:, :, None], columns[:, None, :]]
            found = explained_by(inner, self.score[columns][..., None])
            value[places], freedom[places] = found[0][:, 0], found[1]
        return value, freedom

    def correlation(self, one: Sequence[int], other: Sequence[int]) -> float:
        """Largest correlation between the spans of two blocks of columns; 0 if one is empty."""
        whole = []
        first, second = places_among(one, self.kept), places_among(other, self.kept)
        for columns in (first, second):
            values, vectors = _strong(self.gram[np.ix_(columns, columns)])
            whole.append(vectors / np.sqrt(values))
        across = whole[0].T @ self.gram[np.ix_(first, second)] @ whole[1]
        return float(min(1.0, np.linalg.norm(across, 2))) if across.size else 0.0

    def amplitude(self, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Estimated amplitudes of a block, in its own units, and their covariance."""
        chosen = places_among(columns, self.kept)
        inverse = _inverse(self.gram[np.ix_(chosen, chosen)])
        scale = self.size[chosen]
        return inverse @ self.score[chosen] / scale, inverse / np.outer(scale, scale)


# A signature is ignored if the base absorbs all but this share of its power.
WEAK = 1e-5


def by_width(
    blocks: Blocks,
) -> list[tuple[Int[np.ndarray, " some"], Int[np.ndarray, "some width"]]]:
    """Places and columns of blocks grouped by width, for computation in batches."""
    widths = np.array([len(block) for block in blocks])
    return [
        (places, np.array([list(blocks[int(k)]) for k in places]))
        for width in sorted({int(w) for w in widths if w > 0})
        for places in [np.flatnonzero(widths == width)]
    ]


def explained_by(
    gram: Float[np.ndarray, "blocks width width"], score: Float[np.ndarray, "blocks width draws"]
) -> tuple[Float[np.ndarray, "blocks draws"], Int[np.ndarray, " blocks"]]:
    """Score statistics of blocks of one width, and their degrees of freedom."""
    values, vectors = np.linalg.eigh(gram)
    strong = values > WEAK
    along = np.einsum("bwe,bwd->bed", vectors, score)
    power = np.where(strong, values, np.inf)[..., None]
    return np.sum(along**2 / power, axis=1), strong.sum(axis=1)


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    values, vectors = _strong(matrix)
    return (vectors / values) @ vectors.T


def _strong(
    matrix: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, " strong"], Float[np.ndarray, "n strong"]]:
    """Eigenvalues and eigenvectors of directions that the base does not absorb."""
    values, vectors = np.linalg.eigh(matrix)
    strong = values > WEAK
    return values[strong], vectors[:, strong]


# --- p-values corrected for the number of tests --------------------------------------------------


def chance(value: float, freedom: int) -> float:
    """Probability that noise alone explains that much (upper tail of chi squared)."""
    import scipy

    return float(scipy.stats.chi2.sf(value, freedom)) if freedom else 1.0


def effective_tests(gram: Gram, noise: Float[np.ndarray, "columns draws"], blocks: Blocks) -> float:
    """Effective number of independent tests of the blocks, by noise drawn in their space.

    The smallest p-value of correlated tests has the distribution of that of fewer independent ones.

    **Arguments:**

    - `noise`: products of the signatures with white noise.
    """
    import scipy

    draws = noise.shape[1]
    smallest = np.ones(draws)
    for _, columns in by_width(blocks):
        inner = gram.gram[columns[:, :, None], columns[:, None, :]]
        value, freedom = explained_by(inner, noise[columns])
        for k in {int(f) for f in freedom if f > 0}:
            most = value[freedom == k].max(axis=0)
            smallest = np.minimum(smallest, scipy.stats.chi2.sf(most, k))
    # The number is that of independent tests with the same lowest decile. A match of the mean would
    # give p-values in the tail that are three times too small.
    lowest = float(np.quantile(smallest, 0.1))
    return max(1.0, float(np.log(0.9) / np.log1p(-lowest)))


def corrected(p: float, tests: float) -> float:
    """The p-value of the smallest of a number of tests (Šidák 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))
