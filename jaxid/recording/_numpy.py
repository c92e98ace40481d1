"""NumPy's archives of arrays, without their Python objects."""

import io
import zipfile
from collections.abc import Callable

import numpy as np

from ..errors import brief
from ..storage.arrays import npy
from ._problem import problem
from ._table import Table, unique


def npz_table(source: str, data: bytes, largest: int, refuse: Callable[[int], Exception]) -> Table:
    """Named arrays of a `.npz` file.

    **Arguments:**

    - `largest`: most unpacked bytes; `refuse` makes the error for more.

    **Raises:** `RecordingError` for an array of objects; zipfile's exceptions for a damaged file.
    """
    if data.startswith(np.lib.format.MAGIC_PREFIX):
        npy(data)
        raise problem(
            source, "has one unnamed array", "save named arrays by np.savez(file, time=..., q=...)"
        )
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        size = sum(entry.file_size for entry in entries)
        if size > largest:
            raise refuse(size)
        names = [entry.filename.removesuffix(".npy") for entry in entries]
        unique(source, names)
        columns, refused = {}, {}
        for name, entry in zip(names, entries, strict=True):
            if name == entry.filename:
                refused[name] = "file of another kind"
            else:
                columns[name] = _array(source, name, archive.read(entry))
    return Table(columns, refused)


def _array(source: str, name: str, content: bytes) -> np.ndarray:
    try:
        return npy(content)
    except ValueError as error:
        raise problem(
            source,
            f"array {brief(name)} cannot be read ({error})",
            "save plain arrays of numbers with np.savez, no Python objects",
        ) from error
