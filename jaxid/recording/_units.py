"""Units of files, and their conversion factors to SI."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from ..errors import brief, near
from ._problem import problem

_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_POSITION = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": math.pi / 180,
    "turn": 2 * math.pi,
    "m": 1.0,
    "mm": 1e-3,
}
_VELOCITY = {f"{unit}/s": factor for unit, factor in _POSITION.items()} | {"rpm": math.pi / 30}
_VOLTAGE = {"V": 1.0, "mV": 1e-3}
# A drive that is commanded by voltage has a voltage instead of a torque.
_TORQUE = {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "kNm": 1e3, "N": 1.0, "kN": 1e3} | _VOLTAGE
_GAIN = {"1": 1.0}

# Every signal of a recording with its possible units, in the order of columns.
SIGNALS: Mapping[str, Mapping[str, float]] = {
    "time": _TIME,
    "q": _POSITION,
    "q_ref": _POSITION,
    "tau": _TORQUE,
    "v": _VELOCITY,
    "tau_ff": _TORQUE,
    "v_ref": _VELOCITY,
    "kp": _GAIN,
    "kd": _GAIN,
    "supply": _VOLTAGE,
    "on": {"1": 1.0},
}
# Commands and supply voltages of a drive; each value is constant until the next sample.
HELD = ("v_ref", "kp", "kd", "supply", "on")

# Signals of the same instrument have the same unit by default.
_SAME_UNIT_AS = {"q_ref": "q", "tau_ff": "tau", "v_ref": "v"}

Units = Mapping[str, str | Sequence[str]]


def factors(
    source: str, units: Units | None, scale: Mapping[str, float | int | Sequence[float]] | None
) -> dict[str, Float64[np.ndarray, " factors"]]:
    """Factors from the units of a file to SI.

    **Arguments:**

    - `source`: the file or recording the units are for.
    - `units`: unit by signal, one for all joints or one for each.
    - `scale`: factor by signal, one for all joints or one for each.

    **Returns:** factors by signal; one, or one for each joint.

    **Raises:** `RecordingError` for an unknown signal or unit, and for a factor that is zero or not
        a number.
    """
    in_units, scaled = _completed(source, "units", units), _completed(source, "scale", scale)
    found = {}
    for signal in SIGNALS:
        unit = _factor(source, signal, in_units.get(signal))
        times = _scale(source, signal, scaled.get(signal, 1.0))
        if len(unit) > 1 < len(times) and len(unit) != len(times):
            raise problem(
                source,
                f"units gives {len(unit)} units for {signal} and scale {len(times)} factors",
                "give one for all joints, or one for each",
            )
        found[signal] = unit * times
    return found


def _completed(source: str, what: str, given: Mapping[str, Any] | None) -> dict[str, Any]:
    """The given values by signal, completed for signals that share the unit of another."""
    whole = dict(given or {})
    for signal in whole:
        if signal not in SIGNALS:
            raise problem(
                source,
                f"{what} names {signal!r}{near(signal, SIGNALS)}",
                f"give {what} for {', '.join(SIGNALS)} only",
            )
    for signal, other in _SAME_UNIT_AS.items():
        if signal not in whole and other in whole:
            whole[signal] = whole[other]
    return whole


def _scale(source: str, signal: str, given: Any) -> Float64[np.ndarray, " factors"]:
    try:
        times = np.atleast_1d(np.asarray(given, dtype=np.float64))
    except (TypeError, ValueError):
        times = np.array([np.nan])
    if times.ndim != 1 or not times.size or not (np.isfinite(times) & (times != 0)).all():
        raise problem(
            source,
            f"scale of {signal} is {brief(given)}",
            "give one factor that is not zero, or one for each joint, such as torque constant "
            "times gear ratio",
        )
    return times


def _factor(
    source: str, signal: str, unit: str | Sequence[str] | None
) -> Float64[np.ndarray, " units"]:
    if unit is None:
        return np.ones(1)
    known = SIGNALS[signal]
    names = [unit] if isinstance(unit, str) else list(unit)
    for name in names:
        if _plain(name) not in known:
            raise problem(
                source,
                f"{name!r} is not a unit known for {signal}{near(_plain(name), known)}",
                f"use one of {', '.join(known)}",
            )
    return np.array([known[_plain(name)] for name in names])


def _plain(unit: str) -> str:
    # N·m is written in many ways, and micro has two code points.
    dotless = unit.translate(str.maketrans("", "", "·⋅.* "))
    return dotless.replace("µ", "u").replace("μ", "u").replace("°", "deg").replace("rev", "turn")
