"""Saved results that are cut off, edited, forged or of another version: refused in a sentence."""

import dataclasses
import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_saved import same

import jaxid
from jaxid.errors import SaveError
from jaxid.storage import archive, arrays

# What one worker has fitted serves all of them.
pytestmark = pytest.mark.xdist_group("demo")


def refused(path: Path, content: bytes, **settings: Any) -> str:
    """The sentence with which a file is refused."""
    path.write_bytes(content)
    with pytest.raises(SaveError) as info:
        jaxid.load(path, **settings)
    message = str(info.value)
    assert message.startswith(f"{path}: ")
    assert message.endswith(".")
    assert message.isprintable()
    assert len(message) - len(str(path)) < 350
    return message


def zipped(members: dict[str, bytes], how: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", how) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


def members_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        return {name: file.read(name) for name in file.namelist()}


def sealed(manifest: Any, arrays: dict[str, bytes]) -> bytes:
    """A forged file whose checksums are right."""
    if isinstance(manifest, dict):
        digests = [hashlib.sha256(content).hexdigest() for content in arrays.values()]
        manifest = manifest | {"arrays": digests}
    text = json.dumps(manifest).encode()
    seal = hashlib.sha256(text).hexdigest().encode()
    return zipped({"manifest.json": text, "manifest.sha256": seal} | arrays)


class Whole(bytes):
    """The bytes of a file, shown short when a test fails."""

    def __repr__(self) -> str:
        return f"{len(self)} bytes"


@pytest.fixture(scope="session")
def whole(small_fit: jaxid.Fit) -> bytes:
    return Whole(archive.pack(small_fit))


def forged(whole: bytes, **changes: Any) -> bytes:
    members = members_of(whole)
    manifest = json.loads(members["manifest.json"]) | changes
    return sealed(manifest, {k: v for k, v in members.items() if k.endswith(".npy")})


def test_from_the_future(tmp_path: Path, whole: bytes) -> None:
    later = forged(whole, format=archive.FORMAT + 1, versions={"jaxid-robotics": "9.1"})
    message = refused(tmp_path / "fit", later)
    assert f"is of format {archive.FORMAT + 1} (jaxid 9.1)" in message
    assert "upgrade jaxid" in message


def test_of_no_format(tmp_path: Path, whole: bytes) -> None:
    for odd in (0, -1, None, "1", 1.0, True, [1]):
        assert "names no format" in refused(tmp_path / "fit", forged(whole, format=odd))


def test_edited(tmp_path: Path, whole: bytes) -> None:
    members = members_of(whole)
    text = members["manifest.json"].replace(b'"converged"', b'"max_steps"')
    assert text != members["manifest.json"]
    message = refused(tmp_path / "fit", zipped(members | {"manifest.json": text}))
    assert "manifest was changed after it was written" in message
    array = members["0.npy"][:-1] + b"\1"
    message = refused(tmp_path / "fit", zipped(members | {"0.npy": array}))
    assert "0.npy is missing or was changed" in message
    message = refused(tmp_path / "fit", zipped({k: v for k, v in members.items() if k != "0.npy"}))
    assert "0.npy is missing or was changed" in message
    message = refused(tmp_path / "fit", zipped(members | {"more.npy": b"1"}))
    assert "does not name" in message


def test_packed_again(tmp_path: Path, whole: bytes) -> None:
    bomb = zipped({"manifest.json": b" " * 2**24}, zipfile.ZIP_DEFLATED)
    assert "packed again" in refused(tmp_path / "fit", bomb)
    assert "packed again" in refused(
        tmp_path / "fit", zipped(members_of(whole), zipfile.ZIP_DEFLATED)
    )


def test_members_that_share_their_bytes(tmp_path: Path) -> None:
    # Many entries of the directory that all point to one stored member (Fifield 2019).
    content = zipped({"manifest.json": b" " * 2**16})
    start = content.index(b"PK\1\2")
    end = content.index(b"PK\5\6")
    entries = content[start:end] * 1000
    tail = bytearray(content[end:])
    tail[8:12] = (1000).to_bytes(2, "little") * 2
    tail[12:16] = len(entries).to_bytes(4, "little")
    message = refused(tmp_path / "fit", content[:start] + entries + bytes(tail))
    assert "more than its own size" in message


def test_too_large(tmp_path: Path, whole: bytes) -> None:
    message = refused(tmp_path / "fit", whole, largest=1000)
    assert f"pass largest={len(whole)}" in message


@pytest.mark.parametrize(
    ("array", "says"),
    [
        (np.array([{"a": 1}], object), "Python objects"),
        (np.array(["text"]), "holds <U4"),
        (np.array([1j]), "holds complex128"),
    ],
)
def test_arrays_of_anything_but_numbers(
    tmp_path: Path, whole: bytes, array: np.ndarray, says: str
) -> None:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    members = {k: v for k, v in members_of(whole).items() if k.endswith(".npy")}
    manifest = json.loads(members_of(whole)["manifest.json"])
    content = sealed(manifest, members | {"0.npy": buffer.getvalue()})
    assert says in refused(tmp_path / "fit", content)


@pytest.mark.parametrize("shape", [(10**12,), (2**62, 4), (-1,), (3,), (0, 2**40)])
def test_a_header_that_lies(shape: tuple[int, ...]) -> None:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    with pytest.raises(ValueError, match="declares"):
        arrays.npy(buffer.getvalue() + bytes(16))


@pytest.mark.parametrize(
    "entry",
    [
        {"class": "system", "package": "os", "fields": {}},
        {"class": "Popen", "package": "subprocess", "fields": {"args": "true"}},
        {"class": "Path", "package": "pathlib", "fields": {}},
        {"class": "_Absent", "package": "", "fields": {}},
        {"class": "Fit", "package": "", "fields": {"__class__": 1}},
        {"class": "OEM", "package": "", "fields": {"max_steps": "many"}},
        {"class": "Recordings", "package": "", "fields": {"recordings": {"tuple": [1]}}},
    ],
)
def test_classes_and_fields_that_are_not_there(tmp_path: Path, entry: Any) -> None:
    manifest = {"format": 1, "versions": {}, "root": {"object": 0}, "objects": [entry]}
    refused(tmp_path / "fit", sealed(manifest, {}))


def test_a_loop_that_has_no_such_joint(tmp_path: Path) -> None:
    content = archive.pack(jaxid.scara())
    members = members_of(content)
    manifest = json.loads(members["manifest.json"])
    effect = next(o for o in manifest["objects"] if o["class"] == "Viscous")
    effect["fields"]["joint"] = 7
    arrays = {k: v for k, v in members.items() if k.endswith(".npy")}
    assert "joint 7" in refused(tmp_path / "loop", sealed(manifest, arrays))


def test_no_file_and_nowhere_to_write(tmp_path: Path, small_fit: jaxid.Fit) -> None:
    with pytest.raises(SaveError, match="cannot be opened"):
        jaxid.load(tmp_path / "absent")
    with pytest.raises(SaveError, match="cannot be opened"):
        jaxid.load(tmp_path)
    with pytest.raises(SaveError, match="cannot be written"):
        small_fit.save(tmp_path / "absent" / "fit.jaxid")
    with pytest.raises(SaveError, match="cannot be written"):
        small_fit.save("nul\0byte")


def test_what_is_written_is_whole_or_not_at_all(
    tmp_path: Path, small_fit: jaxid.Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = small_fit.save(tmp_path / "fit.jaxid")
    before = path.read_bytes()

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(SaveError, match="No space left"):
        dataclasses.replace(small_fit, iterations=99).save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["fit.jaxid"]


def examples(count: int) -> settings:
    """Settings for `count` inputs, the same ones in every run."""
    return settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )


@examples(60)
@given(part=st.floats(0, 1, exclude_max=True))
def test_cut_off(tmp_path: Path, whole: bytes, part: float) -> None:
    refused(tmp_path / "fit", whole[: int(part * len(whole))])


@examples(200)
@given(data=st.data())
def test_flipped_bytes(tmp_path: Path, whole: bytes, small_fit: jaxid.Fit, data: Any) -> None:
    content = bytearray(whole)
    for place in data.draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=3)):
        content[place] ^= data.draw(st.integers(1, 255))
    (tmp_path / "fit").write_bytes(content)
    try:
        back = jaxid.load(tmp_path / "fit")
    except SaveError:
        refused(tmp_path / "fit", bytes(content))
    else:
        # A flip in bytes that are not read, such as a member's date.
        same(small_fit, back)


@examples(100)
@given(content=st.binary(max_size=400), start=st.sampled_from([b"", b"PK\3\4", b"PK\5\6"]))
def test_random_bytes(tmp_path: Path, content: bytes, start: bytes) -> None:
    refused(tmp_path / "fit", start + content)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                ["object", "array", "jax", "tuple", "set", "dict", "float", "enum", "frame"]
            )
            | st.text(max_size=4),
            inner,
            max_size=3,
        )
    ),
    max_leaves=6,
)


def places(tree: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of everything in a JSON document."""
    found = [at]
    inner = (
        tree.items() if isinstance(tree, dict) else enumerate(tree if type(tree) is list else ())
    )
    for key, value in inner:
        found += places(value, (*at, key))
    return found


@examples(150)
@given(data=st.data())
def test_a_forged_manifest(tmp_path: Path, whole: bytes, data: Any) -> None:
    members = members_of(whole)
    manifest = json.loads(members["manifest.json"])
    at = data.draw(st.sampled_from([p for p in places(manifest) if p]))
    inside = manifest
    for key in at[:-1]:
        inside = inside[key]
    inside[at[-1]] = data.draw(json_values)
    arrays = {k: v for k, v in members.items() if k.endswith(".npy")}
    (tmp_path / "fit").write_bytes(sealed(manifest, arrays))
    try:
        jaxid.load(tmp_path / "fit")
    except SaveError:
        refused(tmp_path / "fit", sealed(manifest, arrays))
