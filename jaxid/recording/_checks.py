"""Checks of a recording before anything is computed from it."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from ..errors import JaxidWarning, brief
from ._problem import Labels, Lines, label, place, problem
from ._times import Gaps, even, increasing, missing_after, steady
from ._units import HELD, SIGNALS, Units, factors

Nan = Literal["refuse", "drop"]
Clock = Literal["recorded", "even"]

_FEWEST_SAMPLES = 20
_LARGEST = 1e30
# Smallest jump of a position that is reported, in units of nearly its largest usual step.
_JUMP = 20.0


class Accept(eqx.Module):
    """Which faults of a recording to accept.

    - `gaps`: `"allow"` for missing stretches of time.
    - `nan`: `"drop"` to leave out samples at which a signal is empty.
    - `clock`: `"even"` to replace times that jitter by evenly spaced ones.
    """

    gaps: Gaps = "refuse"
    nan: Nan = "refuse"
    clock: Clock = "recorded"

    def __check_init__(self) -> None:
        for name, chosen, known in (
            ("gaps", self.gaps, get_args(Gaps)),
            ("nan", self.nan, get_args(Nan)),
            ("clock", self.clock, get_args(Clock)),
        ):
            if chosen not in known:
                raise problem("read()", f"{name} is {chosen!r}", f"give {' or '.join(known)}")


def numeric(
    source: str, column: str, values: object, lines: Lines = ()
) -> Float64[np.ndarray, "..."]:
    """Converts numbers of any shape to float64.

    **Arguments:**

    - `source`: the file or recording they come from.
    - `column`: their name there.
    - `values`: array-like; a missing value becomes NaN.
    - `lines`: line numbers of its rows in a text file.

    **Raises:** `RecordingError` for text, objects, booleans, dates, complex or ragged values.
    """
    import pandas as pd

    try:
        if isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "iuf":
            values = np.ma.filled(values.astype(np.float64), np.nan)
        if isinstance(values, pd.Series) and values.dtype.kind in "iuf":
            values = values.to_numpy(np.float64, na_value=np.nan)
        array = np.asarray(values)
        if array.dtype.kind == "O" and array.ndim == 1 and _are_lists(array):
            array = np.stack([np.asarray(cell) for cell in array])
        if array.dtype.kind in "iuf":
            with np.errstate(over="ignore"):
                return array.astype(np.float64)
    except Exception as error:  # array-likes may run foreign code, which may raise anything
        raise problem(
            source,
            f"{column} is ragged or not an array of numbers",
            "give one number for each sample and joint",
        ) from error
    raise _not_numeric(source, column, array, lines)


def _are_lists(array: np.ndarray) -> bool:
    """Whether the cells of a column are lists with one value per joint."""
    return len(array) > 0 and all(isinstance(cell, list | tuple | np.ndarray) for cell in array)


def _not_numeric(source: str, column: str, array: np.ndarray, lines: Lines) -> Exception:
    remedies = {
        "b": ("booleans", "give it as numbers"),
        "c": ("complex values", "give its real part"),
        "m": ("time differences", "give plain numbers, time in seconds"),
        "M": ("dates", "give plain numbers, time in seconds from the start"),
    }
    if array.dtype.kind in remedies:
        kind, remedy = remedies[array.dtype.kind]
        return problem(source, f"{column} holds {kind}", remedy)
    for index, cell in np.ndenumerate(array):
        if not is_number(cell):
            return problem(
                source,
                f"{column}, {place(index[0] if index else 0, lines)} holds {brief(cell)}, which "
                "is not a number",
                "correct or remove it, and write numbers with a decimal point",
            )
    return problem(
        source, f"{column} holds text or Python objects", "convert it to floats beforehand"
    )


def is_number(cell: object) -> bool:
    """Whether a cell can be read as one real number."""
    try:
        float(cell)  # pyright: ignore[reportArgumentType]
    except Exception:  # a cell may be any object
        return False
    return True


def validate(
    source: str,
    signals: Mapping[str, Float64[np.ndarray, "..."]],
    labels: Labels,
    units: Units | None,
    scale: Mapping[str, float | int | Sequence[float]] | None,
    accept: "Accept",
    lines: Lines = (),
) -> dict[str, Float64[np.ndarray, "..."]]:
    """Checked signals in SI units.

    **Arguments:**

    - `source`: the file or recording they come from.
    - `signals`: values by signal, in the units of the file; 1-d means one joint.
    - `labels`: names of the columns of each signal in the file.
    - `units`, `scale`: unit and factor by signal.
    - `accept`: which faults of the file to accept.
    - `lines`: line numbers of the rows in a text file.

    **Returns:** `time` `(samples,)` and the others `(samples, joints)`.

    **Raises:** `RecordingError` for the first thing that is wrong.
    """
    by_signal = factors(source, units, scale)
    shaped = _shapes(source, signals, labels)
    if len(shaped["time"]) < _FEWEST_SAMPLES:
        raise problem(
            source,
            f"it has only {len(shaped['time'])} samples",
            f"record at least {_FEWEST_SAMPLES}",
        )
    if accept.nan == "drop":
        shaped, lines = _without_blanks(source, shaped, lines)
    checked = {}
    for signal, values in shaped.items():
        joints = values.shape[1] if values.ndim == 2 else 1
        factor = by_signal[signal]
        if len(factor) not in (1, joints):
            what = "units" if np.size((units or {}).get(signal, "")) > 1 else "scale"
            raise problem(
                source,
                f"{what} gives {len(factor)} {what.replace('scale', 'factors')} for {signal} of "
                f"{joints} joints",
                "give one, or one for each joint",
            )
        with np.errstate(over="ignore"):
            checked[signal] = values * factor
        _finite(source, signal, checked[signal], labels, lines)
        _bounded(source, signal, checked[signal], labels, lines)
    if accept.clock == "even":
        checked["time"] = even(source, checked["time"], lines)
    increasing(source, checked["time"], labels, accept.gaps, lines)
    steady(source, checked)
    for signal in ("q", "tau"):
        _moving(source, signal, checked[signal], labels)
    _plausible(source, checked, units or {})
    _continuous(source, checked, labels, lines)
    return checked


def _without_blanks(
    source: str, signals: dict[str, Float64[np.ndarray, "..."]], lines: Lines
) -> tuple[dict[str, Float64[np.ndarray, "..."]], Lines]:
    """Signals without the samples at which one of them is empty; a warning counts these."""
    blank = np.any(
        [~np.isfinite(x.reshape(len(x), -1)).all(axis=1) for x in signals.values()], axis=0
    )
    if not blank.any():
        return signals, lines
    warnings.warn(
        f"{source}: {blank.sum()} of {len(blank)} samples are left out, because a signal is empty "
        f"or not finite, first at {place(int(np.argmax(blank)), lines)}.",
        JaxidWarning,
        stacklevel=5,
    )
    kept = tuple(line for line, gone in zip(lines, blank, strict=True) if not gone) if lines else ()
    return {name: x[~blank] for name, x in signals.items()}, kept


def _shapes(
    source: str, signals: Mapping[str, Float64[np.ndarray, "..."]], labels: Labels
) -> dict[str, Float64[np.ndarray, "..."]]:
    time = signals["time"]
    if time.ndim == 2 and time.shape[1] == 1:
        time = time[:, 0]
    if time.ndim != 1:
        raise problem(source, f"time has shape {time.shape}", "give one column of times")
    shaped = {"time": time}
    for signal in (signal for signal in SIGNALS if signal in signals and signal != "time"):
        values = signals[signal]
        if signal in HELD and not np.ndim(values):
            # A single number applies to all samples.
            values = np.broadcast_to(values, np.shape(shaped["q"])).copy()
        values = values[:, None] if np.ndim(values) == 1 else values
        name = brief(", ".join(labels.get(signal, (signal,))))
        if np.ndim(values) != 2 or np.shape(values)[1] == 0:
            raise problem(
                source,
                f"{signal} ({name}) has shape {signals[signal].shape}",
                "give it as (samples, joints)",
            )
        if len(values) != len(time):
            raise problem(
                source,
                f"{signal} ({name}) has {len(values)} rows, but time has {len(time)}",
                f"give {signal} as (samples, joints), transposed if necessary",
            )
        shaped[signal] = values
    joints = shaped["q"].shape[1]
    for signal, values in shaped.items():
        if signal != "time" and values.shape[1] != joints:
            raise problem(
                source,
                f"q has {joints} joints, but {signal} has {values.shape[1]}",
                f"give one column of {signal} for each joint",
            )
    return shaped


def _finite(
    source: str, signal: str, values: Float64[np.ndarray, "..."], labels: Labels, lines: Lines
) -> None:
    if np.isfinite(values).all():
        return
    table = values.reshape(len(values), -1)
    row, joint = np.argwhere(~np.isfinite(table))[0].tolist()
    raise problem(
        source,
        f"{label(labels, signal, joint, table.shape[1])}, {place(row, lines)} is empty or not "
        f"finite ({table[row, joint]})",
        'remove that sample, or pass nan="drop" to leave such samples out (--drop-nan)',
    )


def _bounded(
    source: str, signal: str, values: Float64[np.ndarray, "..."], labels: Labels, lines: Lines
) -> None:
    """Refuses unphysical values whose squares overflow float64."""
    table = values.reshape(len(values), -1)
    row, joint = np.unravel_index(np.abs(table).argmax(), table.shape)
    if abs(table[row, joint]) > _LARGEST:
        raise problem(
            source,
            f"{label(labels, signal, int(joint), table.shape[1])} reaches {table[row, joint]:.3g} "
            f"in SI units at {place(int(row), lines)}",
            "correct it, or give its unit",
        )


def _moving(
    source: str, signal: str, values: Float64[np.ndarray, "samples joints"], labels: Labels
) -> None:
    for joint, column in enumerate(values.T):
        if (column == column[0]).all():
            raise problem(
                source,
                f"{signal} of joint {joint + 1} ({label(labels, signal, joint, len(values.T))}) "
                f"is constant at {column[0]:.6g}",
                "check the column's name, or leave that joint out of q and tau",
            )


def _plausible(
    source: str, signals: Mapping[str, Float64[np.ndarray, "..."]], units: Units
) -> None:
    if "q" not in units and np.abs(signals["q"]).max() > 30:
        joint = int(np.abs(signals["q"]).max(axis=0).argmax())
        warnings.warn(
            f"{source}: q of joint {joint + 1} reaches {np.abs(signals['q']).max():.4g} rad, which "
            'looks like degrees; pass units={"q": "deg"}, or units={"q": "rad"} if it is right.',
            JaxidWarning,
            stacklevel=5,
        )
    first, last = signals["time"][0], signals["time"][-1]
    if abs(first) > 100 * (last - first):
        warnings.warn(
            f"{source}: time begins at {first:.10g} s, far from zero: effects that depend on time "
            "(such as friction that fades as a joint warms) assume that the motion begins at zero, "
            "so subtract the time at which it began.",
            JaxidWarning,
            stacklevel=5,
        )
    if "time" not in units and np.median(np.diff(signals["time"])) >= 1:
        warnings.warn(
            f"{source}: samples are {np.median(np.diff(signals['time'])):.4g} s apart, which looks "
            'like milliseconds; pass units={"time": "ms"}, or units={"time": "s"} if it is right.',
            JaxidWarning,
            stacklevel=5,
        )


def _continuous(
    source: str, signals: Mapping[str, Float64[np.ndarray, "..."]], labels: Labels, lines: Lines
) -> None:
    """Warns of a position that jumps: an outlier, or an angle that is cut off at a turn."""
    whole = ~missing_after(signals["time"])
    for joint, column in enumerate(signals["q"].T):
        steps = np.where(whole, np.abs(np.diff(column)), 0.0)
        usual = float(np.quantile(steps, 0.99))
        # An outlier jumps there and back by nearly the same.
        row = int(np.argmax(steps > 0.9 * steps.max()))
        if usual == 0 or steps[row] < _JUMP * usual:
            continue
        turned = abs(steps[row] - 2 * np.pi) < 0.1 * np.pi
        remedy = (
            "which is a turn: unwrap the angle (numpy.unwrap)"
            if turned
            else "where it moves on less at nearly all others: correct that sample, or cut there"
        )
        warnings.warn(
            f"{source}: {label(labels, 'q', joint, signals['q'].shape[1])} jumps by "
            f"{steps[row]:.3g} rad or m at {place(row + 1, lines)}, {remedy}.",
            JaxidWarning,
            stacklevel=5,
        )
