"""What cannot be a recording is refused in one sentence that names it."""

import gzip
import io
import math
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from recording_files import SAMPLES, frame, signals

from jaxid.errors import RecordingError
from jaxid.recording import Recording, read


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
    "header only": ("a.csv", LINES[0].encode(), "a header but no rows"),
    "binary": ("a.csv", bytes(range(256)), "is not UTF-8 text"),
    "nul": ("a.csv", b"time,q_1\0", "is not UTF-8 text"),
    "extension": ("a.xlsx", b"PK", r"extension '.xlsx' is not known; use .csv"),
    "no extension": ("a", b"PK", "extension '' is not known"),
    "gz of mat": ("a.mat.gz", b"PK", "extension '.gz' is not known"),
    "missing": ("a.csv", without("tau_2"), r"'tau_2' is missing, but 'q_2' is there, there are"),
    "no time": ("a.csv", without("time"), r"'time' is missing.*name its column.*columns=\{'time'"),
    "no q": ("a.csv", without("q_1", "q_2"), "'q_1' is missing"),
    "q_2 alone": ("a.csv", without("q_1"), "'q_1' is missing, but 'q_2' is there"),
    "misnamed": ("a.csv", renamed(q_2="q2"), r"'q_2' is missing.*did you mean 'q2'"),
    "misnamed time": ("a.csv", renamed(time="Time"), r"did you mean 'Time'"),
    "doubled": ("a.csv", renamed(v_1="q_1"), "'q_1' appears more than once"),
    "both": ("a.csv", renamed(v_1="q"), "both q and q_1"),
    "fewer v": ("a.csv", without("v_2"), "q has 2 joints, but v has 1"),
    "no header": ("a.csv", "".join(LINES[1:]).encode(), "no header.*time,q_1,tau_1"),
    "text cell": ("a.csv", at("q_2", 17, "high"), "q_2, line 18 holds 'high'.*not a number"),
    "decimal comma": (
        "a.csv",
        csv().replace(b",", b";").replace(b".", b","),
        r"time, line 2 holds '0,0'.*decimal point",
    ),
    "booleans": ("a.csv", csv(q_1=True), "q_1 holds booleans"),
    "empty cell": ("a.csv", at("tau_1", 3, None), "tau_1, line 4 is empty or not finite"),
    "infinite": ("a.csv", at("v_1", 60, "inf"), r"v_1, line 61 is empty or not finite \(inf\)"),
    "overflow": ("a.csv", at("v_1", 60, "1e999"), "v_1, line 61 is empty or not finite"),
    "short row": ("a.csv", csv() + b"0.6,1", "line 62 has 2 cells, but the header has 11"),
    "long row": ("a.csv", csv() + LINES[1].strip().encode() + b",1", "line 62 has 12 cells"),
    "open quote": ("a.csv", csv(n=0.5).replace(b"0.5\n", b'"\n', 1), "EOF inside string"),
    "long quote": (
        "a.csv",
        csv(n=0.5).replace(b"0.5\n", b'"\n', 1).replace(b",0.5\n", b',a"\n', 1),
        "a quoted cell spans several rows",
    ),
    "repeated time": ("a.csv", later(9, -0.01), r"time repeats at line 10.*sort the rows"),
    "decreasing time": ("a.csv", later(9, -0.05), r"time goes back at line 10"),
    "gap": ("a.csv", later(31, 0.5), r'gap of 0.51 s before line 32.*gaps="allow"'),
    "few samples": ("a.csv", "".join(LINES[:20]).encode(), "19 samples; record at least 20"),
    "constant q": ("a.csv", csv(q_2=0.5), r"q of joint 2 \(q_2\) is constant at 0.5"),
    "constant tau": ("a.csv", csv(tau_1=0), r"tau of joint 1 \(tau_1\) is constant at 0;"),
    "no gzip": ("a.csv.gz", csv(), "cannot be read as .csv.gz, it is damaged"),
    "cut gzip": ("a.csv.gz", gzip.compress(csv())[:-20], "damaged, truncated"),
    "no zip": ("a.npz", b"hello", "cannot be read as .npz"),
    "npy": ("a.npz", b"\x93NUMPY\x01\x00", "cannot be read as .npz"),
    "pickled": (
        "a.npz",
        npz(q=np.array([[1, None]] * SAMPLES, dtype=object)),
        "array 'q' cannot be read.*no Python objects",
    ),
    "complex": ("a.npz", npz(q=signals()["q"] + 1j), "q holds complex values; give its real part"),
    "dates": ("a.npz", npz(time=np.arange(SAMPLES).astype("M8[s]")), "time holds dates"),
    "transposed": ("a.npz", npz(q=signals()["q"].T), "q .* has 2 rows, but time has 60.*transpos"),
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
    with pytest.raises(RecordingError, match="one unnamed array"):
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
        ({"columns": {"q": ["q_1"]}}, "q has 1 joints, but q_ref has 2"),
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
        ({"tau": signals()["tau"][:-1]}, "tau .* has 59 rows, but time has 60"),
        ({"v": signals(3)["v"]}, "q has 2 joints, but v has 3"),
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
