"""Residual and sensitivities of a fit at its samples, and their whitening."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import FitError
from ..estimate.minimise import Prior
from ..noise import ARFilter
from .table import SignatureTable, stretches

Rows = Float[np.ndarray, "recordings samples outputs"]


def places_among(numbers: Sequence[int], kept: tuple[int, ...] | None) -> list[int]:
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


class Data(eqx.Module):
    """Residual and sensitivities at the samples; zero for padding.

    `base` has the columns that the model's own parameters and initial states can absorb, `table`
    the signatures; `mask` is false for padding. Signatures are in single precision: there are many,
    and three digits suffice. `level` is the noise level of each recording relative to the mean;
    None if all are equal. `kept` are the numbers of the columns in the table; None for all columns.
    `known` is the prior of changes of the base's values; None if nothing is known of them.
    """

    residual: Rows
    base: Float[np.ndarray, "recordings samples outputs absorbed"]
    table: SignatureTable
    mask: Bool[np.ndarray, "recordings samples"]
    level: Float[np.ndarray, "recordings outputs"] | None = None
    kept: tuple[int, ...] | None = eqx.field(static=True, default=None)
    known: Prior | None = None

    @classmethod
    def fields_of_format(cls, fields: dict[str, Any], written: int) -> dict[str, Any]:
        """Converts fields of an older file format, which stored signatures as one array."""
        return fields if written > 3 else {**fields, "table": SignatureTable.of(fields["table"])}

    @property
    def there(self) -> Bool[np.ndarray, "recordings samples outputs"]:
        """Rows that are compared; those at which a joint is at rest are zero and are not."""
        return self.residual != 0

    @property
    def compared(self) -> Int[np.ndarray, "recordings outputs"]:
        """Number of compared rows."""
        return self.there.sum(axis=1)

    def columns(
        self, numbers: Sequence[int]
    ) -> Float[np.ndarray, "recordings samples outputs columns"]:
        """Signatures by their numbers.

        **Raises:** `FitError` if they have not been kept.
        """
        return self.table.dense(places_among(numbers, self.kept))

    def only(self, numbers: Sequence[int]) -> "Data":
        """The same with only these columns of the table."""
        table = self.table.only(places_among(numbers, self.kept))
        return dataclasses.replace(self, table=table, kept=tuple(numbers))

    def series(self, rows: Rows, output: int) -> list[np.ndarray]:
        """One output's rows, one series per recording, scaled to a common noise level."""
        alike = np.ones((len(rows), rows.shape[2])) if self.level is None else self.level
        pairs = zip(rows, self.mask, alike[:, output], strict=True)
        return [r[m, output] / level for r, m, level in pairs]

    def white(
        self, x: Float[np.ndarray, "recordings samples outputs *columns"], noise: Sequence[ARFilter]
    ) -> Float[np.ndarray, "recordings samples outputs *columns"]:
        """Rows through the inverse of the noise filters, scaled to a common noise level."""
        out = whitened(x, noise, self.there)
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

    def white_signatures(
        self, output: int, noise: ARFilter
    ) -> tuple[Float[np.ndarray, "rows some"], Int[np.ndarray, " some"]]:
        """The whitened signatures of one output, and the numbers of those that are not zero."""
        own, columns = self.table.values[output], self.table.columns[output]
        there = self.there[..., output, None]
        white = whitened(own[:, :, None], [noise], there)
        if self.level is not None:
            white /= self.level[:, output, None, None, None].astype(white.dtype)
        return white.reshape(own.shape[0] * own.shape[1], len(columns)), columns

    def white_products(
        self, noise: Sequence[ARFilter], x: Float[np.ndarray, "recordings samples outputs some"]
    ) -> Float[np.ndarray, "columns some"]:
        """Products of the whitened signatures with other columns, in double precision."""
        found = np.zeros((self.table.width, x.shape[-1]))
        for output, filt in enumerate(noise):
            white, columns = self.white_signatures(output, filt)
            found[columns] += white.T.astype(float) @ x[:, :, output].reshape(len(white), -1)
        return found

    def known_left(
        self, taken: Float[np.ndarray, " absorbed"] | None = None
    ) -> Float[np.ndarray, " known"]:
        """Expected minus estimated values of the base in deviations; empty if nothing is known.

        **Arguments:** as for `white_residual`.
        """
        if self.known is None:
            return np.zeros(0)
        return self.known.left(np.zeros(self.known.rows.shape[1]) if taken is None else taken)

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

        return dataclasses.replace(
            self,
            residual=stretches(self.residual, first, length),
            base=stretches(self.base, first, length),
            table=self.table.rows(first, length),
            mask=stretches(self.mask, first, length),
        )


def whitened(
    x: Float[np.ndarray, "recordings samples outputs *columns"],
    noise: Sequence[ARFilter],
    there: Bool[np.ndarray, "recordings samples outputs"],
) -> Float[np.ndarray, "recordings samples outputs *columns"]:
    """Each output through its noise filter's inverse and over its innovations' deviation.

    **Arguments:**

    - `there`: rows that are compared; others become zero.
    """
    out = np.empty_like(x)
    for j, filt in enumerate(noise):
        level = np.sqrt(filt.variance) if filt.variance > 0 else 1.0
        for k, kept in enumerate(there[..., j]):
            out[k, :, j] = filt.innovations(x[k, :, j], kept) / x.dtype.type(level)
    return out
