"""Which of a table's columns stand for which signal."""

import contextlib
import itertools
import re
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from ..errors import brief, near
from ._checks import numeric
from ._problem import problem
from ._units import SIGNALS

if TYPE_CHECKING:
    import pandas as pd

Columns = Mapping[str, str | Sequence[str]]


class Table(eqx.Module):
    """Named columns of one file, not yet looked at.

    `refused` names what the file also holds but cannot be a column, and says what it is. `lines`
    are the rows' lines in a text file.
    """

    columns: dict[str, object]
    refused: dict[str, str] = eqx.field(default_factory=dict)
    lines: tuple[int, ...] = ()


class Layout(eqx.Module):
    """Column names that a published data set uses, in the form of `read(..., columns=...)`.

    `quantised` says that its positions are whole encoder counts where they look like it.
    """

    required: dict[str, str]
    optional: dict[str, str]
    quantised: bool = False

    def columns(self, present: Collection[str]) -> dict[str, str] | None:
        """The mapping for a file with these columns, or None when it is not of this layout."""

        def there(names: str) -> bool:
            return all(name in present for name in names.split("*"))

        if not all(map(there, self.required.values())):
            return None
        return self.required | {ours: t for ours, t in self.optional.items() if there(t)}


def known_layouts() -> tuple[Layout, ...]:
    """The published data sets that need no `columns`."""
    emps = Layout(
        required={"time": "t", "q": "qm", "q_ref": "qg", "tau": "gtau*vir"},
        # The name says newton, the recorded controller output jumps by as many volts.
        optional={"tau_ff": "gtau*pulses_N"},
        quantised=True,
    )
    return (emps,)


class Picked(eqx.Module):
    """Signals found in a table, in its units, with the names they have there.

    `quantised` says that positions are whole encoder counts where they look like it. `lines` are
    the rows' lines in a text file.
    """

    signals: dict[str, Float64[np.ndarray, "..."]]
    labels: dict[str, list[str]]
    quantised: bool = False
    lines: tuple[int, ...] = ()


def pick(source: str, table: Table, columns: Columns | None) -> Picked:
    """Finds the signals in a table.

    **Arguments:**

    - `source`: the file or recording it comes from.
    - `table`: its columns.
    - `columns`: our names to theirs; where silent, default names and known layouts hold.

    **Raises:** `RecordingError` for a column that is missing, doubled or not numeric.
    """
    layouts = ((layout, layout.columns(table.columns)) for layout in known_layouts())
    known = next(((layout, names) for layout, names in layouts if names is not None), None)
    # A mapping or a `time` column says that the file is not meant in the way of a known layout.
    if columns is not None or "time" in table.columns:
        known = None
    labels = _resolve(source, table, known[1] if known else columns)
    signals = {signal: _stack(source, table, signal, names) for signal, names in labels.items()}
    return Picked(signals, labels, known is not None and known[0].quantised, table.lines)


def from_frame(source: str, frame: "pd.DataFrame", lines: tuple[int, ...] = ()) -> Table:
    """The columns of a DataFrame, each named once."""
    names = [str(name).strip() for name in frame.columns]
    unique(source, names)
    return Table({name: frame.iloc[:, i] for i, name in enumerate(names)}, {}, lines)


def unique(source: str, names: Sequence[str]) -> None:
    """Raises `RecordingError` when a name that is not empty appears twice."""
    seen = set()
    for name in filter(None, names):
        if name in seen:
            raise problem(
                source, f"column {brief(name)} appears more than once", "rename or remove one"
            )
        seen.add(name)


def quantum(q: Float64[np.ndarray, "samples joints"]) -> Float64[np.ndarray, " joints"] | None:
    """The step that all positions are whole multiples of, or None when there is none.

    **Arguments:**

    - `q`: positions, `(samples, joints)`, rad or m.
    """
    steps = [_step(column) for column in q.T]
    return None if None in steps else np.array(steps, dtype=np.float64)


def _step(q: Float64[np.ndarray, " samples"]) -> float | None:
    with np.errstate(all="ignore"):
        moves = np.abs(np.diff(q))
        moves = moves[moves > 1e-12 * np.abs(q).max(initial=0.0)]
        if moves.size < 20:
            return None
        counts = moves / moves.min()
        # A hundredth of a count is far above rounding, and 20 moves that all meet it by chance
        # have odds of 1 to 50**20.
        if not (np.abs(counts - np.round(counts)) < 0.01).all():
            return None
        step = float(np.median(moves / np.round(counts)))
        decade = np.log10(step)
    # A power of ten is where the file's decimals end, not the encoder's counts.
    return None if abs(decade - np.round(decade)) < 1e-6 else step


def _resolve(source: str, table: Table, columns: Columns | None) -> dict[str, list[str]]:
    labels = {}
    for signal, names in (columns or {}).items():
        if signal not in SIGNALS:
            raise problem(
                source,
                f"columns names {brief(signal)}{near(signal, SIGNALS)}",
                f"map {', '.join(SIGNALS)} only",
            )
        labels[signal] = [names] if isinstance(names, str) else list(names)
        if not labels[signal]:
            raise problem(source, f"columns gives no column for {signal}", "name one, or omit it")
    for signal in SIGNALS:
        if signal not in labels:
            found = [signal] if signal == "time" else _default_names(source, table, signal)
            if found:
                labels[signal] = found
    _same_count(source, table, labels, columns or {})
    return {signal: labels[signal] for signal in SIGNALS if signal in labels}


def _default_names(source: str, table: Table, signal: str) -> list[str]:
    here = {*table.columns, *table.refused}
    stem, numbers = f"{signal}_", _numbers(f"{signal}_", here)
    # A plain v1 may be a voltage; the others mean in every lab what they mean here.
    if not numbers and signal != "v" and (plain := _numbers(signal, here)):
        stem, numbers = signal, plain
    if signal in here and numbers:
        raise problem(
            source,
            f"there are both {signal} and {stem}{min(numbers)}",
            f"keep one, or say which with columns={{'{signal}': ...}}",
        )
    if signal in here:
        return [signal]
    first_absent = next(k for k in itertools.count(1) if k not in numbers)
    if numbers and max(numbers) > first_absent:
        absent, beside = f"{stem}{first_absent}", f"{stem}{max(numbers)}"
        raise missing(source, table, signal, absent, beside)
    return [f"{stem}{k}" for k in range(1, first_absent)]


def _numbers(stem: str, names: Collection[str]) -> set[int]:
    """Numbers of the joints that have a column of this stem."""
    matches = (re.fullmatch(rf"{stem}([1-9]\d{{0,3}})", name, re.ASCII) for name in names)
    return {int(match[1]) for match in matches if match}


def _same_count(source: str, table: Table, labels: dict[str, list[str]], given: Columns) -> None:
    for signal, other in (("q", "tau"), ("tau", "q")):
        if signal not in labels:
            raise missing(source, table, signal, f"{signal}_1")
        count, more = len(labels[signal]), len(labels[other]) if other in labels else 0
        numbered = signal not in given and labels[signal] != [signal]
        if numbered and count < more:
            stem = labels[signal][0][:-1]
            raise missing(source, table, signal, f"{stem}{count + 1}", labels[other][count])


def _stack(
    source: str, table: Table, signal: str, names: Sequence[str]
) -> Float64[np.ndarray, "..."]:
    columns = [_column(source, table, signal, name) for name in names]
    if len(columns) == 1:
        return columns[0]
    for name, column in zip(names, columns, strict=True):
        if column.shape != columns[0].shape or column.ndim != 1:
            raise problem(
                source,
                f"{brief(name)} has shape {column.shape} and {brief(names[0])} has "
                f"{columns[0].shape}",
                "give each joint one column of the same length",
            )
    return np.column_stack(columns)


def _column(source: str, table: Table, signal: str, name: str) -> Float64[np.ndarray, "..."]:
    if name in table.columns:
        return numeric(source, name, table.columns[name], table.lines)
    if "*" not in name or name in table.refused:
        raise missing(source, table, signal, name)
    factors = [_factor(source, table, signal, factor.strip()) for factor in name.split("*")]
    try:
        with np.errstate(over="ignore"):
            return np.prod(np.broadcast_arrays(*factors), axis=0)
    except ValueError as error:
        raise problem(
            source,
            f"the factors of {brief(name)} have shapes {[factor.shape for factor in factors]}",
            "give columns of the same length, or a single number",
        ) from error


def _factor(source: str, table: Table, signal: str, name: str) -> Float64[np.ndarray, "..."]:
    """A factor of a product: a column, or a number as it stands."""
    if name not in table.columns:
        with contextlib.suppress(ValueError):
            return np.asarray(float(name))
    return _column(source, table, signal, name)


def missing(source: str, table: Table, signal: str, name: str, beside: str = "") -> Exception:
    """The error for a column of a signal that is not there, or not of a kind that can be read."""
    if name in table.refused:
        return problem(
            source,
            f"{brief(name)} is a {table.refused[name]}",
            "save plain arrays of numbers, in MATLAB by save(file, '-struct', 's')",
        )
    what = f"column {brief(name)} is missing" + (f" though {brief(beside)} is there" * bool(beside))
    # A neighbour that is well named is another signal, not this one misspelt.
    well_named = re.compile(rf"({'|'.join(SIGNALS)})(_\d+)?")
    what += near(name, (other for other in table.columns if not well_named.fullmatch(other)))
    if table.refused and not table.columns:
        struct, kind = next(iter(table.refused.items()))
        return problem(
            source,
            f"{what}, the file holds only {brief(struct)}, a {kind}",
            "save plain arrays of numbers, in MATLAB by save(file, '-struct', 's')",
        )
    return problem(
        source,
        f"{what}, there are {brief(list(table.columns))}",
        f"rename it, or say which it is: columns={{'{signal}': ...}}, --column {signal}=...",
    )
