"""Guesses which columns of a file are which signals, for an error message."""

import re
from collections.abc import Collection

# Words of loggers for each signal; `q_ref` is a position with one of the words of `_AIM`.
_WORDS = {
    "time": {"t", "time", "timestamp", "stamp", "clock"},
    "q": {"q", "qm", "pos", "position", "positions", "angle", "angles", "theta", "encoder"},
    "v": {"v", "vel", "velocity", "velocities", "speed", "speeds", "qd", "dq", "omega"},
    "tau": {"tau", "torque", "torques", "trq", "effort", "efforts", "force"},
}
_AIM = {"ref", "reference", "target", "des", "desired", "cmd", "command", "goal", "setpoint"}
# Columns with these words are not the signal itself.
_OTHER = {"err", "error", "max", "min", "limit", "std", "var", "temp", "temperature", "mode"}


def likely_columns(names: Collection[str]) -> dict[str, list[str]]:
    """The columns of a file that are probably its signals, one per joint, by signal.

    A signal is left out if no columns have a usual name of it, or if several sets of columns have.

    **Arguments:**

    - `names`: all columns of the file, in their order.
    """
    groups: dict[str, dict[str, list[str]]] = {}
    for name in names:
        signal = _signal(name)
        if signal is not None:
            stem = re.sub(r"\d+", "#", name)
            groups.setdefault(signal, {}).setdefault(stem, []).append(name)
    clear = {signal: next(iter(g.values())) for signal, g in groups.items() if len(g) == 1}
    if len(clear.get("time", ())) > 1:
        del clear["time"]
    return {signal: sorted(clear[signal], key=_numbers) for signal in _ORDER if signal in clear}


_ORDER = ("time", "q", "q_ref", "v", "tau")


def _signal(name: str) -> str | None:
    """The signal that a column is called after; None if it is none or not clear."""
    # Units in brackets, and parts in camel case, are words of their own.
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", re.sub(r"[\[(].*?[\])]", " ", name))
    words = set(re.findall(r"[a-z]+", parted.lower()))
    found = [signal for signal, usual in _WORDS.items() if words & usual]
    if len(found) != 1 or words & _OTHER:
        return None
    if not words & _AIM:
        return found[0]
    return "q_ref" if found[0] == "q" else None


def _numbers(name: str) -> list[int]:
    """The numbers in a name, by which joints are sorted."""
    return [int(number) for number in re.findall(r"\d+", name)]
