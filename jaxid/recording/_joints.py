"""Assignment of columns that are named by joint, in the order of the robot."""

import re
import warnings
from collections.abc import Sequence

from ..errors import JaxidWarning, brief, near
from ._description import Description
from ._problem import problem
from ._table import Table


def by_joint(source: str, table: Table, told: Description) -> dict[str, list[str]]:
    """Columns by signal if joints have names, in the order of the robot.

    **Arguments:**

    - `source`: the file or recording it comes from.
    - `table`: its columns.
    - `told`: joints, and columns that the user gives explicitly.

    **Raises:** `RecordingError` for joints that do not exist.
    """
    found, joints = table.defaults, told.joints
    if joints is not None and not found:
        raise problem(
            source,
            "joints cannot be chosen, because its columns are not named by joint",
            "give columns in the order of the robot",
        )
    given = told.columns or {}
    needed = [found[s] for s in ("q", "tau") if s in found and s not in given]
    here = [j for j in next(iter(needed), {}) if all(j in named for named in needed)]
    if joints is None:
        joints = here if table.ordered else sorted(here, key=_natural)
        _say_order(source, table, joints, needed)
    joints = [joints] if isinstance(joints, str) else list(joints)
    for joint in joints:
        there = list(dict.fromkeys(j for named in found.values() for j in named))
        if joint not in there:
            raise problem(
                source,
                f"there is no joint {brief(joint)}{near(joint, there)}",
                f"choose from {brief(there)}",
            )
    labels = {}
    for signal, named in found.items():
        absent = [joint for joint in joints if joint not in named]
        if not absent and joints:
            labels[signal] = [named[joint] for joint in joints]
        elif signal not in given and len(absent) < len(joints):
            warnings.warn(
                f"{source}: {signal} is left out, because {', '.join(absent)} does not have it; to "
                "use it, give joints= (joints in the file of --log) without such joints.",
                JaxidWarning,
                stacklevel=6,
            )
    return labels


def _say_order(
    source: str, table: Table, joints: Sequence[str], needed: Sequence[dict[str, str]]
) -> None:
    """Warns of an order that was not given, and of joints that lack a required signal."""
    left = list(dict.fromkeys(j for named in needed for j in named if j not in joints))
    if left:
        warnings.warn(
            f"{source}: {', '.join(left)} is left out, because it does not have both a position "
            "and a torque.",
            JaxidWarning,
            stacklevel=7,
        )
    # Numbers already give the order.
    numbered = len({re.sub(r"\d+", "", joint) for joint in joints}) < 2
    if not table.ordered and not numbered:
        warnings.warn(
            f"{source}: joints are in the order of their names, {', '.join(joints)}; give joints= "
            "(joints in the file of --log) in the order of the robot.",
            JaxidWarning,
            stacklevel=7,
        )


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key for names that contain numbers."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)]
