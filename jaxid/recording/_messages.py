"""Joint signals in ROS messages."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

# A field, names of joints, and one value for each.
Field = tuple[str, Sequence[str], Any]


class Kind(eqx.Module):
    """A message type: its fields by joint, and the signals that they may supply.

    - `fields`: returns the fields of one message; those without values are empty.
    - `roles`: fields by signal, the preferred field first.
    """

    fields: Callable[[Any], Iterator[Field]]
    roles: Mapping[str, Sequence[str]]


def _joint_state(message: Any) -> Iterator[Field]:
    for field in ("position", "velocity", "effort"):
        yield field, message.name, getattr(message, field)


def _trajectory_state(message: Any) -> Iterator[Field]:
    # Until Humble: desired, actual, error. Since then also reference, feedback, output.
    for part in ("reference", "feedback", "desired", "actual", "output"):
        point = getattr(message, part, None)
        for field in ("positions", "velocities", "effort"):
            if point is not None:
                yield f"{part}/{field}", message.joint_names, getattr(point, field)


def _dynamic(message: Any) -> Iterator[Field]:
    found: dict[str, tuple[list[str], list[float]]] = {}
    for joint, one in zip(message.joint_names, message.interface_values, strict=True):
        for interface, value in zip(one.interface_names, one.values, strict=True):
            names, values = found.setdefault(interface, ([], []))
            names.append(joint)
            values.append(value)
    for interface, (names, values) in found.items():
        yield interface, names, np.asarray(values, dtype=np.float64)


def _degrees_of_freedom(message: Any) -> Iterator[Field]:
    names = [one.name for one in message.dof_states]
    for field in ("reference", "feedback", "feedback_dot", "output"):
        yield field, names, np.array([getattr(one, field) for one in message.dof_states])


def kinds() -> dict[str, Kind]:
    """Message types that can be read, by name."""
    states = {"q": ["position"], "v": ["velocity"], "tau": ["effort"]}
    trajectory = Kind(
        _trajectory_state,
        {
            "q": ["feedback/positions", "actual/positions"],
            "v": ["feedback/velocities", "actual/velocities"],
            "q_ref": ["reference/positions", "desired/positions"],
            "tau": ["output/effort", "feedback/effort", "actual/effort"],
        },
    )
    freedoms = Kind(
        _degrees_of_freedom, {"q": ["feedback"], "v": ["feedback_dot"], "q_ref": ["reference"]}
    )
    return {
        "sensor_msgs/msg/JointState": Kind(_joint_state, states),
        "control_msgs/msg/DynamicJointState": Kind(_dynamic, states),
        "control_msgs/msg/JointTrajectoryControllerState": trajectory,
        "control_msgs/msg/MultiDOFStateStamped": freedoms,
    }
