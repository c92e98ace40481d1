"""Assigns the columns of a table to signals."""

import contextlib
import itertools
import re
import shlex
from collections.abc import Collection, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from ..errors import brief, near
from ._checks import numeric
from ._description import Columns, Description
from ._joints import by_joint
from ._likely import likely_columns
from ._problem import problem
from ._streams import aligned
from ._table import Table
from ._units import HELD, SIGNALS


class Layout(eqx.Module):
    """Column names that a published data set uses, in the form of `read(..., columns=...)`.

    `quantised` says that positions that look like whole encoder counts are encoder counts.
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
        # The column's name says newton, but its values are the controller output in volts.
        optional={"tau_ff": "gtau*pulses_N"},
        quantised=True,
    )
    return (emps,)


class Picked(eqx.Module):
    """Signals found in a table, in its units, with the names they have there.

    `quantised` says that positions that look like whole encoder counts are encoder counts. `lines`
    are the line numbers of the rows in a text file.
    """

    signals: dict[str, Float64[np.ndarray, "..."]]
    labels: dict[str, list[str]]
    quantised: bool = False
    lines: tuple[int, ...] = ()


def pick(source: str, table: Table, told: Description) -> Picked:
    """Finds the signals in a table.

    **Arguments:**

    - `source`: the file or recording it comes from.
    - `table`: its columns.
    - `told`: maps our names to theirs; by default, default names and known layouts apply.

    **Raises:** `RecordingError` for a column that is missing, duplicated or not numeric.
    """
    labels, quantised = labels_of(source, table, told)
    columns = aligned(source, table.columns, labels)
    there = eqx.tree_at(lambda t: t.columns, table, columns)
    signals = {signal: _stack(source, there, signal, names) for signal, names in labels.items()}
    if "time" in (told.columns or {}) and signals["time"].size == 1 < len(signals["q"]):
        signals["time"] = _counted(source, signals["time"], len(signals["q"]), labels["time"][0])
    return Picked(signals, labels, quantised, table.lines)


def labels_of(source: str, table: Table, told: Description) -> tuple[dict[str, list[str]], bool]:
    """Columns by signal, and whether positions that look like whole encoder counts are counts.

    **Raises:** `RecordingError` for a signal that is not found.
    """
    layouts = ((layout, layout.columns(table.columns)) for layout in known_layouts())
    known = next(((layout, names) for layout, names in layouts if names is not None), None)
    # A mapping or a `time` column means that the file does not have a known layout.
    if told.columns is not None or "time" in table.columns:
        known = None
    named = by_joint(source, table, told)
    labels = _resolve(source, table, known[1] if known else told.columns, named)
    return labels, known is not None and known[0].quantised


def _counted(
    source: str, period: Float64[np.ndarray, "..."], samples: int, name: str
) -> Float64[np.ndarray, " samples"]:
    """Times from a period, if a file has no time column."""
    every = float(period.reshape(()))
    if not 0 < every < np.inf:
        raise problem(
            source, f"{name} is a period of {every:.6g}", "give the time between two samples, s"
        )
    return every * np.arange(samples)


def _resolve(
    source: str, table: Table, columns: Columns | None, named: dict[str, list[str]]
) -> dict[str, list[str]]:
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
            found = [signal] if signal == "time" else named.get(signal, [])
            found = found or _default_names(source, table, signal)
            if found:
                labels[signal] = found
    _same_count(source, table, labels, columns or {})
    return {signal: labels[signal] for signal in SIGNALS if signal in labels}


def _default_names(source: str, table: Table, signal: str) -> list[str]:
    here = {*table.columns, *table.refused}
    if signal in HELD:
        # A plain kp or supply is often a constant of the drive rather than a signal.
        here = {name for name in here if name.startswith(f"{signal}_")}
    stem, numbers = f"{signal}_", _numbers(f"{signal}_", here)
    # A plain v1 may be a voltage; the other names are unambiguous.
    if not numbers and signal != "v" and (plain := _numbers(signal, here)):
        stem, numbers = signal, plain
    if signal in here and numbers:
        raise problem(
            source,
            f"there are both {signal} and {stem}{min(numbers)}",
            f"keep one, or choose by columns={{'{signal}': ...}}",
        )
    if signal in here:
        return [signal]
    first_absent = next(k for k in itertools.count(1) if k not in numbers)
    if numbers and max(numbers) > first_absent:
        absent, beside = f"{stem}{first_absent}", f"{stem}{max(numbers)}"
        raise missing(source, table, signal, absent, beside)
    return [f"{stem}{k}" for k in range(1, first_absent)]


def _numbers(stem: str, names: Collection[str]) -> set[int]:
    """Numbers of the joints that have a column with this stem."""
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
    if signal == "time":
        return _factor(source, table, signal, names[0])
    # A constant gain may be given as a number instead of a column.
    column = _factor if signal in HELD else _column
    columns = [column(source, table, signal, name) for name in names]
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
    # A path in HDF5 may begin at the root.
    for there in (name, name.removeprefix("/")):
        if there in table.columns:
            return numeric(source, name, table.columns[there], table.lines)
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
    """A factor of a product: a column, or a literal number."""
    if name not in table.columns:
        with contextlib.suppress(ValueError):
            return np.asarray(float(name))
    return _column(source, table, signal, name)


def missing(source: str, table: Table, signal: str, name: str, beside: str = "") -> Exception:
    """The error for a column that is missing or cannot be read."""
    if signal in table.unclear:
        return problem(
            source,
            f"it is not clear which columns are {signal}: {table.unclear[signal]}",
            f"name them: columns={{'{signal}': ...}}, --column {signal}=...",
        )
    if table.defaults and signal not in table.defaults and name == f"{signal}_1":
        what = {"q": "positions", "tau": "torques (effort)"}.get(signal, signal)
        others = {of: ", ".join(joints) for of, joints in table.defaults.items()}
        return problem(
            source,
            f"no column has {what} of joints, there are {others}",
            f"record them, or name their columns: columns={{'{signal}': ...}}, --column "
            f"{signal}=... (jaxid.recording.contents_of lists all columns)",
        )
    if name in table.refused:
        return problem(
            source,
            f"{brief(name)} is a {table.refused[name]}",
            "save plain arrays of numbers, in MATLAB by save(file, '-struct', 's')",
        )
    what = f"column {brief(name)} is missing" + (f", but {brief(beside)} is there" * bool(beside))
    # A similar name that is valid is another signal, not a misspelling of this one.
    well_named = re.compile(rf"({'|'.join(SIGNALS)})(_\d+)?")
    what += near(name, (other for other in table.columns if not well_named.fullmatch(other)))
    if table.refused and not table.columns:
        struct, kind = next(iter(table.refused.items()))
        return problem(
            source,
            f"{what}, the file contains only {brief(struct)}, a {kind}",
            "save plain arrays of numbers, in MATLAB by save(file, '-struct', 's')",
        )
    likely = likely_columns(table.columns)
    if signal not in likely:
        likely = {signal: ["..."]}
    told = [f"{of}={','.join(those)}" for of, those in likely.items()]
    options = " ".join(f"--column {shlex.quote(one)}" for one in told)
    return problem(
        source,
        f"{what}, there are {brief(list(table.columns))}",
        f"rename it, or name its column: columns={{'{signal}': ...}}, or {options}",
    )
