"""A table of signatures, stored by output, because most effects act on one joint only."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped


class OutputSeries(eqx.Module):
    """Series of compared rows, each of one output and one column of a table.

    - `output`, `column`: their numbers, for each series.
    """

    values: Float[np.ndarray, "recordings rows series"]
    output: Int[np.ndarray, " series"]
    column: Int[np.ndarray, " series"]

    @classmethod
    def of(
        cls,
        columns: Float[np.ndarray, "recordings rows outputs columns"],
        numbers: Int[np.ndarray, " columns"],
    ) -> "OutputSeries":
        """All outputs of some columns.

        **Arguments:**

        - `numbers`: of the columns.
        """
        recordings, rows, outputs, count = columns.shape
        values = columns.reshape(recordings, rows, outputs * count)
        return cls(values, np.repeat(np.arange(outputs), count), np.tile(numbers, outputs))


class SignatureTable(eqx.Module):
    """Columns of several outputs, each output without the columns that are zero there.

    - `values`: the series of each output. `columns`: the numbers of these series, ascending.
    - `width`: number of all columns.
    """

    values: tuple[Float[np.ndarray, "recordings rows _"], ...]
    columns: tuple[Int[np.ndarray, " _"], ...]
    width: int = eqx.field(static=True)

    @classmethod
    def of(cls, columns: Float[np.ndarray, "recordings rows outputs columns"]) -> "SignatureTable":
        """The table of columns of all outputs."""
        outputs, width = columns.shape[2:]
        return cls.of_series([OutputSeries.of(columns, np.arange(width))], outputs, width)

    @classmethod
    def of_series(
        cls, series: Sequence[OutputSeries], outputs: int, width: int
    ) -> "SignatureTable":
        """The table of some series; what has no series is zero.

        **Arguments:**

        - `series`: at least one, each with the same recordings and rows.
        - `outputs`, `width`: number of outputs and of columns.
        """
        filled = [s.values.any(axis=(0, 1)) for s in series]
        values, columns = [], []
        for output in range(outputs):
            own = [
                np.flatnonzero((s.output == output) & f)
                for s, f in zip(series, filled, strict=True)
            ]
            numbers = np.concatenate([s.column[k] for s, k in zip(series, own, strict=True)])
            order = np.argsort(numbers)
            parts = [s.values[..., k] for s, k in zip(series, own, strict=True)]
            values.append(np.concatenate(parts, axis=-1)[..., order])
            columns.append(numbers[order])
        return cls(tuple(values), tuple(columns), width)

    @property
    def finite(self) -> Bool[np.ndarray, " columns"]:
        """Whether all values of a column are finite."""
        found = np.ones(self.width, bool)
        for values, columns in zip(self.values, self.columns, strict=True):
            found[columns] &= np.isfinite(values).all(axis=(0, 1))
        return found

    def dense(self, numbers: Sequence[int]) -> Float[np.ndarray, "recordings rows outputs some"]:
        """Some columns for all outputs."""
        first = self.values[0]
        found = np.zeros((*first.shape[:2], len(self.values), len(numbers)), first.dtype)
        for output, (at, places) in enumerate(self._among(numbers)):
            found[:, :, output, places] = self.values[output][..., at]
        return found

    def only(self, numbers: Sequence[int]) -> "SignatureTable":
        """The table of some columns, in this order."""
        values, columns = [], []
        for own, (at, places) in zip(self.values, self._among(numbers), strict=True):
            values.append(own[..., at])
            columns.append(places)
        return SignatureTable(tuple(values), tuple(columns), len(numbers))

    def recordings(self, which: slice) -> "SignatureTable":
        """The table of some recordings."""
        return SignatureTable(tuple(v[which] for v in self.values), self.columns, self.width)

    def rows(self, first: Int[np.ndarray, " recordings"], length: int) -> "SignatureTable":
        """The table of equally many rows of each recording, from the first ones on."""
        values = tuple(stretches(v, first, length) for v in self.values)
        return SignatureTable(values, self.columns, self.width)

    def _among(self, numbers: Sequence[int]) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each output the places of its series among the stored ones and among the numbers."""
        wanted, found = np.asarray(numbers, int), []
        for columns in self.columns:
            at = np.searchsorted(columns, wanted)
            places = np.flatnonzero(np.append(columns, -1)[at] == wanted)
            found.append((at[places], places))
        return found


def stretches(
    x: Shaped[np.ndarray, "recordings rows *axes"],
    first: Int[np.ndarray, " recordings"],
    length: int,
) -> Shaped[np.ndarray, "recordings some *axes"]:
    """Equally many rows of each recording, from the first ones on."""
    return np.stack([own[at : at + length] for own, at in zip(x, first, strict=True)])
