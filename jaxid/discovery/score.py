"""Score statistics: the part of the whitened residual that hypotheses explain, and p-values."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import FitError
from ..noise import ARFilter

Rows = Float[np.ndarray, "recordings samples outputs"]
Blocks = Sequence[Sequence[int]]


def _places(numbers: Sequence[int], kept: tuple[int, ...] | None) -> list[int]:
    """Places of columns among those that were kept; `kept` is None if all were.

    **Raises:** `FitError` if they were not kept.
    """
    if kept is None:
        return list(numbers)
    if not set(numbers) <= set(kept):
        raise FitError(
            "a story keeps only the signatures of its rankings: use jaxid.diagnose(step.fit) for "
            "all signatures"
        )
    return [kept.index(number) for number in numbers]


class Known(eqx.Module):
    """What is known of the base's values before the recordings, as rows of deviation one.

    - `rows`: derivatives by the values. `left`: expected minus fitted values, in deviations.
    """

    rows: Float[np.ndarray, "known absorbed"]
    left: Float[np.ndarray, " known"]


class Data(eqx.Module):
    """Residual and sensitivities at the samples; zero for padding.

    `base` has the columns that the model's own parameters and initial states can absorb, `table`
    the signatures; `mask` is false for padding. Signatures are in single precision: there are many,
    and three digits suffice. `level` is the noise level of each recording relative to the mean;
    None if all are equal. `kept` are the numbers of the columns in the table; None for all columns.
    `known` is what is known of the base's values; None if that is nothing.
    """

    residual: Rows
    base: Float[np.ndarray, "recordings samples outputs absorbed"]
    table: Float[np.ndarray, "recordings samples outputs columns"]
    mask: Bool[np.ndarray, "recordings samples"]
    level: Float[np.ndarray, "recordings outputs"] | None = None
    kept: tuple[int, ...] | None = eqx.field(static=True, default=None)
    known: Known | None = None

    def columns(
        self, numbers: Sequence[int]
    ) -> Float[np.ndarray, "recordings samples outputs columns"]:
        """Signatures by their numbers.

        **Raises:** `FitError` if they have not been kept.
        """
        return self.table[..., _places(numbers, self.kept)]

    def only(self, numbers: Sequence[int]) -> "Data":
        """The same with only these columns of the table."""
        return dataclasses.replace(self, table=self.columns(numbers), kept=tuple(numbers))

    def series(self, rows: Rows, output: int) -> list[np.ndarray]:
        """One output's rows, one series per recording, scaled to a common noise level."""
        alike = np.ones((len(rows), rows.shape[2])) if self.level is None else self.level
        pairs = zip(rows, self.mask, alike[:, output], strict=True)
        return [r[m, output] / level for r, m, level in pairs]

    def white(
        self, x: Float[np.ndarray, "recordings samples outputs *columns"], noise: Sequence[ARFilter]
    ) -> Float[np.ndarray, "recordings samples outputs *columns"]:
        """Rows through the inverse of the noise filters, scaled to a common noise level."""
        out = whitened(x, noise, self.mask)
        if self.level is not None:
            level = self.level.astype(x.dtype)[:, None]
            out /= level.reshape(*level.shape, *(1,) * (x.ndim - 3))
        return out

    def white_residual(
        self,
        rest: Rows,
        noise: Sequence[ARFilter],
        taken: Float[np.ndarray, " absorbed"] | None = None,
    ) -> Float[np.ndarray, " rows"]:
        """A whitened residual, and below it what is left of the knowledge of the base's values.

        **Arguments:**

        - `taken`: changes of the base's values; none if None.
        """
        rows = self.white(rest, noise).reshape(-1)
        return rows if self.known is None else np.append(rows, self.known_left(taken))

    def white_columns(
        self,
        x: Float[np.ndarray, "recordings samples outputs columns"],
        noise: Sequence[ARFilter],
        base: Sequence[int] | slice | None = None,
    ) -> Float[np.ndarray, "rows columns"]:
        """Whitened columns, and below them their derivatives of what is known.

        **Arguments:**

        - `base`: places in the base of the first columns; the others are not known. None if no
          column belongs to the base.
        """
        rows = self.white(x, noise).reshape(-1, x.shape[-1])
        if self.known is None:
            return rows
        own = self.known.rows[:, slice(0) if base is None else base]
        below = np.pad(own, ((0, 0), (0, x.shape[-1] - own.shape[1])))
        return np.concatenate([rows, below.astype(rows.dtype)])

    def known_left(
        self, taken: Float[np.ndarray, " absorbed"] | None = None
    ) -> Float[np.ndarray, " known"]:
        """Expected minus estimated values of the base in deviations; empty if nothing is known.

        **Arguments:** as for `white_residual`.
        """
        if self.known is None:
            return np.zeros(0)
        return self.known.left if taken is None else self.known.left - self.known.rows @ taken

    def middle(self, most: int, least: int = 1000) -> "Data":
        """The middle of each recording, with at most `most` rows in total.

        **Arguments:**

        - `least`: number of samples of each recording that are always kept. Otherwise short pieces
          would have almost no samples after their noise filter is filled.
        """
        recordings, samples, outputs = self.residual.shape
        length = max(least, most // (recordings * outputs))
        if length >= samples:
            return self
        spare = np.maximum(self.mask.sum(axis=1) - length, 0)
        first = np.minimum(np.argmax(self.mask, axis=1) + spare // 2, samples - length)

        def cut(rows: np.ndarray) -> np.ndarray:
            return np.stack([r[at : at + length] for r, at in zip(rows, first, strict=True)])

        return dataclasses.replace(
            self,
            residual=cut(self.residual),
            base=cut(self.base),
            table=cut(self.table),
            mask=cut(self.mask),
        )


def whitened(
    x: Float[np.ndarray, "recordings samples outputs *columns"],
    noise: Sequence[ARFilter],
    mask: Bool[np.ndarray, "recordings samples"],
) -> Float[np.ndarray, "recordings samples outputs *columns"]:
    """Each output through its noise filter's inverse and over its innovations' deviation."""
    out = np.empty_like(x)
    for j, filt in enumerate(noise):
        level = np.sqrt(filt.variance) if filt.variance > 0 else 1.0
        taps = (filt.polynomial / level).astype(x.dtype)
        for k, there in enumerate(mask):
            wide = x[k, :, j].reshape(x.shape[1], -1)
            out[k, :, j] = _through(taps, wide).reshape(out[k, :, j].shape)
            # The past of the first samples is unknown. With zeros the first rows would be outliers,
            # which any signature that starts with a step could explain.
            out[k, : int(np.argmax(there)) + filt.order, j] = 0.0
    out[~mask] = 0.0
    return out


def _through(
    taps: Float[np.ndarray, " taps"], x: Float[np.ndarray, "samples columns"]
) -> Float[np.ndarray, "samples columns"]:
    """Moving average along the samples, as products with one banded matrix; zero before the first.

    SciPy's `lfilter` needs one convolution per column and is five times as slow for a thousand.
    """
    import scipy

    reach = int(np.flatnonzero(taps).max(initial=0))
    if reach == 0:
        return taps[0] * x
    # Of a band as wide as it is high half is zeros; a lower one would be too many products.
    size, taps = max(32, reach), taps[: reach + 1]
    row = np.concatenate([taps[::-1], np.zeros(size - 1, taps.dtype)])
    band = scipy.linalg.toeplitz(np.concatenate([taps[-1:], np.zeros(size - 1, taps.dtype)]), row)
    out = np.empty_like(x)
    for at in range(0, len(x), size):
        first = max(at - reach, 0)
        piece = x[first : at + size]
        missing = first - (at - reach)
        rows = min(size, len(x) - at)
        out[at : at + size] = band[:rows, missing : missing + len(piece)] @ piece
    return out


def spanned(x: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows rank"]:
    """Orthonormal columns of the same span, for columns in any units."""
    size = np.linalg.norm(x, axis=0)
    basis, values, _ = np.linalg.svd(x[:, size > 0] / size[size > 0], full_matrices=False)
    return basis[:, values > 1e-9 * values[0]] if len(values) else basis


def strong_directions(x: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows rank"]:
    """Orthonormal columns of the span of signatures, without almost zero directions."""
    basis, size, _ = np.linalg.svd(x, full_matrices=False)
    return basis[:, size**2 > WEAK]


class Whitened(eqx.Module):
    """Residual and signatures, whitened, with the base projected out.

    Signatures are scaled by `size`, their norm before the projection; `count` is the number of
    remaining degrees of freedom.
    """

    residual: Float[np.ndarray, " rows"]
    signatures: Float[np.ndarray, "rows columns"]
    size: Float[np.ndarray, " columns"]
    count: float

    @classmethod
    def of(cls, data: Data, noise: Sequence[ARFilter]) -> "Whitened":
        """The problem of some data, through noise filters."""
        r = data.white_residual(data.residual, noise)
        z = data.white_columns(data.base, noise, slice(None))
        x = data.white_columns(data.table, noise)
        size = np.sqrt(np.einsum("rc,rc->c", x, x))
        size[size == 0] = 1.0
        x /= size
        basis = spanned(z)
        r = r - basis @ (basis.T @ r)
        single = basis.astype(x.dtype)
        across = single.T @ x
        # In parts, because the whole product would be as large as the table.
        parts = 1 + len(x) // 10_000
        for some, of in zip(np.array_split(x, parts), np.array_split(single, parts), strict=True):
            some -= of @ across
        unknown = len(data.mask) * sum(f.order for f in noise)
        rows = data.mask.sum() * data.residual.shape[2] + len(data.known_left())
        count = rows - unknown - basis.shape[1]
        return cls(r, x, size.astype(float), float(count))

    def score(self) -> Float[np.ndarray, " columns"]:
        """Products of signatures and residual."""
        return (self.residual.astype(self.signatures.dtype) @ self.signatures).astype(float)


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
        at = _places(numbers, self.kept)
        gram, score, size = self.gram[np.ix_(at, at)], self.score[at], self.size[at]
        return Gram(gram, score, size, self.rest, self.count, tuple(numbers))

    @classmethod
    def of(cls, data: Data, noise: Sequence[ARFilter]) -> "Gram":
        """Whitens, projects the base out, and computes the products for tests."""
        return cls.of_whitened(Whitened.of(data, noise))

    @classmethod
    def of_whitened(cls, white: Whitened) -> "Gram":
        """The products of whitened data."""
        import scipy

        x = white.signatures
        # BLAS stores columns first, so its upper half is our lower half.
        half = scipy.linalg.blas.ssyrk(1.0, x.T).astype(float)
        gram = np.triu(half) + np.triu(half, 1).T
        rest = float(white.residual @ white.residual)
        return cls(gram, white.score(), white.size, rest, white.count)

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
        first, second = _places(one, self.kept), _places(other, self.kept)
        for columns in (first, second):
            values, vectors = _strong(self.gram[np.ix_(columns, columns)])
            whole.append(vectors / np.sqrt(values))
        across = whole[0].T @ self.gram[np.ix_(first, second)] @ whole[1]
        return float(min(1.0, np.linalg.norm(across, 2))) if across.size else 0.0

    def amplitude(self, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Estimated amplitudes of a block, in its own units, and their covariance."""
        chosen = _places(columns, self.kept)
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


def effective_tests(gram: Gram, blocks: Blocks, draws: int = 1000, seed: int = 0) -> float:
    """Effective number of independent tests of the blocks, by noise drawn in their space.

    The smallest p-value of correlated tests has the distribution of that of fewer independent ones.
    """
    import scipy

    root = _root(gram.gram)
    noise = root @ np.random.default_rng(seed).standard_normal((root.shape[1], draws))
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


def _root(gram: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n rank"]:
    """A matrix whose product with its transpose is a Gram matrix, up to a tenth of `WEAK`.

    Columns in single precision may be parallel up to rounding. A Cholesky decomposition with pivots
    leaves out what the others explain.
    """
    import scipy

    if not np.isfinite(gram).all():
        raise np.linalg.LinAlgError("the Gram matrix is not finite")
    lower, pivots, rank, _ = scipy.linalg.lapack.dpstrf(gram, tol=0.1 * WEAK, lower=1)
    root = np.empty((len(gram), rank))
    root[pivots - 1] = np.tril(lower)[:, :rank]
    return root


def corrected(p: float, tests: float) -> float:
    """The p-value of the smallest of a number of tests (Šidák 1967)."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))
