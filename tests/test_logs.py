"""Logs in the formats that people bring: one motion from each is the same recording."""

import contextlib
import json
import sys
import tomllib
import warnings

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from log_files import (
    GAINS,
    JOINTS,
    START,
    bag,
    columns,
    controller_state,
    dataset,
    hdf5,
    joint_state,
    motion,
    table,
    whole,
)
from rosbags.rosbag2 import StoragePlugin
from typer.testing import CliRunner

import jaxid
from jaxid.cli import app
from jaxid.errors import JaxidWarning, MissingExtraError, RecordingError

STORAGES = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
ARM = {"joints": JOINTS, "scale": {"tau": GAINS}, "gaps": "allow"}
BY_PATH = {
    "columns": {
        "time": "robot/stamp_ms",
        "q": "/robot/qpos",
        "v": "robot/qvel",
        "tau": "robot/current",
        "q_ref": "robot/goal",
    },
    "units": {"time": "ms", "q": "deg"},
    "scale": {"tau": GAINS},
    "gaps": "allow",
}
BY_NAME = {
    "columns": {
        "q": [f"q_{j}" for j in JOINTS],
        "v": [f"v_{j}" for j in JOINTS],
        "tau": [f"i_{j}*{g!r}" for j, g in zip(JOINTS, GAINS, strict=True)],
        "q_ref": [f"r_{j}" for j in JOINTS],
    },
    "gaps": "allow",
}


def run(*arguments):
    """The command's result; an exception that it does not turn into a sentence is raised."""
    return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)


def one(path, **told):
    (recording,) = jaxid.read(path, **told)
    return recording


def of_each_kind(folder):
    """The motion by the format it came in."""
    yield "table", jaxid.Recording.from_table(table(), **BY_NAME)
    yield "indexed", jaxid.Recording.from_table(table().set_index("time"), **BY_NAME)
    yield "Arrow", jaxid.Recording.from_table(pa.Table.from_pandas(table()), **BY_NAME)
    lists = pa.table(
        {
            "time": table()["time"],
            **{n: list(columns(s)) for n, s in zip("qac", "qir", strict=True)},
        }
    )
    named = {"columns": {"tau": "a", "q_ref": "c"}, "scale": {"tau": GAINS}, "gaps": "allow"}
    yield "lists", jaxid.Recording.from_table(lists, **named)
    yield "HDF5", one(hdf5(folder / "run.h5"), **BY_PATH)
    yield "LeRobot", one(dataset(folder / "lerobot"), **ARM)
    for name, storage in STORAGES.items():
        path = bag(folder / name, storage, whole)
        yield name, one(path, **ARM)
        (file,) = (f for f in path.iterdir() if f.suffix in (".db3", ".mcap"))
        yield f"file of {name}", one(file, **ARM)


def test_one_motion_is_the_same_recording_from_every_format(tmp_path):
    expected = {"time": motion()["time"], "q": columns("q"), "q_ref": columns("r")}
    expected |= {"v": columns("v"), "tau": columns("i") * GAINS}
    found = dict(of_each_kind(tmp_path))
    assert len(found) == 10
    for name, recording in found.items():
        for signal, values in expected.items():
            there = getattr(recording, signal)
            if signal != "v" or name != "lists":
                np.testing.assert_allclose(there, values, rtol=0, atol=1e-12, err_msg=name)


def test_a_gap_in_a_bag_is_refused_and_accepted_as_in_a_file(tmp_path):
    path = bag(tmp_path / "bag", StoragePlugin.MCAP, whole)
    with pytest.raises(RecordingError, match=r"time has a gap of 0.41 s before row 121.*--gaps"):
        jaxid.read(path, joints=JOINTS)


def test_joints_without_an_order_are_taken_by_name_and_that_is_said(tmp_path):
    path = bag(tmp_path / "bag", StoragePlugin.MCAP, moving("shoulder", "elbow"))
    with pytest.warns(JaxidWarning, match="in the order of their names, elbow, shoulder; give"):
        by_name = one(path)
    given = one(path, joints=["shoulder", "elbow"])
    np.testing.assert_array_equal(by_name.q, given.q[:, ::-1])
    # Numbers are an order, and ten comes after two.
    path = bag(tmp_path / "numbered", StoragePlugin.MCAP, moving("joint_10", "joint_2"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", JaxidWarning)
        np.testing.assert_array_equal(one(path).q, one(path, joints=["joint_2", "joint_10"]).q)


def moving(*joints, count=60, stamps=None, topic="/joint_states", **changed):
    """Messages of joints that move, each on its own way; fields may be changed by row."""

    def messages(types):
        rng = np.random.default_rng(7)
        for k in range(count):
            stamp = START + 10_000_000 * k if stamps is None else stamps(k)
            fields = {f: rng.normal(size=len(joints)) for f in ("position", "velocity", "effort")}
            fields |= {f: change(k, fields[f]) for f, change in changed.items()}
            yield START + 10_000_000 * k, topic, joint_state(types, stamp, joints, **fields)

    return messages


def both(*several):
    """Messages of several, in the order in which they were received."""
    return lambda types: sorted((m for s in several for m in s(types)), key=lambda m: m[:2])


def test_bag_times_are_taken_where_headers_have_none_and_that_is_said(tmp_path):
    path = bag(tmp_path / "bag", StoragePlugin.SQLITE3, moving("a", stamps=lambda k: 0))
    with pytest.warns(JaxidWarning, match="60 of 60 messages of /joint_states have no stamp"):
        recording = one(path)
    np.testing.assert_allclose(recording.time, 0.01 * np.arange(60), rtol=0, atol=1e-12)


def test_messages_twice_and_late_are_put_right(tmp_path):
    plain = moving("a")

    def disturbed(types):
        listed = list(plain(types))
        listed[20], listed[21] = listed[21], listed[20]
        return [*listed[:30], listed[29], *listed[30:]]

    expected = one(bag(tmp_path / "plain", StoragePlugin.MCAP, plain))
    path = bag(tmp_path / "bag", StoragePlugin.MCAP, lambda types: received(disturbed(types)))
    with pytest.warns(JaxidWarning, match="1 of 61 messages of /joint_states repeat another"):
        found = one(path)
    for signal in ("time", "q", "tau", "v"):
        np.testing.assert_array_equal(getattr(found, signal), getattr(expected, signal))


def received(messages):
    """The same messages, received one after another."""
    return [(START + k, topic, message) for k, (_, topic, message) in enumerate(messages)]


def test_a_topic_of_another_rate_is_interpolated_at_the_times_of_positions(tmp_path):
    def reference(types):
        for k in range(-1, 13):
            stamp = START + 50_000_000 * k + 3_000_000
            yield stamp, "/c", controller_state(types, stamp, ["a"], reference=[2.0 * k])

    path = bag(tmp_path / "bag", StoragePlugin.MCAP, both(moving("a"), reference))
    with pytest.warns(JaxidWarning, match=r"/c \(20 Hz\) has other stamps than /joint_states"):
        recording = one(path)
    # A straight line is what linear interpolation gives back.
    expected = (recording.time - 0.003) / 0.05 * 2.0
    np.testing.assert_allclose(recording.q_ref[:, 0], expected, rtol=0, atol=1e-9)


def test_joints_of_several_publishers_are_one_robot(tmp_path):
    left = moving("l1", topic="/left/joint_states")
    right = moving("r1", topic="/right/joint_states")
    path = bag(tmp_path / "bag", StoragePlugin.MCAP, both(left, right))
    assert one(path, joints=["l1", "r1"]).joints == 2


def test_episodes_are_recordings(tmp_path):
    folder = dataset(tmp_path / "arm", episodes=3)
    several = jaxid.read(folder, gaps="allow")
    assert several.names == ("episode_0", "episode_1", "episode_2")
    (second,) = jaxid.read(folder / "episode_1", gaps="allow")
    assert second.name == "episode_1"
    np.testing.assert_array_equal(second.q, several[1].q)
    np.testing.assert_allclose(second.q, 1.1 * several[0].q, rtol=1e-15)
    # Seven digits of a time stamp are not what is used.
    np.testing.assert_array_equal(second.time, motion()["time"])


def test_signals_of_one_feature_are_told_apart_by_the_endings_of_names(tmp_path):
    folder = dataset(tmp_path / "arm", names=["a.pos", "a.torque"])
    (recording,) = jaxid.read(folder, columns={"q_ref": "action.a.pos"}, gaps="allow")
    np.testing.assert_array_equal(recording.q[:, 0], columns("q")[:, 0])
    np.testing.assert_array_equal(recording.tau[:, 0], columns("i")[:, 1])


def test_fields_of_a_table_in_hdf5_are_columns(tmp_path):
    fields = ("time", "q_shoulder", "i_shoulder")
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        file["log"] = table()[list(fields)].to_records(index=False)
    named = dict(zip(("time", "q", "tau"), (f"log/{f}" for f in fields), strict=True))
    recording = one(tmp_path / "run.hdf5", columns=named, gaps="allow")
    np.testing.assert_array_equal(recording.tau[:, 0], columns("i")[:, 0])


@pytest.mark.parametrize("period", ["dt", "0.02"])
def test_time_may_be_a_period(tmp_path, period):
    rng = np.random.default_rng(0)
    np.savez(
        tmp_path / "run.npz", dt=0.02, q=rng.normal(size=(50, 2)), tau=rng.normal(size=(50, 2))
    )
    recording = one(tmp_path / "run.npz", columns={"time": period})
    np.testing.assert_array_equal(recording.time, 0.02 * np.arange(50))


def test_a_bag_is_inspected_described_and_read(tmp_path):
    path, toml = bag(tmp_path / "run", StoragePlugin.MCAP, whole), tmp_path / "log.toml"
    told = tmp_path / "arm.toml"
    told.write_text('joints = ["shoulder", "elbow"]\n')
    seen = run("inspect", path, "--log", told, "--write", toml)
    assert seen.exit_code == 0, seen.stderr
    assert "/joint_states: sensor_msgs/msg/JointState, 260 messages, 100 Hz" in seen.stdout
    assert "/arm_controller/controller_state: control_msgs" in seen.stdout
    assert "1 gap" in seen.stdout
    text = toml.read_text(encoding="utf-8")
    told = tomllib.loads(text)
    assert told["joints"] == list(JOINTS)
    assert f"# tau = {json.dumps([f'/joint_states/effort/{j}' for j in JOINTS])}" in text
    toml.write_text(text.replace("tau = [1.0, 1.0]", f"tau = {list(GAINS)}"), encoding="utf-8")
    out = tmp_path / "run.json"
    assert run("inspect", path, "--log", toml, "--json", out).exit_code == 0
    peak = json.loads(out.read_text())["joints"][0]["tau peak"]
    assert peak == pytest.approx(np.abs(columns("i")[:, 0] * GAINS[0]).max(), rel=1e-12)


def test_a_dataset_and_an_hdf5_file_are_inspected(tmp_path):
    found = run("inspect", dataset(tmp_path / "arm", episodes=2))
    assert found.exit_code == 0, found.stderr
    assert "observation.effort: shoulder, elbow" in found.stdout
    assert "episode_0 and episode_1" not in found.stdout
    found = run("inspect", hdf5(tmp_path / "run.h5"), "--unit", "q=deg", "--unit", "time=ms")
    assert found.exit_code == 0, found.stderr
    assert "robot/current: 260x2 float64" in found.stdout
    assert "camera: 4x8x8x3 uint8, not read (dataset of 4 dimensions)" in found.stdout
    assert "time=robot/stamp_ms  q=robot/qpos  tau=robot/current" in found.stdout


@pytest.mark.parametrize(
    ("module", "write", "extra"),
    [
        ("rosbags.rosbag2", lambda p: bag(p / "bag", StoragePlugin.MCAP, moving("a")), "ros"),
        ("h5py", lambda p: hdf5(p / "run.h5"), "hdf5"),
        ("pyarrow.parquet", lambda p: dataset(p / "arm"), "parquet"),
    ],
)
def test_an_extra_that_is_absent_is_named(tmp_path, monkeypatch, module, write, extra):
    path = write(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'jaxid-robotics\[{extra}\]'"):
        jaxid.read(path)


def malformed_bag(messages, **told):
    def make(folder):
        jaxid.read(bag(folder / "bag", StoragePlugin.MCAP, messages), **told)

    return make


def cut_bag(folder):
    path = bag(folder / "bag", StoragePlugin.MCAP, moving("a"))
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:2000])
    jaxid.read(path)


def undefined(folder):
    """A state of a controller in a bag that does not define it, as before Iron."""
    import apsw

    path = bag(folder / "bag", StoragePlugin.SQLITE3, whole)
    (file,) = path.glob("*.db3")
    base = apsw.Connection(str(file))
    base.execute("DELETE FROM message_definitions")
    base.close()
    jaxid.read(path)


def no_data(folder):
    next(dataset(folder / "arm").rglob("*.parquet")).unlink()
    jaxid.read(folder / "arm")


def no_features(folder):
    (dataset(folder / "arm") / "meta" / "info.json").write_text('{"fps": 30}')
    jaxid.read(folder / "arm")


def no_torque(folder):
    info = dataset(folder / "arm") / "meta" / "info.json"
    told = json.loads(info.read_text())
    del told["features"]["observation.effort"]
    info.write_text(json.dumps(told))
    jaxid.read(folder / "arm")


def cut_hdf5(folder):
    path = hdf5(folder / "run.h5")
    path.write_bytes(path.read_bytes()[:3000])
    jaxid.read(path, **BY_PATH)


def unpacked_to_much(folder):
    with h5py.File(folder / "run.h5", "w") as file:
        file.create_dataset("q", shape=(10**9,), dtype=float, chunks=(10**4,), compression="gzip")
    jaxid.read(folder / "run.h5")


def of_ros_1(folder):
    (folder / "run.bag").write_bytes(b"#ROSBAG V2.0\n")
    jaxid.read(folder / "run.bag")


MALFORMED = {
    "an HDF5 file that unpacks to much": (unpacked_to_much, "has at least 8000000000 bytes"),
    "a bag of ROS 1": (of_ros_1, "is a bag of ROS 1; convert it with rosbags-convert"),
    "no such topic": (
        malformed_bag(moving("a"), columns={"tau": "/joint_states/efort/a"}),
        "did you mean '/joint_states/effort/a'",
    ),
    "no effort": (
        malformed_bag(moving("a", effort=lambda k, x: ())),
        "no column has torques (effort) of joints, there are {'q': 'a', 'v': 'a'}; record them",
    ),
    "fewer values than joints": (
        malformed_bag(moving("a", "b", effort=lambda k, x: x[: 1 + (k != 7)])),
        "message 8 of /joint_states cannot be read (ValueError: effort has 1 values for 2 joints)",
    ),
    "a joint twice": (malformed_bag(moving("a", "a")), "a joint is named twice"),
    "another joint": (
        malformed_bag(moving("shoulder"), joints=["sholder"]),
        "there is no joint 'sholder' (did you mean 'shoulder'?)",
    ),
    "one joint on two topics": (
        malformed_bag(both(moving("a"), moving("a", topic="/raw"))),
        "both /joint_states/position and /raw/position have joint a",
    ),
    "a clock that was set back": (
        malformed_bag(moving("a", stamps=lambda k: START + 10**7 * (k % 40))),
        "time goes back at row 41",
    ),
    "one stamp, two values": (
        malformed_bag(moving("a", stamps=lambda k: START + 10**7 * (k - (k == 9)))),
        "time repeats at row 10",
    ),
    "no common times": (
        malformed_bag(
            both(
                moving("a"),
                lambda types: [
                    (START, "/c", controller_state(types, 10**9 * k, ["a"], reference=[k]))
                    for k in range(1, 30)
                ],
            )
        ),
        "/joint_states and /c have no times in common",
    ),
    "no joints": (
        malformed_bag(
            lambda types: [
                (START, "/clock", types["builtin_interfaces/msg/Time"](sec=1, nanosec=2))
            ]
        ),
        "no topic has messages about joints, there are /clock (builtin_interfaces/msg/Time)",
    ),
    "a bag that is cut off": (cut_bag, "damaged, truncated or of another kind"),
    "types that are not defined": (undefined, "and does not define them"),
    "frames that are absent": (no_data, "there is no Parquet file in data"),
    "info without features": (no_features, "meta/info.json does not describe features"),
    "a dataset without torque": (no_torque, "no column has torques (effort) of joints"),
    "an episode that is not there": (
        lambda folder: jaxid.read(dataset(folder / "arm") / "episode_7"),
        "there is no episode 7; choose one of 0 to 0",
    ),
    "names that are too many": (
        lambda folder: jaxid.read(dataset(folder / "arm", names="abc")),
        "meta/info.json names 3 parts of observation.state, but it has 2",
    ),
    "an HDF5 file that is cut off": (cut_hdf5, "cannot be read as .h5, it is damaged"),
    "an image as a signal": (
        lambda folder: jaxid.read(
            hdf5(folder / "run.h5"), columns={"time": "0.01", "q": "camera", "tau": "note"}
        ),
        "'camera' is a dataset of 4 dimensions",
    ),
    "joints of a file without names": (
        lambda folder: jaxid.read(hdf5(folder / "run.h5"), joints=["a"]),
        "its columns are not named by joint",
    ),
    "no table": (lambda folder: jaxid.Recording.from_table([1, 2]), "[1, 2] is not a table"),
    "lists of uneven lengths": (
        lambda folder: jaxid.Recording.from_table(
            pd.DataFrame(
                {"time": range(30), "q": [[0.0] * (1 + k % 2) for k in range(30)], "tau": 0}
            )
        ),
        "q is ragged",
    ),
    "a factor that is nil": (
        lambda folder: jaxid.Recording.from_table(table(), scale={"tau": 0}, **BY_NAME),
        "scale of tau is 0",
    ),
    "factors that are too many": (
        lambda folder: jaxid.Recording.from_table(table(), scale={"tau": [1, 2, 3]}, **BY_NAME),
        "scale gives 3 factors for tau of 2 joints",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_what_is_wrong_is_said_in_a_sentence(tmp_path, case):
    make, says = MALFORMED[case]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", JaxidWarning)
        with pytest.raises(RecordingError) as told:
            make(tmp_path)
    assert says in str(told.value)
    assert "\n" not in str(told.value)
    with contextlib.suppress(OSError):
        (tmp_path / "said.txt").write_text(str(told.value))
