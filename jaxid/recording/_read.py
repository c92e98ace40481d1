"""Reads recordings from files."""

import contextlib
import csv
import gzip
import io
import itertools
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import equinox as eqx
import numpy as np

from ..errors import JaxidError, RecordingError, brief, require
from ._bag import bag_name, bag_table, is_bag
from ._checks import Accept, Clock, Nan, is_number
from ._columns import labels_of, pick
from ._description import Columns, Description, Resolution, Scale
from ._hdf5 import hdf5_table
from ._lerobot import episodes, lerobot_folder
from ._matlab import order_of, variables
from ._numpy import npz_table
from ._problem import problem
from ._recording import Recordings, build
from ._table import Table, from_frame, unique
from ._times import Gaps
from ._units import Units

# Two million samples of seven columns as text; a laptop has the memory to read them.
LARGEST = 256 * 2**20


class Contents(eqx.Module):
    """What `contents_of` found in a file.

    - `columns`: names of its columns, arrays or streams.
    - `signals`: columns by signal, as `jaxid.read` takes them; empty if it cannot.
    - `joints`: names of joints, if columns are named by them.
    - `about`: other contents, one per line: topics of a bag, features of a dataset.
    """

    columns: tuple[str, ...]
    signals: dict[str, list[str]]
    joints: tuple[str, ...] = ()
    about: tuple[str, ...] = ()


def read(
    *paths: str | os.PathLike[str],
    columns: Columns | None = None,
    joints: Sequence[str] | None = None,
    units: Units | None = None,
    scale: Scale | None = None,
    resolution: Resolution | None = None,
    gaps: Gaps = "refuse",
    nan: Nan = "refuse",
    clock: Clock = "recorded",
    largest: int = LARGEST,
) -> Recordings:
    """Reads recordings from text, Parquet, MATLAB, NumPy, HDF5, ROS 2 bags and LeRobot datasets.

    **Arguments:**

    - `paths`: one for each recording, which gets the file's name: `.csv`, `.tsv`, `.txt` (or these
      `.gz`), `.parquet`, `.mat`, `.npz`, `.h5`, `.hdf5`, a bag (its folder, `.mcap` or `.db3`); or
      the folder of a LeRobot dataset for all of its episodes, `FOLDER/episode_3` for one.
    - `columns`: maps signals to the file's names, e.g. `{"time": "t", "q": ["pos1", "pos2"]}`. A
      name may be a product, `"gain*current"`. `time` may be the sample period, as a number or the
      name of one. By default the columns are `time`, `q_1..n`, `tau_1..n` and, if present,
      `q_ref_1..n`, `v_1..n`, `tau_ff_1..n`, `v_ref_1..n`, `kp_1..n`, `kd_1..n`, `supply_1..n`,
      `on_1..n`; or `q`, `tau`, ... for all joints at once. The last five may be numbers instead of
      names. Files of the EMPS benchmark and joint states of bags and datasets are recognised.
      Other columns are ignored.
    - `joints`: names of joints in the order of the robot, if a bag or dataset has them; by default
      all of them, sorted by name.
    - `units`: unit by signal, e.g. `{"q": "deg", "v": "deg/s", "tau": "N·mm", "time": "ms"}`; SI by
      default, `q_ref` as `q`, `tau_ff` as `tau`, `v_ref` as `v`.
    - `scale`: factor by signal, one or one for each joint, e.g. `{"tau": [0.062 * 100, 0.05 * 50]}`
      for amperes, by torque constant and gear ratio, or `{"q": 2 * np.pi / 4096}` for counts;
      `q_ref` as `q`, `tau_ff` as `tau`.
    - `resolution`: encoder step, one or one for each joint, rad or m.
    - `gaps`: `"allow"` to accept missing stretches of time.
    - `nan`: `"drop"` to leave out samples at which a signal is empty; a warning counts them.
    - `clock`: `"even"` to treat samples as evenly spaced if a logger's times jitter.
    - `largest`: size in bytes, unpacked, above which a file is refused; reading text takes about
      ten times that much memory.

    **Raises:** `RecordingError` for a file that cannot be used; `MissingExtraError` for a format
    whose extra is not installed.
    """
    if not paths:
        raise problem("read()", "no file was given", "pass at least one path")
    told = Description(columns, joints, units, scale, resolution, Accept(gaps, nan, clock))
    return Recordings.of(
        build(source, name, pick(source, table, told), told)
        for path in paths
        for source, name, table in _tables(Path(path), largest)
    )


def contents_of(
    path: str | os.PathLike[str],
    *,
    columns: Columns | None = None,
    joints: Sequence[str] | None = None,
    largest: int = LARGEST,
) -> Contents:
    """Contents of a file; of a dataset, those of its first episode.

    **Arguments:**

    - `path`, `columns`, `joints`, `largest`: as in `jaxid.read`.

    **Raises:** `RecordingError` for a file that cannot be read.
    """
    source, _, table = next(iter(_tables(Path(path), largest)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            labels, _ = labels_of(source, table, Description(columns, joints))
    except RecordingError:
        labels = {}
    known = dict.fromkeys(j for by_joint in table.defaults.values() for j in by_joint)
    return Contents(tuple(table.columns), labels, tuple(known), table.about)


def _tables(path: Path, largest: int) -> Iterator[tuple[str, str, Table]]:
    """Name in messages, own name, and table of each recording at a path."""
    source = str(path)

    def refuse(size: int) -> Exception:
        return _too_large(source, size, largest)

    with _said(source, path):
        dataset = lerobot_folder(path)
        if dataset is not None:
            for name, table in episodes(source, *dataset, largest, refuse):
                yield str(dataset[0] / name), name, table
        elif is_bag(path):
            if path.is_file():
                _there(source, path)
            yield source, bag_name(path), bag_table(source, path, largest, refuse)
        elif path.suffix.lower() in (".h5", ".hdf5"):
            _there(source, path)
            yield source, path.stem, hdf5_table(path, largest, refuse)
        else:
            inner = path.with_suffix("") if path.suffix.lower() == ".gz" else path
            yield source, inner.stem, _table(source, path, inner, largest)


@contextlib.contextmanager
def _said(source: str, path: Path) -> Iterator[None]:
    """Converts the exceptions of parsers to an error of one sentence."""
    try:
        yield
    except (JaxidError, GeneratorExit):
        raise
    except Exception as error:  # parsers of broken files may raise any exception
        kind = "".join(path.suffixes[-1 - (path.suffix.lower() == ".gz") :]) or "a folder of logs"
        raise problem(
            source,
            f"cannot be read as {kind}, it is damaged, truncated or of another kind "
            f"({type(error).__name__}: {error})",
            "write or copy the file again",
        ) from error


def _table(source: str, path: Path, inner: Path, largest: int) -> Table:
    zipped = inner != path
    data = _bytes(source, path, largest)
    reader = _reader(source, inner.suffix.lower(), zipped)
    return reader(source, _gunzip(source, data, largest) if zipped else data, largest)


def _reader(source: str, extension: str, zipped: bool) -> Callable[[str, bytes, int], Table]:
    match extension:
        case ".csv" | ".tsv" | ".txt":
            return _text
        case ".parquet" if not zipped:
            return _parquet
        case ".mat" if not zipped:
            return _mat
        case ".npz" if not zipped:
            return lambda source, data, largest: npz_table(
                source, data, largest, lambda size: _too_large(source, size, largest)
            )
    if extension == ".bag":
        raise problem(source, "is a bag of ROS 1", "convert it with rosbags-convert of rosbags")
    raise problem(
        source,
        f"the extension {brief(Path(source).suffix)} is not known",
        "use .csv, .tsv or .txt (or these with .gz), .parquet, .mat, .npz, .h5, .mcap or .db3",
    )


def _bytes(source: str, path: Path, largest: int) -> bytes:
    size = _there(source, path)
    if size > largest:
        raise _too_large(source, size, largest)
    with open(path, "rb") as file:
        data = file.read(largest + 1)
    if len(data) > largest:
        raise _too_large(source, len(data), largest)
    return data


def _there(source: str, path: Path) -> int:
    """Size of a plain file that can be opened, in bytes."""
    try:
        # A pipe or a device may never end.
        if path.exists() and not path.is_file() and not path.is_dir():
            raise problem(source, "is not a plain file", "copy its content to a file")
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
    except FileNotFoundError as error:
        raise problem(source, "there is no such file", "check the path") from error
    except IsADirectoryError as error:
        raise problem(
            source,
            "is a directory, and neither a bag (no metadata.yaml) nor a LeRobot dataset (no "
            "meta/info.json)",
            "name the files in it",
        ) from error
    except RecordingError:
        raise
    except (OSError, ValueError, MemoryError) as error:
        raise problem(
            source, f"cannot be opened ({error})", "check the path and permissions"
        ) from error
    if not size:
        raise problem(source, "the file is empty", "record or copy it again")
    return size


def _too_large(source: str, size: int, largest: int) -> RecordingError:
    return problem(
        source,
        f"has at least {size} bytes unpacked, more than the limit of {largest}",
        "cut it into shorter recordings, or pass read(..., largest=) if you trust it",
    )


def _gunzip(source: str, data: bytes, largest: int) -> bytes:
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        text = file.read(largest + 1)
    if len(text) > largest:
        raise _too_large(source, len(text), largest)
    return text


def _text(source: str, data: bytes, largest: int) -> Table:
    import pandas as pd

    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _binary(source) from error
    if "\0" in text:
        raise _binary(source)
    counted = enumerate(io.StringIO(text, newline=None), start=1)
    lines = [(number, line) for number, line in counted if line.strip()]
    names, delimiter, numbered = _header(source, lines)
    unique(source, names)
    for number, line in numbered:
        if (cells := len(_cells(line, delimiter))) != len(names):
            raise problem(
                source,
                f"line {number} has {cells} cells, but the header has {len(names)}",
                "complete or remove that line",
            )
    rows = [line for _, line in numbered]
    if not rows:
        raise problem(source, "there is a header but no rows", "record or copy it again")
    frame = pd.read_csv(
        io.StringIO("".join(rows)),
        sep=delimiter or r"\s+",
        header=None,
        index_col=False,
        low_memory=False,
    )
    if len(frame) != len(rows):
        raise problem(source, "a quoted cell spans several rows", "remove its quotes")
    at = tuple(number for number, _ in numbered)
    return from_frame(source, frame.set_axis(names, axis="columns"), at)


def _binary(source: str) -> Exception:
    return problem(source, "is not UTF-8 text", "export it as plain text, or rename a binary file")


Numbered = list[tuple[int, str]]


def _header(source: str, lines: Numbered) -> tuple[list[str], str, Numbered]:
    """Column names, delimiter (empty for whitespace) and the lines below with their numbers."""
    comments = list(itertools.takewhile(_is_comment, (line for _, line in lines)))
    rows = [pair for pair in lines if not _is_comment(pair[1])]
    first = rows[0][1] if rows else ""
    delimiter = max(",;\t|", key=first.count)
    delimiter = delimiter if delimiter in first else ""
    if not first:
        raise problem(source, "there are no rows", "record or copy it again")
    if not all(is_number(cell) for cell in _cells(first, delimiter)):
        header, rows = first, rows[1:]
    # numpy.savetxt writes the header as a comment.
    elif comments:
        header = comments[-1].lstrip(" \t#")
    else:
        raise problem(
            source,
            "there is no header, the first line has numbers only",
            "add a first line of names, such as time,q_1,tau_1",
        )
    return [name.strip() for name in _cells(header, delimiter)], delimiter, rows


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _cells(line: str, delimiter: str) -> list[str]:
    if not delimiter:
        return line.split()
    if '"' not in line:
        return line.rstrip("\r\n").split(delimiter)
    return next(csv.reader([line], delimiter=delimiter))


def _parquet(source: str, data: bytes, largest: int) -> Table:
    parquet = require("pyarrow.parquet", "parquet")
    file = parquet.ParquetFile(io.BytesIO(data), page_checksum_verification=True)
    groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
    # A page with one value can encode any number of rows.
    cells = sum(group.num_rows for group in groups) * file.metadata.num_columns
    size = max(sum(group.total_byte_size for group in groups), 8 * cells)
    if size > largest:
        raise _too_large(source, size, largest)
    # pandas metadata could turn a column into an index.
    return from_frame(source, file.read().to_pandas(ignore_metadata=True))


def _mat(source: str, data: bytes, largest: int) -> Table:
    if data.startswith(b"MATLAB 7.3") or b"\x89HDF\r\n\x1a\n" in data[:1024]:
        raise problem(
            source,
            "is a MATLAB file of version 7.3 (HDF5)",
            "save it again in MATLAB with save(file, '-v7')",
        )
    order = order_of(data)
    if order is None:
        listed = _version_4(data)
    else:
        listed = list(variables(data, order, largest, lambda n: _too_large(source, n, largest)))
    unique(source, [name for name, _ in listed])
    refused = {name: f"{kind} variable" for name, kind in listed if isinstance(kind, str)}
    # MATLAB has no 1-d arrays: a vector is one row or one column.
    return Table(
        {n: x.ravel() if 1 in x.shape else x for n, x in listed if not isinstance(x, str)}, refused
    )


def _version_4(data: bytes) -> list[tuple[str, np.ndarray | str]]:
    """Variables of a MATLAB file of version 4, which has no compression."""
    import scipy

    # SciPy would read any other file as version 5, with fewer checks than `variables`.
    if 0 not in data[:4]:
        raise ValueError("it is of neither version 4 nor version 5")
    listed = scipy.io.whosmat(io.BytesIO(data))
    names = [name for name, _, kind in listed if kind != "sparse"]
    # An empty list of names would mean all of them.
    loaded = scipy.io.loadmat(io.BytesIO(data), variable_names=names) if names else {}
    return [(name, "sparse" if kind == "sparse" else loaded[name]) for name, _, kind in listed]
