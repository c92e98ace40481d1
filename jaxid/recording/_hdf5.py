"""HDF5: datasets by their path."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import require
from ._table import Table


def hdf5_table(path: Path, largest: int, refuse: Callable[[int], Exception]) -> Table:
    """Datasets of numbers in a file by path, as `robot/q`; the fields of a table as `log/q`.

    Images and other arrays of more than two dimensions are listed but not read, and neither is data
    in other files.

    **Arguments:**

    - `largest`: most bytes to read; `refuse` makes the error for more.

    **Raises:** `MissingExtraError` without the extra `hdf5`; h5py's exceptions for a damaged file.
    """
    h5py = require("h5py", "hdf5")
    columns: dict[str, object] = {}
    refused: dict[str, str] = {}
    with h5py.File(path, "r", locking=False) as file:
        found: list[tuple[str, Any]] = []
        file.visititems(lambda name, item: found.append((name, item)))
        datasets = [(name, item) for name, item in found if isinstance(item, h5py.Dataset)]
        left = largest
        for name, dataset in datasets:
            kind = _unreadable(dataset)
            if kind:
                refused[name] = kind
                continue
            left -= dataset.size * dataset.dtype.itemsize
            if left < 0:
                raise refuse(largest - left)
            if dataset.dtype.names is None:
                columns[name] = dataset[()]
            else:
                columns |= {f"{name}/{f}": dataset[f] for f in dataset.dtype.names}
        about = tuple(
            f"{name}: {'x'.join(map(str, item.shape)) or 'one'} {item.dtype}"
            + (f", not read ({refused[name]})" if name in refused else "")
            for name, item in datasets
        )
    return Table(columns, refused, about=about)


def _unreadable(dataset: Any) -> str:
    """Description of a dataset that cannot be a signal; empty for numbers."""
    if dataset.external or dataset.is_virtual:
        return "dataset in another file"
    if dataset.shape is None:
        return "dataset without data"
    if dataset.ndim > 2:
        return f"dataset of {dataset.ndim} dimensions"
    if dataset.dtype.kind == "V" and dataset.ndim > 1:
        return "table of several dimensions"
    if dataset.dtype.kind not in "iufbV":
        return "dataset of text or objects"
    return ""
