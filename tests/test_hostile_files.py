"""Recordings that were made to do harm: nothing is executed, and nothing unpacks without end."""

import contextlib
import gzip
import io
import os
import pickle
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from jaxid.errors import RecordingError
from jaxid.recording import read

MEGABYTE = 2**20
# What a bomb unpacks to, and what the tests allow: their ratio is what matters.
BOMB, ALLOWED = 64 * MEGABYTE, MEGABYTE


def refused(path: Path, content: bytes, largest: int = ALLOWED) -> str:
    path.write_bytes(content)
    with pytest.raises(RecordingError) as info:
        read(path, largest=largest)
    message = str(info.value)
    assert message.startswith(f"{path}: ")
    assert message.endswith(".")
    assert message.isprintable()
    return message


def gz_bomb() -> bytes:
    return gzip.compress(b"time,q_1,tau_1\n" + b"0,0,0\n" * (BOMB // 6))


def npz_bomb() -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, time=np.zeros(BOMB // 8))
    return buffer.getvalue()


def mat_bomb() -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"time": np.zeros(BOMB // 8)}, do_compression=True)
    return buffer.getvalue()


def parquet_bomb() -> bytes:
    buffer = io.BytesIO()
    # One value and a run length: a few hundred bytes for any number of rows.
    pd.DataFrame({"time": np.zeros(BOMB // 8)}).to_parquet(buffer, compression="zstd")
    return buffer.getvalue()


BOMBS = {"csv.gz": gz_bomb, "npz": npz_bomb, "mat": mat_bomb, "parquet": parquet_bomb}


@pytest.mark.parametrize("ending", BOMBS)
def test_bombs_are_refused_in_bounded_memory(tmp_path: Path, ending: str) -> None:
    content = BOMBS[ending]()
    assert len(content) < BOMB / 100
    tracemalloc.start()
    try:
        message = refused(tmp_path / f"run.{ending}", content)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert f"more than the limit of {ALLOWED}" in message
    assert peak < 8 * ALLOWED


def test_ten_gigabytes_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    with open(path, "wb") as file:
        # A hole in the file: it has that size and takes no room.
        file.truncate(10 * 2**30)
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match="at least 10737418240 bytes"):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < MEGABYTE
    finally:
        tracemalloc.stop()


def test_a_user_may_ask_for_more(tmp_path: Path) -> None:
    time = 0.01 * np.arange(200)
    frame = pd.DataFrame({"time": time, "q_1": np.sin(time), "tau_1": np.cos(time)})
    frame.to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(RecordingError, match="largest"):
        read(tmp_path / "run.csv", largest=1000)
    assert read(tmp_path / "run.csv", largest=100_000)[0].samples == 200


def with_member(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        file.writestr("time.npy", content)
    return buffer.getvalue()


@pytest.mark.parametrize("shape", [(10**13,), (2**40, 2**20), (200,), (-5,)])
def test_headers_that_lie(tmp_path: Path, shape: tuple[int, ...]) -> None:
    buffer = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    message = refused(tmp_path / "run.npz", with_member(buffer.getvalue() + bytes(64)))
    assert "'time'" in message
    assert "declares" in message


def test_directories_that_lie(tmp_path: Path) -> None:
    content = bytearray(npz_bomb())
    # The size that the directory at the end promises, made small.
    at = content.index(b"PK\1\2") + 24
    content[at : at + 4] = struct.pack("<I", 1000)
    refused(tmp_path / "run.npz", bytes(content))


def test_matlab_headers_that_lie(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"time": np.zeros(30)})
    for size in (2**31 - 8, 2**32 - 1, 10**6):
        content = bytearray(buffer.getvalue())
        content[132:136] = struct.pack("<I", size)
        refused(tmp_path / "run.mat", bytes(content))
    # A compressed variable whose inner tag promises four gigabytes.
    inner = struct.pack("<II", 14, 2**32 - 1) + bytes(64)
    packed = zlib.compress(inner)
    content = buffer.getvalue()[:128] + struct.pack("<II", 15, len(packed)) + packed
    refused(tmp_path / "run.mat", content)


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_flags_that_lie(tmp_path: Path, compressed: bool) -> None:
    # One of them, complex without an imaginary part, ended the process in SciPy's reader.
    frame = {"time": 0.01 * np.arange(30), "q": np.sin(np.arange(30)), "tau": np.cos(np.arange(30))}
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, frame)
    plain = buffer.getvalue()
    # The first variable: a reader that goes on behind it finds the next one.
    end = 136 + struct.unpack_from("<I", plain, 132)[0]
    for at in range(144, 152):
        for value in {0, 1, 4, 14, 0x6E, 0xFF} - {plain[at]}:
            content = bytearray(plain)
            content[at] = value
            if compressed:
                packed = zlib.compress(bytes(content[128:end]))
                content[128:end] = struct.pack("<II", 15, len(packed)) + packed
            path = tmp_path / "run.mat"
            path.write_bytes(bytes(content))
            # Bits that mean nothing are let pass.
            with contextlib.suppress(RecordingError):
                assert read(path)[0].samples == 30


def test_matlab_files_of_every_kind(tmp_path: Path) -> None:
    time = 0.01 * np.arange(30)
    signals = {"time": time, "q": np.sin(time)[:, None], "tau": np.round(9 * np.cos(9 * time))}
    for number in ("f8", "f4", "i2"):
        signals["tau"] = signals["tau"].astype(number)
        for settings in ({"format": "4"}, {}, {"do_compression": True}):
            scipy.io.savemat(tmp_path / "run.mat", signals, **settings)
            found = read(tmp_path / "run.mat")[0]
            np.testing.assert_array_equal(found.tau[:, 0], signals["tau"])
            np.testing.assert_array_equal(found.q, signals["q"])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
def test_pipes_and_devices_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.csv")
    for path in (tmp_path / "run.csv", Path("/dev/zero")):
        with pytest.raises(RecordingError, match="not a plain file"):
            read(path)


class Trap:
    """Unpickled, it leaves a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return os.mkdir, (str(self.path),)


def test_pickles_are_not_opened(tmp_path: Path) -> None:
    trap = np.array([Trap(tmp_path / "sprung")], object)
    bare = io.BytesIO()
    np.save(bare, trap, allow_pickle=True)
    contents = {
        "a.npz": with_member(bare.getvalue()),
        "b.npz": with_member(pickle.dumps(Trap(tmp_path / "sprung"))),
        "c.npz": pickle.dumps(Trap(tmp_path / "sprung")),
        "d.mat": pickle.dumps(Trap(tmp_path / "sprung")),
        "e.parquet": pickle.dumps(Trap(tmp_path / "sprung")),
        "f.npz": bare.getvalue(),
    }
    for name, content in contents.items():
        refused(tmp_path / name, content)
    assert not (tmp_path / "sprung").exists()
    pickle.loads(pickle.dumps(Trap(tmp_path / "sprung")))
    assert (tmp_path / "sprung").exists()


def test_objects_of_matlab_are_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    cell = np.array([{"a": 1}, "b"], object)
    scipy.io.savemat(buffer, {"time": np.zeros(30), "q": cell, "tau": np.zeros((30, 1))})
    assert "'q' is a cell variable" in refused(tmp_path / "run.mat", buffer.getvalue())


@pytest.mark.parametrize(
    "name", ["$(touch hit)", "; touch hit", "`touch hit`", "<script>x", "a\nb"]
)
def test_names_are_only_names(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    time = 0.01 * np.arange(40)
    column = f'{name}"' if "\n" not in name else name.replace("\n", " ")
    frame = pd.DataFrame({"time": time, column: np.sin(9 * time), "tau_1": np.cos(9 * time)})
    frame.to_csv(f"{name}.csv", index=False)
    assert read(f"{name}.csv", columns={"q": column, "tau": "tau_1"})[0].name == name
    with pytest.raises(RecordingError) as info:
        read(f"{name}.csv")
    assert str(info.value).isprintable()
    assert not Path("hit").exists()
