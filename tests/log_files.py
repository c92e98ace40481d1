"""One motion of two joints, written by other packages in the formats that people bring."""

import json
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

JOINTS = ("shoulder", "elbow")
# Torque constants in N·m/A times gear ratios.
GAINS = (0.062 * 100, 0.05 * 50)
RATE = 100
STATE = "control_msgs/msg/JointTrajectoryControllerState"
STATE_TEXT = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
trajectory_msgs/JointTrajectoryPoint error
trajectory_msgs/JointTrajectoryPoint output
================================================================================
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
================================================================================
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def motion() -> pd.DataFrame:
    """Time in s, positions, velocities, references in rad, effort in A; 0.4 s are missing."""
    frame = np.concatenate([np.arange(120), np.arange(160, 300)])
    time = frame / RATE
    made = {"frame": frame, "time": time}
    for k, joint in enumerate(JOINTS):
        w = 2.0 + k
        made[f"q_{joint}"] = np.sin(w * time) + 0.1 * k
        made[f"v_{joint}"] = w * np.cos(w * time)
        made[f"i_{joint}"] = 0.3 * np.cos(3 * w * time) + 0.01 * k
        made[f"r_{joint}"] = np.sin(w * time + 0.02) + 0.1 * k
    return pd.DataFrame(made)


def typestore():
    """Messages of ROS with the state of a trajectory controller."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    own = get_types_from_msg(STATE_TEXT, STATE)
    store.register({k: v for k, v in own.items() if k not in store.fielddefs})
    return store


def bag(path: Path, storage: StoragePlugin, messages) -> Path:
    """A bag of topics, types and messages with the times at which they were received, ns."""
    store = typestore()
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for received, topic, message in messages(store.types):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], received, store.serialize_cdr(message, kind))
    return path


def header(types, stamp: int):
    """A header with a stamp in ns."""
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return types["std_msgs/msg/Header"](stamp=time, frame_id="")


def joint_state(types, stamp: int, names, **fields):
    """A `sensor_msgs/JointState`; fields that are not given are empty."""
    given = {f: np.array(fields.get(f, ()), float) for f in ("position", "velocity", "effort")}
    return types["sensor_msgs/msg/JointState"](
        header=header(types, stamp), name=list(names), **given
    )


def controller_state(types, stamp: int, names, **positions):
    """A state of a trajectory controller with positions of `reference` and `feedback`."""
    point = types["trajectory_msgs/msg/JointTrajectoryPoint"]
    zero = types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
    points = {
        part: point(
            positions=np.array(positions.get(part, ()), float),
            velocities=np.zeros(0),
            accelerations=np.zeros(0),
            effort=np.zeros(0),
            time_from_start=zero,
        )
        for part in ("reference", "feedback", "error", "output")
    }
    return types[STATE](header=header(types, stamp), joint_names=list(names), **points)


START = 1_700_000_000 * 10**9


def whole(types):
    """The motion as a robot publishes it: order of joints that changes, receipt that is late."""
    rng = np.random.default_rng(0)
    for k, row in motion().iterrows():
        stamp = START + int(row["frame"]) * 10**9 // RATE
        late = stamp + int(rng.uniform(1e6, 2e6))
        names = JOINTS[::-1] if k % 3 else JOINTS
        yield (
            late,
            "/joint_states",
            joint_state(
                types,
                stamp,
                (*names, "gripper"),
                position=[*(row[f"q_{j}"] for j in names), 0.01],
                velocity=[*(row[f"v_{j}"] for j in names), 0.0],
                effort=[*(row[f"i_{j}"] for j in names), 0.0],
            ),
        )
        yield (
            late,
            "/arm_controller/controller_state",
            controller_state(types, stamp, JOINTS, reference=[row[f"r_{j}"] for j in JOINTS]),
        )


def columns(signal: str) -> np.ndarray:
    """A signal of the motion, `(samples, joints)`."""
    return motion()[[f"{signal}_{j}" for j in JOINTS]].to_numpy()


def dataset(folder: Path, episodes: int = 1, names=JOINTS) -> Path:
    """A LeRobot dataset whose frames are float64, episodes one after another in a single file."""
    table = motion()
    parts = {
        "observation.state": "q",
        "observation.velocity": "v",
        "observation.effort": "i",
        "action": "r",
    }
    features = {
        key: {"dtype": "float64", "shape": [2], "names": {"motors": list(names)}} for key in parts
    }
    features["observation.images.top"] = {"dtype": "video", "shape": [3, 48, 64], "names": None}
    frames = [
        pd.DataFrame(
            {key: list((1 + 0.1 * k) * columns(signal)) for key, signal in parts.items()}
            | {
                "timestamp": table["time"].astype(np.float32),
                "frame_index": table["frame"],
                "episode_index": k,
            }
        )
        for k in range(episodes)
    ]
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    told = {"codebase_version": "v3.0", "fps": RATE, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(told))
    pq.write_table(
        pa.Table.from_pandas(pd.concat(frames, ignore_index=True), preserve_index=False),
        folder / "data" / "chunk-000" / "file-000.parquet",
    )
    return folder


def hdf5(path: Path) -> Path:
    """An HDF5 file with arrays of all joints in groups, and an image per frame."""
    with h5py.File(path, "w") as file:
        file["robot/stamp_ms"] = 1e3 * motion()["time"].to_numpy()
        file["robot/qpos"] = np.degrees(columns("q"))
        file["robot/qvel"] = columns("v")
        file.create_dataset("robot/current", data=columns("i"), compression="gzip")
        file["robot/goal"] = np.degrees(columns("r"))
        file["camera"] = np.zeros((4, 8, 8, 3), np.uint8)
        file["note"] = "two joints"
    return path


def table() -> pd.DataFrame:
    """A table with a column for each joint."""
    return motion().drop(columns="frame")
