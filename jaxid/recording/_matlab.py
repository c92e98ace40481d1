"""MATLAB files of version 5, read without trusting their headers.

SciPy's reader is C code that trusts them: one wrong bit in a flag can crash the process. The layout
is described in MathWorks' "MAT-File Format".
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator

import numpy as np

_MATRIX, _COMPRESSED = 14, 15
_CHAR, _OPAQUE = 4, 17
# Classes of arrays, and types of stored numbers.
_ODD = {1: "cell", 2: "struct", 3: "object", 5: "sparse", 16: "function", _OPAQUE: "opaque"}
_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_STORED |= {12: "i8", 13: "u8"}
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_COMPLEX = 0x800


def order_of(data: bytes) -> str | None:
    """Byte order of a file of version 5; None for other files."""
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    # Version 4 begins with a small number, version 5 with text.
    return None if 0 in data[:4] else order


def variables(
    data: bytes, order: str, largest: int, refuse: Callable[[int], Exception]
) -> Iterator[tuple[str, np.ndarray | str]]:
    """Name and array of each variable, or the kind of a variable that is not an array.

    **Arguments:**

    - `largest`: total bytes to which compressed variables may unpack.
    - `refuse`: makes the error for more, from a lower bound on their number.

    **Raises:** `ValueError` for anything that the format does not allow.
    """
    at, left = 128, largest
    while at < len(data):
        kind, content, at = _element(data, at, order)
        if kind == _COMPRESSED:
            content = _unpacked(content, left)
            left -= len(content)
            if left < 0:
                raise refuse(largest - left)
            kind, content, _ = _element(content, 0, order)
        if kind != _MATRIX:
            raise ValueError(f"a variable is of type {kind}, which is not an array")
        name, value = _matrix(content, order)
        # MATLAB stores data of functions in a variable without a name.
        if name:
            yield name, value


def _element(data: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Type and content of a data element, and the position of the next."""
    if at + 8 > len(data):
        raise ValueError("the file ends in the middle of a variable")
    kind, size = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:
        # Up to four bytes are kept in the tag itself.
        kind, size = kind & 0xFFFF, kind >> 16
        if size > 4:
            raise ValueError(f"a small element declares {size} bytes")
        return kind, data[at + 4 : at + 4 + size], at + 8
    content = data[at + 8 : at + 8 + size]
    if len(content) < size:
        raise ValueError(f"a variable declares {size} bytes, but {len(content)} are left")
    padding = 0 if kind == _COMPRESSED else -size % 8
    return kind, content, at + 8 + size + padding


def _unpacked(packed: bytes, most: int) -> bytes:
    """Decompressed bytes; one more than `most` if there are more."""
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(packed, most + 1)
    if len(content) <= most and not unpacker.eof:
        raise ValueError("a compressed variable is cut off")
    return content


def _matrix(data: bytes, order: str) -> tuple[str, np.ndarray | str]:
    flags, at = _expected(data, 0, order, 6)
    if len(flags) != 8:
        raise ValueError("the flags of a variable are not eight bytes")
    word = struct.unpack(f"{order}II", flags)[0]
    kind = word & 0xFF
    if kind == _OPAQUE:
        return _expected(data, at, order, 1)[0].decode("latin-1"), _ODD[kind]
    sizes, at = _expected(data, at, order, 5)
    shape = tuple(int(n) for n in np.frombuffer(sizes, f"{order}i4"))
    called, at = _expected(data, at, order, 1)
    name = called.decode("latin-1")
    if kind in _ODD:
        return name, _ODD[kind]
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError(f"{name!r} has the shape {shape}")
    if kind == _CHAR:
        stored, content, _ = _element(data, at, order)
        return name, _text(content, stored, shape, order)
    if kind not in _CLASSES:
        raise ValueError(f"{name!r} is of class {kind}, which does not exist")
    real, at = _numbers(data, at, order, shape)
    if word & _COMPLEX:
        return name, real + 1j * _numbers(data, at, order, shape)[0]
    # Whole numbers may be stored as integers, but fractions are never stored in an integer class.
    if not np.can_cast(real.dtype, _CLASSES[kind], "same_kind") and real.dtype.kind == "f":
        raise ValueError(f"{name!r} contains fractions, but its class is of integers")
    return name, real.astype(_CLASSES[kind])


def _expected(data: bytes, at: int, order: str, kind: int) -> tuple[bytes, int]:
    found, content, after = _element(data, at, order)
    if found != kind:
        raise ValueError(f"there is an element of type {found}, but {kind} is expected")
    return content, after


def _numbers(data: bytes, at: int, order: str, shape: tuple[int, ...]) -> tuple[np.ndarray, int]:
    stored, content, after = _element(data, at, order)
    if stored not in _STORED:
        raise ValueError(f"numbers are of type {stored}, which does not exist")
    values = np.frombuffer(content, f"{order}{_STORED[stored]}")
    if len(values) != math.prod(shape):
        raise ValueError(f"there are {len(values)} numbers, but the shape is {shape}")
    return values.reshape(shape, order="F"), after


def _text(content: bytes, stored: int, shape: tuple[int, ...], order: str) -> np.ndarray:
    """The rows of a matrix of characters."""
    if stored not in _TEXT:
        raise ValueError(f"text is of type {stored}, which does not exist")
    coding = _TEXT[stored]
    if coding in ("utf-16", "utf-32"):
        coding += "-le" if order == "<" else "-be"
    text = content.decode(coding)
    if shape[0] == 1 or len(text) != math.prod(shape):
        return np.array([text])
    columns = np.array(list(text), "U1").reshape(shape[0], -1, order="F")
    return np.array(["".join(row) for row in columns])
