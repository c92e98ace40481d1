"""Recordings: what is read is what was written, and what is wrong is said."""

import math
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
import scipy.io
from recording_files import SAMPLES, frame, signals, write

from jaxid.errors import JaxidError, JaxidWarning, MissingExtraError, RecordingError, require
from jaxid.recording import Recording, Recordings, read


def same(one: Recording, other: Recording) -> None:
    for name in signals():
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.resolution, other.resolution)


@pytest.mark.parametrize("joints", [1, 2, 3])
@pytest.mark.parametrize("ending", ["csv", "csv.gz", "tsv", "txt", "parquet", "mat", "npz"])
def test_every_format_round_trips(tmp_path: Path, ending: str, joints: int) -> None:
    path = write(tmp_path / f"fit.{ending}", frame(joints))
    recordings = read(path)
    assert recordings.names == ("fit",)
    same(recordings[0], Recording.from_arrays(**signals(joints)))


@pytest.mark.parametrize("ending", ["mat", "npz"])
def test_two_dimensional_arrays(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"fit.{ending}"
    if ending == "mat":
        scipy.io.savemat(path, signals(), do_compression=True)
    else:
        np.savez_compressed(path, **signals())
    same(read(path)[0], Recording.from_arrays(**signals()))


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|", " "])
def test_delimiters_and_blank_or_comment_lines(tmp_path: Path, delimiter: str) -> None:
    text = frame().to_csv(index=False, sep=delimiter, lineterminator="\r\n")
    (tmp_path / "fit.csv").write_bytes(("\ufeff# a note\r\n\r\n" + text + "\r\n").encode())
    same(read(tmp_path / "fit.csv")[0], Recording.from_arrays(**signals()))


def test_extra_columns_quotes_and_order_do_not_matter(tmp_path: Path) -> None:
    table = frame().assign(note="a, b", extra=np.nan)
    write(tmp_path / "fit.csv", table[table.columns[::-1]])
    same(read(tmp_path / "fit.csv")[0], Recording.from_arrays(**signals()))


def test_dataframe_round_trip_keeps_name_and_resolution() -> None:
    recording = Recording.from_arrays(**signals(), name="run 1", resolution=[1e-3, 2e-3])
    back = Recording.from_dataframe(recording.to_dataframe())
    assert back.name == "run 1"
    same(back, recording)


def test_dataframe_with_nullable_columns_and_index() -> None:
    table = frame().astype("Float64").set_index(pd.RangeIndex(5, 5 + SAMPLES))
    same(Recording.from_dataframe(table), Recording.from_arrays(**signals()))


def test_one_joint_may_be_one_dimensional() -> None:
    time, q, tau = signals(1)["time"], signals(1)["q"][:, 0], signals(1)["tau"][:, 0]
    recording = Recording.from_arrays(list(time), q.tolist(), jax.numpy.asarray(tau))
    assert recording.q.shape == (SAMPLES, 1)
    assert recording.q_ref is None
    assert recording.v is None
    assert recording.tau_ff is None
    assert recording.tau.dtype == np.float64


def test_properties_and_repr() -> None:
    recording = Recording.from_arrays(**signals(), name="fit_1")
    assert (recording.samples, recording.joints) == (SAMPLES, 2)
    # Times are rounded to half an ulp of 0.6 s, differences of two to one ulp.
    assert recording.duration == pytest.approx(0.59, abs=np.spacing(0.6))
    assert recording.period == pytest.approx(0.01, abs=np.spacing(0.6))
    assert recording.rate == pytest.approx(100, rel=100 * np.spacing(0.6))
    assert repr(recording) == "Recording('fit_1': 2 joints, 60 samples, 0.6 s at 100 Hz)"
    assert "fit_1" in recording._repr_html_()
    one = Recording.from_arrays(**signals(1), name="<b>")
    assert "1 joint," in repr(one)
    assert "<b>" not in one._repr_html_()
    both = Recordings.of([recording, recording])
    assert "fit_1_2" in repr(both)
    assert both._repr_html_().count("<li>") == 2


def test_slice_keeps_times() -> None:
    recording = Recording.from_arrays(**signals(), name="fit", resolution=1e-3)
    part = recording.slice(0.1, 0.2)
    np.testing.assert_array_equal(part.time, recording.time[10:20])
    np.testing.assert_array_equal(part.tau_ff, recording.tau_ff[10:20])
    assert part.name == "fit"
    np.testing.assert_array_equal(part.resolution, recording.resolution)
    same(recording.slice(None, None), recording)
    same(recording.slice(0, 1), recording)
    with pytest.raises(RecordingError, match=r"fewer than two samples .* within 0 and 0.59 s"):
        recording.slice(3.0, 4.0)


def test_recordings_select_and_rename() -> None:
    fit = Recording.from_arrays(**signals(), name="fit")
    taken = Recording.from_arrays(**signals(), name="fit_2")
    recordings = Recordings.of([fit, taken, fit])
    assert recordings.names == ("fit", "fit_2", "fit_3")
    assert len(recordings) == 3
    assert recordings.joints == 2
    assert [r.name for r in recordings] == list(recordings.names)
    assert recordings["fit_2"] is recordings[1]
    assert recordings[1:].names == ("fit_2", "fit_3")
    assert Recordings.of(recordings) is recordings
    assert Recordings.of(fit)[0] is fit
    with pytest.raises(RecordingError, match="no recording 'fit2' .did you mean 'fit_2'"):
        recordings["fit2"]
    with pytest.raises(RecordingError, match="no recording"):
        Recordings.of([])
    with pytest.raises(RecordingError, match="1 joints, but fit has 2"):
        Recordings.of([fit, Recording.from_arrays(**signals(1))])


def test_recording_is_a_pytree_of_its_arrays() -> None:
    recording = Recording.from_arrays(**signals())
    assert len(jax.tree.leaves(recording)) == 6
    same(jax.tree.map(lambda x: x, recording), recording)


@pytest.mark.parametrize(
    ("signal", "unit", "factor"),
    [
        ("time", "ms", 1e-3),
        ("time", "us", 1e-6),
        ("time", "µs", 1e-6),
        ("q", "deg", math.pi / 180),
        ("q", "°", math.pi / 180),
        ("q", "mm", 1e-3),
        ("q", "turn", 2 * math.pi),
        ("q", "rad", 1.0),
        ("v", "deg/s", math.pi / 180),
        ("v", "mm/s", 1e-3),
        ("v", "rpm", 2 * math.pi / 60),
        ("tau", "N·m", 1.0),
        ("tau", "N.m", 1.0),
        ("tau", "Nm", 1.0),
        ("tau", "mN·m", 1e-3),
        ("tau", "N·mm", 1e-3),
        ("tau", "kN·m", 1e3),
        ("tau", "kN", 1e3),
    ],
)
def test_units(signal: str, unit: str, factor: float) -> None:
    recording = Recording.from_arrays(**signals(), units={signal: unit})
    follows = {"q": {"q", "q_ref"}, "tau": {"tau", "tau_ff"}}.get(signal, {signal})
    for name, values in signals().items():
        expected = values * factor if name in follows else values
        # The factors above and those of the library differ by a rounding or two.
        np.testing.assert_allclose(getattr(recording, name), expected, rtol=4 * np.spacing(1.0))


def test_units_by_joint_and_for_one_signal_alone() -> None:
    units = {"q": ["deg", "mm"], "q_ref": "rad"}
    recording = Recording.from_arrays(**signals(), units=units)
    np.testing.assert_allclose(recording.q, signals()["q"] * [math.pi / 180, 1e-3], rtol=1e-15)
    np.testing.assert_array_equal(recording.q_ref, signals()["q_ref"])


def test_columns_may_be_products_numbers_and_whole_arrays(tmp_path: Path) -> None:
    given = signals()
    np.savez(
        tmp_path / "fit.npz",
        t=given["time"],
        pos=given["q"],
        i1=given["tau"][:, 0],
        i2=given["tau"][:, 1],
        k=2.0,
    )
    columns = {"time": "t", "q": "pos", "tau": ["k*i1", "k * i2"]}
    recording = read(tmp_path / "fit.npz", columns=columns)[0]
    np.testing.assert_array_equal(recording.q, given["q"])
    np.testing.assert_array_equal(recording.tau, 2 * given["tau"])
    numbers = {"time": "t", "q": "pos", "tau": ["2*i1", "i2 * -0.5 * 2"]}
    recording = read(tmp_path / "fit.npz", columns=numbers)[0]
    np.testing.assert_array_equal(recording.tau, [2, -1] * given["tau"])


@pytest.mark.parametrize("name", ["q", "q_ref", "tau"])
def test_names_without_an_underscore(name: str) -> None:
    table = frame().rename(columns={f"{name}_{j}": f"{name}{j}" for j in (1, 2)})
    same(Recording.from_dataframe(table), Recording.from_arrays(**signals()))
    with pytest.raises(RecordingError, match=f"'{name}1' is missing, but '{name}2' is there"):
        Recording.from_dataframe(table.drop(columns=f"{name}1"))


def test_a_plain_v1_is_no_velocity() -> None:
    table = frame().rename(columns={"v_1": "v1", "v_2": "v2"})
    assert Recording.from_dataframe(table).v is None


@pytest.mark.parametrize(
    ("jump", "says"), [(0.5, "jumps by 0.5.* at row 201, where"), (2 * np.pi, "is a turn: unwrap")]
)
def test_a_jump_of_a_position_is_named_with_its_place(jump, says):
    time = 0.005 * np.arange(400)
    q = np.sin(time)
    if jump < 1:
        q[200] += jump
    else:
        q[200:] -= jump
    with pytest.warns(JaxidWarning, match=says):
        Recording.from_arrays(time, q, np.cos(time))


def test_uneven_sampling_is_no_gap() -> None:
    time = np.cumsum(np.random.default_rng(0).exponential(0.01, SAMPLES))
    Recording.from_arrays(**signals() | {"time": time})


def test_gaps_can_be_allowed(tmp_path: Path) -> None:
    table = frame()
    table.loc[30:, "time"] += 1
    path = write(tmp_path / "fit.csv", table)
    assert read(path, gaps="allow")[0].duration > 1.5


def test_suspicious_units_warn_and_named_units_do_not() -> None:
    given = signals()
    given["q"] = 100 * given["q"]
    with pytest.warns(JaxidWarning, match=r'looks like degrees; pass units=\{"q": "deg"\}'):
        Recording.from_arrays(**given)
    slow = signals() | {"time": 1e3 * signals()["time"]}
    with pytest.warns(JaxidWarning, match="looks like milliseconds"):
        Recording.from_arrays(**slow)
    late = signals() | {"time": 1.7e9 + signals()["time"]}
    with pytest.warns(JaxidWarning, match="time begins at 1700000000 s"):
        Recording.from_arrays(**late)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording.from_arrays(**given, units={"q": "rad"})
        Recording.from_arrays(**given, units={"q": "deg"})
        Recording.from_arrays(**slow, units={"time": "ms"})


def test_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "fit.parquet", frame())
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'jaxid-robotics\[parquet\]'") as info:
        read(path)
    assert isinstance(info.value, JaxidError)
    assert isinstance(info.value, ImportError)
    assert require("math", "none") is math


@pytest.mark.shared
def test_emps(shared_data: Path) -> None:
    fit, pulses = read(
        shared_data / "emps" / "DATA_EMPS.mat", shared_data / "emps" / "DATA_EMPS_PULSES.mat"
    )
    raw = scipy.io.loadmat(shared_data / "emps" / "DATA_EMPS_PULSES.mat")
    assert fit.samples == pulses.samples == 24841
    assert fit.tau_ff is None
    np.testing.assert_array_equal(pulses.tau, raw["gtau"] * raw["vir"])
    np.testing.assert_array_equal(pulses.tau_ff, raw["gtau"] * raw["pulses_N"])
    np.testing.assert_array_equal(pulses.q_ref, raw["qg"])
    # 50 000 counts a turn of a screw with 2.5 mm lead; positions are rounded to 1e-16 m, one part
    # in 1e8 of a count, and the other file's are not on the counts.
    assert fit.resolution == pytest.approx(2.5e-3 / 50_000, rel=1e-8)
    assert pulses.resolution is None


@pytest.mark.shared
def test_double_pendulum(shared_data: Path) -> None:
    columns = {
        "q": ["pos_meas1", "pos_meas2"],
        "v": ["vel_meas1", "vel_meas2"],
        "tau": ["tau_con1", "tau_con2"],
    }
    paths = sorted((shared_data / "double_pendulum").glob("*.csv.gz"))
    recordings = read(*paths, columns=columns, resolution=3.81e-4)
    assert len(recordings) == 4
    assert (recordings.joints, recordings.names[0]) == (2, "trajectory_01")
    table = pd.read_csv(paths[0])
    np.testing.assert_array_equal(recordings[0].v, table[columns["v"]])
    assert recordings[0].q_ref is None
    with pytest.raises(RecordingError, match="'q_1' is missing, there are .'time', 'pos_meas1'"):
        read(paths[0])


@pytest.mark.shared
def test_hidden_effects(shared_data: Path) -> None:
    case = shared_data / "hidden_effects" / "case_01"
    recordings = read(case / "fit_1.csv", case / "held_out.csv")
    assert repr(recordings[0]) == "Recording('fit_1': 2 joints, 2001 samples, 20.0 s at 100 Hz)"
    assert recordings[1].q_ref is not None
