"""Guesses the signals in the columns of a log, and writes the TOML file that describes them."""

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..recording import Contents

# Common names of the signals, without numbers and folders; the first one that occurs is used. A
# column name may have a suffix, such as pos_measured.
_CALLED = {
    "time": ("time", "t", "stamp", "timestamp", "time_s", "sec", "ms", "dt", "period"),
    "q": ("q", "pos", "position", "angle", "theta", "joint_pos", "qpos", "actual_q"),
    "tau": ("tau", "torque", "effort", "trq", "force", "i", "current", "cur", "actual_current"),
    "v": ("dq", "qd", "qp", "vel", "velocity", "speed", "omega", "joint_vel", "qvel", "actual_qd"),
    "q_ref": ("q_ref", "qref", "qr", "ref", "des", "q_des", "target", "target_q", "goal", "cmd"),
}
_MORE = {"q_ref": ("q_goal", "q_cmd", "action"), "tau": ("pwm", "duty", "voltage", "volts")}
# Signals that are at best proportional to torque.
_CURRENTS = ("i", "cur", "current", "actual_current", "amps")
_VOLTAGES = ("pwm", "duty", "voltage", "volts")
_UNITS = {"time": ("ms", "us"), "q": ("deg", "mm", "mrad"), "q_ref": ("deg", "mm", "mrad")}


def guess(names: Sequence[str]) -> dict[str, Any]:
    """Probable columns of the signals by name; empty if a required signal is not found."""
    stems: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        stem, number = _parts(name)
        stems.setdefault(stem, []).append((number, name))
    found: dict[str, Any] = {}
    for signal, words in _CALLED.items():
        word = _word(signal, (*words, *_MORE.get(signal, ())), stems)
        if word:
            numbered = [name for _, name in sorted(stems.pop(word))]
            found[signal] = numbered[0] if signal == "time" else numbered
    joints = len(found.get("q", ()))
    if "time" not in found or not joints or len(found.get("tau", ())) != joints:
        return {}
    return {k: v for k, v in found.items() if k == "time" or len(v) == joints}


def _parts(name: str) -> tuple[str, int]:
    """The name of a column without folder and number, and the number."""
    match = re.fullmatch(r"(.*?)[_.\[ ]*(\d*)\]?", name.strip().lower().rpartition("/")[2])
    assert match is not None
    return match[1], int(match[2] or 0)


def _word(signal: str, words: Sequence[str], stems: Mapping[str, Any]) -> str | None:
    """A stem that is one of the words, or one that begins with a word of three letters or more."""
    exact = next((word for word in words if word in stems), None)
    # A prefix alone does not identify the time; the stem must match the pattern below.
    longer = () if signal == "time" else (f"{word}_" for word in words if len(word) > 2)
    begun = (stem for word in longer for stem in stems if stem.startswith(word))
    if signal == "time" and exact is None:
        begun = (s for s in stems if re.fullmatch(r"(time|stamp|timestamp|t)_\w+", s))
    return exact or next(begun, None)


def guess_units(columns: Mapping[str, Any], given: Sequence[str]) -> dict[str, str]:
    """Units at the ends of column names, for signals without a given unit such as `q=deg`."""
    told = {item.partition("=")[0].strip() for item in given}
    found = {}
    for signal, names in columns.items():
        stem, _ = _parts(names if isinstance(names, str) else names[0])
        ending = re.split(r"[_ \[(]", stem)[-1].rstrip(")]")
        if signal not in told and ending in _UNITS.get(signal, ()):
            found[signal] = ending
    return found


def on_torque(names: Sequence[str]) -> str:
    """A remark if the names of the torque columns suggest another quantity; otherwise empty.

    **Arguments:**

    - `names`: the columns of `tau`; a product already contains its factor.
    """
    stems = {_parts(name)[0] for name in names if "*" not in name}
    if stems & {*_CURRENTS}:
        return (
            "tau seems to be a current (by its name): give torque constant times gear ratio of "
            "each joint as scale (--write, then [scale])"
        )
    if stems & {*_VOLTAGES}:
        return (
            "tau seems to be a duty cycle or a voltage (by its name): torque follows from it by "
            "the motor's law, and is proportional to it only at low speed"
        )
    return ""


def description(told: Mapping[str, Any], found: Contents, joints: int) -> str:
    """A TOML file that describes how files are read, with further options as comments.

    **Arguments:**

    - `told`: the options with which they were read, by the names of `jaxid.read`.
    - `found`: the contents of the first file.
    - `joints`: number of joints.
    """
    units = {"time": "s", "q": ["rad"] * joints, "tau": ["Nm"] * joints} | told.get("units", {})
    scale = {"q": [1.0] * joints, "tau": [1.0] * joints} | told.get("scale", {})
    columns = [f"{name} = {json.dumps(value)}" for name, value in _columns(found).items()]
    named = bool(found.joints) and "columns" not in told
    lines = [
        "# How jaxid reads these logs: jaxid discover FILES --log THIS.toml",
        f"gaps = {json.dumps(told.get('gaps', 'refuse'))}  # refuse or allow missing stretches",
        f"clock = {json.dumps(told.get('clock', 'recorded'))}  # or even, if the times jitter",
        f"nan = {json.dumps(told.get('nan', 'refuse'))}  # or drop empty samples",
    ]
    if "resolution" in told:
        lines.append(f"resolution = {json.dumps(told['resolution'])}  # encoder step, rad or m")
    if found.joints:
        order = told.get("joints") or [name.rpartition("/")[2] for name in found.signals["q"]]
        mark = "" if named else "# "
        lines.append(f"{mark}joints = {json.dumps(order)}  # in the order of the robot")
    if named:
        lines += ["", "# Columns follow from joints; to use other columns, edit these lines:"]
        lines += ["# [columns]", *(f"# {line}" for line in columns)]
    else:
        lines += ["", "[columns]", *columns]
    lines += [
        "",
        "[units]  # rad, deg, turn, m, mm; Nm, mNm, N; s, ms, us",
        *(f"{name} = {json.dumps(value)}" for name, value in units.items()),
        "",
        "[scale]  # current: torque constant times gear ratio; counts: rad or m per count",
        *(f"{name} = {json.dumps(value)}" for name, value in scale.items()),
    ]
    return "\n".join(lines) + "\n"


def _columns(found: Contents) -> dict[str, Any]:
    return {
        signal: names[0] if signal == "time" else names for signal, names in found.signals.items()
    }


def taken(found: Contents) -> str:
    """The columns of each signal, if they are named by joint."""
    parts = []
    for signal, names in found.signals.items():
        stem = _common(names) if len(names) > 1 else ""
        stem = stem[: max(stem.rfind("/"), stem.rfind(".")) + 1]
        listed = ", ".join(name.removeprefix(stem) for name in names)
        parts.append(f"{signal} = {stem}{{{listed}}}" if stem else f"{signal} = {listed}")
    return "; ".join(parts)


def _common(names: Sequence[str]) -> str:
    """The common prefix of all names."""
    same = itertools.takewhile(lambda column: len(set(column)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in same)
