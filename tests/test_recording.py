"""Recordings: what is read is what was written, and what is wrong is said."""

import gzip
import io
import math
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
import scipy.io

from jaxid.errors import JaxidError, JaxidWarning, MissingExtraError, RecordingError, require
from jaxid.recording import Recording, Recordings, read

SAMPLES = 60


def signals(joints: int = 2) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    time = 0.01 * np.arange(SAMPLES)
    names = ("q_ref", "q", "tau", "v", "tau_ff")
    return {"time": time} | {name: rng.normal(size=(SAMPLES, joints)) for name in names}


def frame(joints: int = 2) -> pd.DataFrame:
    return Recording.from_arrays(**signals(joints)).to_dataframe()


def write(path: Path, table: pd.DataFrame) -> Path:
    table = table.copy()
    table.attrs = {}
    arrays = {str(name): table[name].to_numpy() for name in table}
    match path.suffix:
        case ".parquet":
            table.to_parquet(path)
        case ".mat":
            scipy.io.savemat(path, arrays)
        case ".npz":
            np.savez(path, **arrays)
        case ".txt":
            np.savetxt(path, table, header=" ".join(table), fmt="%.17g")
        case ".tsv":
            table.to_csv(path, index=False, sep="\t")
        case _:
            table.to_csv(path, index=False)
    return path


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
    with pytest.raises(RecordingError, match="1 joints where fit has 2"):
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
    with pytest.raises(RecordingError, match=f"'{name}1' is missing though '{name}2' is there"):
        Recording.from_dataframe(table.drop(columns=f"{name}1"))


def test_a_plain_v1_is_no_velocity() -> None:
    table = frame().rename(columns={"v_1": "v1", "v_2": "v2"})
    assert Recording.from_dataframe(table).v is None


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


def csv(**changed: object) -> bytes:
    return frame().assign(**changed).to_csv(index=False).encode()


def at(column: str, row: int, value: object) -> bytes:
    table = frame().astype(object)
    table.loc[row - 1, column] = value
    return table.to_csv(index=False).encode()


def without(*columns: str) -> bytes:
    return frame().drop(columns=list(columns)).to_csv(index=False).encode()


def renamed(**names: str) -> bytes:
    return frame().rename(columns=names).to_csv(index=False).encode()


def later(row: int, by: float) -> bytes:
    table = frame()
    table.loc[row - 1 :, "time"] += by
    return table.to_csv(index=False).encode()


def npz(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **signals() | arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def mat(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, signals() | arrays)
    return buffer.getvalue()


LINES = csv().decode().splitlines(keepends=True)

COMPLAINTS = {
    "empty": ("a.csv", b"", "the file is empty"),
    "blank": ("a.csv", b"\n \n", "there are no rows"),
    "header only": ("a.csv", LINES[0].encode(), "a header and no rows"),
    "binary": ("a.csv", bytes(range(256)), "is not UTF-8 text"),
    "nul": ("a.csv", b"time,q_1\0", "is not UTF-8 text"),
    "extension": ("a.xlsx", b"PK", r"extension '.xlsx' is not known; use .csv"),
    "no extension": ("a", b"PK", "extension '' is not known"),
    "gz of mat": ("a.mat.gz", b"PK", "extension '.gz' is not known"),
    "missing": ("a.csv", without("tau_2"), r"'tau_2' is missing though 'q_2' is there, there are"),
    "no time": ("a.csv", without("time"), r"'time' is missing.*say which.*columns=\{'time'"),
    "no q": ("a.csv", without("q_1", "q_2"), "'q_1' is missing"),
    "q_2 alone": ("a.csv", without("q_1"), "'q_1' is missing though 'q_2' is there"),
    "misnamed": ("a.csv", renamed(q_2="q2"), r"'q_2' is missing.*did you mean 'q2'"),
    "misnamed time": ("a.csv", renamed(time="Time"), r"did you mean 'Time'"),
    "doubled": ("a.csv", renamed(v_1="q_1"), "'q_1' appears more than once"),
    "both": ("a.csv", renamed(v_1="q"), "both q and q_1"),
    "fewer v": ("a.csv", without("v_2"), "q has 2 joints and v has 1"),
    "no header": ("a.csv", "".join(LINES[1:]).encode(), "no header.*time,q_1,tau_1"),
    "text cell": ("a.csv", at("q_2", 17, "high"), "q_2, row 17 holds 'high'.*not a number"),
    "decimal comma": (
        "a.csv",
        csv().replace(b",", b";").replace(b".", b","),
        r"time, row 1 holds '0,0'.*decimal point",
    ),
    "booleans": ("a.csv", csv(q_1=True), "q_1 holds booleans"),
    "empty cell": ("a.csv", at("tau_1", 3, None), "tau_1, row 3 is empty or not finite"),
    "infinite": ("a.csv", at("v_1", 60, "inf"), r"v_1, row 60 is empty or not finite \(inf\)"),
    "overflow": ("a.csv", at("v_1", 60, "1e999"), "v_1, row 60 is empty or not finite"),
    "short row": ("a.csv", csv() + b"0.6,1", "row 61 has 2 cells where the header has 11"),
    "long row": ("a.csv", csv() + LINES[1].strip().encode() + b",1", "row 61 has 12 cells"),
    "open quote": ("a.csv", csv(n=0.5).replace(b"0.5\n", b'"\n', 1), "EOF inside string"),
    "long quote": (
        "a.csv",
        csv(n=0.5).replace(b"0.5\n", b'"\n', 1).replace(b",0.5\n", b',a"\n', 1),
        "a quoted cell runs over several rows",
    ),
    "repeated time": ("a.csv", later(9, -0.01), r"time repeats at row 9.*sort the rows"),
    "decreasing time": ("a.csv", later(9, -0.05), r"time goes back at row 9"),
    "gap": ("a.csv", later(31, 0.5), r'gap of 0.51 s before row 31.*gaps="allow"'),
    "few samples": ("a.csv", "".join(LINES[:20]).encode(), "19 samples; record at least 20"),
    "constant q": ("a.csv", csv(q_2=0.5), r"q of joint 2 \(q_2\) is constant at 0.5"),
    "constant tau": ("a.csv", csv(tau_1=0), r"tau of joint 1 \(tau_1\) is constant at 0;"),
    "no gzip": ("a.csv.gz", csv(), "cannot be read as .csv.gz, it is damaged"),
    "cut gzip": ("a.csv.gz", gzip.compress(csv())[:-20], "damaged, cut off"),
    "no zip": ("a.npz", b"hello", "cannot be read as .npz"),
    "npy": ("a.npz", b"\x93NUMPY\x01\x00", "cannot be read as .npz"),
    "pickled": (
        "a.npz",
        npz(q=np.array([[1, None]] * SAMPLES, dtype=object)),
        "array 'q' cannot be read.*no Python objects",
    ),
    "complex": ("a.npz", npz(q=signals()["q"] + 1j), "q holds complex values; give its real part"),
    "dates": ("a.npz", npz(time=np.arange(SAMPLES).astype("M8[s]")), "time holds dates"),
    "transposed": ("a.npz", npz(q=signals()["q"].T), "q .* has 2 rows where time has 60.*transpos"),
    "too deep": ("a.npz", npz(q=np.ones((SAMPLES, 2, 2))), "q .* has shape .60, 2, 2"),
    "scalar time": ("a.npz", npz(time=0.0), "time has shape"),
    "no mat": ("a.mat", b"hello" * 99, "cannot be read as .mat"),
    "hdf5": ("a.mat", b"MATLAB 7.3 MAT-file" + b" " * 500, r"HDF5.*save\(file, '-v7'\)"),
    "mat object": ("a.mat", mat(q={"a": 1.0}), r"'q' is a struct variable.*-struct"),
    "mat cell": ("a.mat", mat(tau=np.array([[1, "x"]], object)), "'tau' is a cell variable"),
    "mat text": ("a.mat", mat(q="hello"), "q, row 1 holds"),
    "no parquet": ("a.parquet", b"PAR1" * 9, "cannot be read as .parquet"),
}


@pytest.mark.parametrize("case", COMPLAINTS)
def test_complaints_about_files(tmp_path: Path, case: str) -> None:
    name, content, pattern = COMPLAINTS[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=pattern) as info:
        read(tmp_path / name)
    message = str(info.value)
    assert message.startswith(str(tmp_path / name))
    assert message.endswith(".")
    assert "\n" not in message


def test_complaints_about_paths(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        read(tmp_path / "absent.csv")
    with pytest.raises(RecordingError, match="is a directory"):
        read(tmp_path)
    with pytest.raises(RecordingError, match="cannot be opened"):
        read("nul\0.csv")
    with pytest.raises(RecordingError, match="no file was given"):
        read()


def test_a_struct_that_holds_everything_is_named(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "fit.mat", {"data": signals()})
    with pytest.raises(RecordingError, match="only 'data', a struct.*-struct"):
        read(tmp_path / "fit.mat")


def test_a_bare_array_in_npz_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "fit.npz").open("wb") as file:
        np.save(file, np.ones(40))
    with pytest.raises(RecordingError, match="one bare array"):
        read(tmp_path / "fit.npz")


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        ({"units": {"q": "degree"}}, "'degree' is not a unit known for q.*one of rad"),
        ({"units": {"tau": "N.n"}}, "not a unit known for tau"),
        ({"units": {"torque": "Nm"}}, "units names 'torque'"),
        ({"units": {"q": ["deg"] * 3}}, "units gives 3 units for q of 2 joints"),
        ({"columns": {"Tau": ["a"]}}, r"columns names 'Tau' \(did you mean 'tau'\?\)"),
        ({"columns": {"q": ["q_1", "pos2"]}}, "'pos2' is missing"),
        ({"columns": {"q": ["q_1"]}}, "q has 1 joints and q_ref has 2"),
        ({"columns": {"tau": []}}, "no column for tau"),
        ({"columns": {"tau": ["q_1*", "q_2"]}}, r"column '' is missing.*--column tau="),
        ({"columns": {"tau": ["2*i_1", "q_2"]}}, r"column 'i_1' is missing.*--column tau="),
        ({"resolution": [1.0, -1.0]}, "resolution is"),
        ({"resolution": [1.0, 1.0, 1.0]}, "resolution is"),
        ({"resolution": math.nan}, "resolution is"),
    ],
)
def test_complaints_about_settings(arguments: dict, pattern: str) -> None:
    with pytest.raises(RecordingError, match=pattern):
        Recording.from_dataframe(frame(), **arguments)


@pytest.mark.parametrize(
    ("changed", "pattern"),
    [
        ({"q": [[1.0, 2.0], [3.0]]}, "q is ragged"),
        ({"q": None}, "q, row 1 holds None"),
        ({"tau": signals()["tau"][:-1]}, "tau .* has 59 rows where time has 60"),
        ({"v": signals(3)["v"]}, "q has 2 joints and v has 3"),
        ({"q": signals()["q"].astype(str)}, "q holds text"),
        ({"q_ref": signals()["q"].astype(object)}, "q_ref holds text or Python objects"),
        ({"tau_ff": np.full((SAMPLES, 2), 1e308)}, "tau_ff_1, row 1 is empty or not finite"),
        (
            {"q": np.ma.masked_array(signals()["q"], mask=np.eye(SAMPLES, 2, k=-3))},
            "q_1, row 4 is empty",
        ),
        ({"q": np.ones((SAMPLES, 0))}, "q .* has shape"),
        ({"time": 1e307 * np.linspace(-17, 17, SAMPLES)}, "time reaches .* in SI units"),
    ],
)
def test_complaints_about_arrays(changed: dict, pattern: str) -> None:
    with pytest.raises(RecordingError, match=f"^run: .*{pattern}"):
        Recording.from_arrays(**signals() | changed, name="run", units={"tau_ff": "kN"})


def test_a_constant_reference_is_fine() -> None:
    Recording.from_arrays(**signals() | {"q_ref": np.ones((SAMPLES, 2))})


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
