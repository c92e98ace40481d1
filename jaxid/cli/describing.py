"""What the columns of a log may mean, and the TOML file that says what they do."""

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..recording import Contents

# What logs call the signals, numbers and folders aside; the first that is there is meant. A name
# may go on after it, as pos_measured.
_CALLED = {
    "time": ("time", "t", "stamp", "timestamp", "time_s", "sec", "ms", "dt", "period"),
    "q": ("q", "pos", "position", "angle", "theta", "joint_pos", "qpos", "actual_q"),
    "tau": ("tau", "torque", "effort", "trq", "force", "i", "current", "cur", "actual_current"),
    "v": ("dq", "qd", "qp", "vel", "velocity", "speed", "omega", "joint_vel", "qvel", "actual_qd"),
    "q_ref": ("q_ref", "qref", "qr", "ref", "des", "q_des", "target", "target_q", "goal", "cmd"),
}
_MORE = {"q_ref": ("q_goal", "q_cmd", "action"), "tau": ("pwm", "duty", "voltage", "volts")}
# What is proportional to torque at best.
_CURRENTS = ("i", "cur", "current", "actual_current", "amps")
_VOLTAGES = ("pwm", "duty", "voltage", "volts")
_UNITS = {"time": ("ms", "us"), "q": ("deg", "mm", "mrad"), "q_ref": ("deg", "mm", "mrad")}


def guess(names: Sequence[str]) -> dict[str, Any]:
    """Which columns a log's names may mean; empty where a signal that is needed is not found."""
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
    """A column's name without its folder and number, and that number."""
    match = re.fullmatch(r"(.*?)[_.\[ ]*(\d*)\]?", name.strip().lower().rpartition("/")[2])
    assert match is not None
    return match[1], int(match[2] or 0)


def _word(signal: str, words: Sequence[str], stems: Mapping[str, Any]) -> str | None:
    """The stem that is one of the words, or else begins with one of more than two letters."""
    exact = next((word for word in words if word in stems), None)
    # Nothing is a time only because its name begins like one.
    longer = () if signal == "time" else (f"{word}_" for word in words if len(word) > 2)
    begun = (stem for word in longer for stem in stems if stem.startswith(word))
    if signal == "time" and exact is None:
        begun = (s for s in stems if re.fullmatch(r"(time|stamp|timestamp|t)_\w+", s))
    return exact or next(begun, None)


def guess_units(columns: Mapping[str, Any], given: Sequence[str]) -> dict[str, str]:
    """Units that names of columns end with, of signals for which none is given as `q=deg`."""
    told = {item.partition("=")[0].strip() for item in given}
    found = {}
    for signal, names in columns.items():
        stem, _ = _parts(names if isinstance(names, str) else names[0])
        ending = re.split(r"[_ \[(]", stem)[-1].rstrip(")]")
        if signal not in told and ending in _UNITS.get(signal, ()):
            found[signal] = ending
    return found


def on_torque(names: Sequence[str]) -> str:
    """What to say where columns taken for torque are called otherwise; nothing where they are not.

    **Arguments:**

    - `names`: the columns of `tau`; a product has been given its factor.
    """
    stems = {_parts(name)[0] for name in names if "*" not in name}
    if stems & {*_CURRENTS}:
        return (
            "tau is a current by its name: give torque constant times gear ratio of each joint as "
            "scale (--write, then [scale])"
        )
    if stems & {*_VOLTAGES}:
        return (
            "tau is a duty cycle or a voltage by its name, from which the motor's law makes a "
            "torque: it is proportional to it only where the motor hardly turns"
        )
    return ""


def description(told: Mapping[str, Any], found: Contents, joints: int) -> str:
    """A TOML file that says how files are read, with what else may be said in it.

    **Arguments:**

    - `told`: what was said when they were read, by the names of `jaxid.read`.
    - `found`: what the first of them holds.
    - `joints`: how many there are.
    """
    units = {"time": "s", "q": ["rad"] * joints, "tau": ["Nm"] * joints} | told.get("units", {})
    scale = {"q": [1.0] * joints, "tau": [1.0] * joints} | told.get("scale", {})
    columns = [f"{name} = {json.dumps(value)}" for name, value in _columns(found).items()]
    named = bool(found.joints) and "columns" not in told
    lines = [
        "# How jaxid reads these logs: jaxid discover FILES --log THIS.toml",
        f"gaps = {json.dumps(told.get('gaps', 'refuse'))}  # allow or refuse: missing stretches",
        f"clock = {json.dumps(told.get('clock', 'recorded'))}  # or even: where times jitter",
        f"nan = {json.dumps(told.get('nan', 'refuse'))}  # or drop: empty samples",
    ]
    if "resolution" in told:
        lines.append(f"resolution = {json.dumps(told['resolution'])}  # encoder step, rad or m")
    if found.joints:
        order = told.get("joints") or [name.rpartition("/")[2] for name in found.signals["q"]]
        mark = "" if named else "# "
        lines.append(f"{mark}joints = {json.dumps(order)}  # in the order of the robot")
    if named:
        lines += ["", "# Columns follow joints; these are for others than those found:"]
        lines += ["# [columns]", *(f"# {line}" for line in columns)]
    else:
        lines += ["", "[columns]", *columns]
    lines += [
        "",
        "[units]  # rad, deg, turn, m, mm; Nm, mNm, N; s, ms, us",
        *(f"{name} = {json.dumps(value)}" for name, value in units.items()),
        "",
        "[scale]  # of current: torque constant times gear ratio; of counts: rad or m in each",
        *(f"{name} = {json.dumps(value)}" for name, value in scale.items()),
    ]
    return "\n".join(lines) + "\n"


def _columns(found: Contents) -> dict[str, Any]:
    return {
        signal: names[0] if signal == "time" else names for signal, names in found.signals.items()
    }


def taken(found: Contents) -> str:
    """Which columns are which signal, where they are named by joint."""
    parts = []
    for signal, names in found.signals.items():
        stem = _common(names) if len(names) > 1 else ""
        stem = stem[: max(stem.rfind("/"), stem.rfind(".")) + 1]
        listed = ", ".join(name.removeprefix(stem) for name in names)
        parts.append(f"{signal} = {stem}{{{listed}}}" if stem else f"{signal} = {listed}")
    return "; ".join(parts)


def _common(names: Sequence[str]) -> str:
    """What all names begin with."""
    same = itertools.takewhile(lambda column: len(set(column)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in same)
