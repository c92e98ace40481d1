"""Whatever a file or an array holds, the answer is one sentence that names it."""

import gzip
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxid.errors import RecordingError
from jaxid.recording import Recording, read

SAMPLES = 40
TEXT = (".csv", ".tsv", ".txt", ".csv.gz")
BINARY = (".npz", ".mat", ".parquet", ".csv.gz")


def examples(count: int) -> settings:
    """Settings for `count` malformed inputs, the same ones in every run."""
    return settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    time = 0.01 * np.arange(SAMPLES)
    return {"time": time} | {name: rng.normal(size=(SAMPLES, 2)) for name in ("q_ref", "q", "tau")}


def table() -> pd.DataFrame:
    frame = Recording.from_arrays(**arrays()).to_dataframe()
    frame.attrs = {}
    return frame


def encode(frame: pd.DataFrame, ending: str) -> bytes:
    buffer = io.BytesIO()
    columns = {str(name): frame[name].to_numpy() for name in frame}
    match ending:
        case ".npz":
            np.savez_compressed(buffer, **columns)  # pyright: ignore[reportArgumentType]
        case ".mat":
            scipy.io.savemat(buffer, columns, do_compression=True)
        case ".parquet":
            # Without checksums a flipped bit of a value is just another value.
            frame.to_parquet(buffer, write_page_checksum=True)
        case ".csv.gz":
            return gzip.compress(frame.to_csv(index=False).encode())
        case _:
            return frame.to_csv(index=False, sep="\t" if ending == ".tsv" else ",").encode()
    return buffer.getvalue()


def one_sentence(source: str, call: Callable[[], object]) -> str:
    """The message of the `RecordingError` that `call` must end in."""
    with pytest.raises(RecordingError) as info:
        call()
    message = str(info.value)
    assert message.startswith(f"{source}: ")
    assert message.endswith(".")
    assert message.isprintable()
    assert len(message) - len(source) < 350
    return message


def refused(folder: Path, ending: str, content: bytes) -> str:
    path = folder / f"run{ending}"
    path.write_bytes(content)
    return one_sentence(str(path), lambda: read(path))


columns = st.sampled_from(list(table().columns))
needed = st.sampled_from(["time", "q_1", "q_2", "tau_1", "tau_2", "q_ref_1"])
rows = st.integers(0, SAMPLES - 1)
not_numbers = st.one_of(
    st.sampled_from(["nan", "inf", "-Infinity", "NA", "", "1e999", "1,5", "0x1g", "--", "1+2j"]),
    # Neither a digit nor a delimiter, nor what begins a comment: surely no number.
    st.text(st.characters(categories=["L", "S"], exclude_characters="|"), min_size=1).filter(
        lambda text: text.casefold() not in ("inf", "infinity")
    ),
)


@examples(80)
@given(st.sampled_from(TEXT), columns, rows, not_numbers)
def test_a_cell_that_is_no_number(
    tmp_path: Path, ending: str, column: str, row: int, cell: str
) -> None:
    frame = table().astype(object)
    frame.loc[row, column] = cell
    message = refused(tmp_path, ending, encode(frame, ending))
    assert column in message
    assert f"line {row + 2} " in message


@examples(60)
@given(st.sampled_from(TEXT + BINARY), needed, rows, st.sampled_from([np.nan, np.inf, -np.inf]))
def test_a_value_that_is_not_finite(
    tmp_path: Path, ending: str, column: str, row: int, value: float
) -> None:
    frame = table()
    frame.loc[row, column] = value
    message = refused(tmp_path, ending, encode(frame, ending))
    where = f"line {row + 2}" if ending in TEXT else f"row {row + 1}"
    assert f"{column}, {where} " in message


@examples(60)
@given(st.sampled_from(TEXT + BINARY), st.data())
def test_time_that_does_not_increase(tmp_path: Path, ending: str, data: st.DataObject) -> None:
    frame = table()
    order = data.draw(st.permutations(range(SAMPLES)) | st.lists(rows, min_size=20))
    frame = frame.iloc[list(order)]
    if frame["time"].is_monotonic_increasing and frame["time"].is_unique:
        frame = frame.iloc[::-1]
    assert "time " in refused(tmp_path, ending, encode(frame, ending))


@examples(40)
@given(st.sampled_from(TEXT + BINARY), st.integers(2, SAMPLES - 2), st.floats(0.05, 1e300))
def test_a_gap(tmp_path: Path, ending: str, row: int, gap: float) -> None:
    frame = table()
    frame.loc[row:, "time"] += gap
    # A gap so long that the steps after it vanish beside it is a repeated time.
    assert "time " in refused(tmp_path, ending, encode(frame, ending))


@examples(60)
@given(st.sampled_from(TEXT + BINARY), needed, st.text(max_size=60))
def test_a_column_with_another_name(tmp_path: Path, ending: str, old: str, new: str) -> None:
    # A name nobody wrote, in letters that MATLAB takes; q_ref_1 gone leaves a q_ref_2.
    name = "x" + "".join(filter(str.isalnum, new.encode("ascii", "ignore").decode()))[:20]
    frame = table().rename(columns={old: name})
    assert old in refused(tmp_path, ending, encode(frame, ending))


@examples(30)
@given(st.sampled_from(TEXT), columns, columns)
def test_a_column_twice(tmp_path: Path, ending: str, one: str, other: str) -> None:
    frame = table()
    frame.insert(len(frame.columns), one, frame[other], allow_duplicates=True)
    content = frame.to_csv(index=False).encode()
    message = refused(tmp_path, ending, gzip.compress(content) if "gz" in ending else content)
    assert "more than once" in message
    assert one in one_sentence("run", lambda: Recording.from_dataframe(frame, name="run"))


@examples(30)
@given(st.sampled_from(TEXT + BINARY), st.sampled_from(["q_1", "q_2", "tau_1", "tau_2"]), rows)
def test_a_signal_that_does_not_move(tmp_path: Path, ending: str, column: str, value: int) -> None:
    frame = table().assign(**{column: float(value)})
    assert "is constant" in refused(tmp_path, ending, encode(frame, ending))


@examples(40)
@given(st.sampled_from((".csv", ".txt")), rows, st.integers(1, 12).filter(lambda n: n != 7))
def test_a_row_of_another_length(tmp_path: Path, ending: str, row: int, cells: int) -> None:
    lines = encode(table(), ending).decode().splitlines()
    lines[row + 1] = ",".join(["1.5"] * cells)
    assert f"line {row + 2} " in refused(tmp_path, ending, "\n".join(lines).encode())


@examples(20)
@given(st.sampled_from(TEXT), st.booleans())
def test_no_header(tmp_path: Path, ending: str, commented: bool) -> None:
    content = table().to_csv(index=False, header=False).encode()
    content = (b"# of monday\n" if commented else b"") + content
    content = gzip.compress(content) if "gz" in ending else content
    assert "header" in refused(tmp_path, ending, content)


@examples(80)
@given(st.sampled_from((*BINARY, ".csv")), st.floats(0, 1, exclude_max=True))
def test_a_file_cut_off(tmp_path: Path, ending: str, part: float) -> None:
    content = encode(table(), ending)
    content = content[: int(part * len(content))]
    if ending == ".csv":
        # Cut within the first 19 rows, or else less of a valid recording would be one.
        content = b"".join(content.splitlines(keepends=True)[:19])
    refused(tmp_path, ending, content)


@examples(120)
@given(
    st.sampled_from((*TEXT, *BINARY, ".xlsx", "")),
    st.sampled_from(
        [b"", b"PK\x03\x04", b"PAR1", b"MATLAB 5.0 MAT-file", b"\x1f\x8b\x08", b"\x93NUMPY"]
    ),
    st.binary(max_size=2000),
)
def test_random_bytes(tmp_path: Path, ending: str, start: bytes, content: bytes) -> None:
    refused(tmp_path, ending, start + content)


@examples(40)
@given(st.text(max_size=400))
def test_random_text(tmp_path: Path, text: str) -> None:
    refused(tmp_path, ".csv", text.encode())


@examples(60)
@given(st.sampled_from([".npz", ".mat", ".parquet"]), st.data())
def test_flipped_bytes_never_give_another_error(
    tmp_path: Path, ending: str, data: st.DataObject
) -> None:
    # A flip may leave the recording whole (a date, an unused name), so both ends are fair.
    content = bytearray(encode(table(), ending))
    flips = data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=4))
    for flip in flips:
        content[flip] ^= data.draw(st.integers(1, 255))
    path = tmp_path / f"run{ending}"
    path.write_bytes(content)
    try:
        recording = read(path)[0]
    except RecordingError:
        refused(tmp_path, ending, bytes(content))
    else:
        np.testing.assert_array_equal(recording.q, arrays()["q"])


bad_arrays = st.one_of(
    st.none(),
    st.text(),
    st.just(object()),
    st.just({"a": 1}),
    st.just({1.0, 2.0}),
    st.floats(),
    st.sampled_from([complex, object, str, bool, "M8[s]", "m8[s]"]).map(
        lambda kind: np.arange(2 * SAMPLES).reshape(SAMPLES, 2).astype(kind)
    ),
    st.lists(st.lists(st.floats(), max_size=3), min_size=1, max_size=SAMPLES - 1),
    st.lists(st.sampled_from([1.0, None, "x"]), min_size=SAMPLES, max_size=SAMPLES),
    st.integers(0, 3 * SAMPLES).filter(lambda n: n != SAMPLES).map(lambda n: np.arange(float(n))),
    st.sampled_from(
        [(SAMPLES, 2, 2), (SAMPLES, 0), (2, SAMPLES), (0,), (), (1, 1), (SAMPLES, 3)]
    ).map(np.ones),
)


@examples(100)
@given(st.sampled_from(["time", "q", "tau", "q_ref", "v", "tau_ff"]), bad_arrays)
def test_arrays(signal: str, bad: object) -> None:
    if bad is None and signal not in ("time", "q", "tau"):
        bad = [None]
    one_sentence("run", lambda: Recording.from_arrays(**arrays() | {signal: bad}, name="run"))
