"""LeRobot datasets: Parquet files of frames, whose episodes are recordings.

Layout as in versions 2 and 3 of Hugging Face's LeRobotDataset: `meta/info.json` names features,
`data/**/*.parquet` holds frames with `episode_index` and `timestamp`.
"""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import require
from ._checks import numeric
from ._problem import problem
from ._table import Table, from_frame

if TYPE_CHECKING:
    import pandas as pd

_EPISODE = re.compile(r"episode_(\d+)")
# Names of features, and the endings of names if one feature holds several signals.
_CALLED = {
    "q": ("observation.state",),
    "v": ("observation.velocity",),
    "tau": ("observation.effort", "observation.torque"),
    "q_ref": ("action",),
}
_ENDINGS = {"q": (".pos",), "v": (".vel",), "tau": (".torque", ".effort"), "q_ref": (".pos",)}


def lerobot_folder(path: Path) -> tuple[Path, int | None] | None:
    """Folder of a dataset and the episode, from a path FOLDER or FOLDER/episode_3."""
    match = _EPISODE.fullmatch(path.name)
    if (path / "meta" / "info.json").is_file():
        return path, None
    if match and (path.parent / "meta" / "info.json").is_file():
        return path.parent, int(match[1])
    return None


def episodes(
    source: str,
    folder: Path,
    only: int | None,
    largest: int,
    refuse: Callable[[int], Exception],
) -> Iterator[tuple[str, Table]]:
    """Name and table of each episode.

    **Arguments:**

    - `folder`, `only`: from `lerobot_folder`.
    - `largest`: most bytes to read; `refuse` makes the error for more.

    **Raises:** `RecordingError` for an inconsistent dataset, or one without such an episode;
        `MissingExtraError` without the extra `parquet`.
    """
    told = _info(source, folder)
    frame = _frames(source, folder, told["features"], largest, refuse)
    frame.columns = [str(name) for name in frame.columns]
    if "episode_index" not in frame:
        raise problem(source, "its frames have no episode_index", "write the dataset again")
    there = sorted(int(k) for k in frame["episode_index"].unique())
    if only is not None and only not in there:
        raise problem(
            source,
            f"there is no episode {only}",
            f"choose one of {there[0]} to {there[-1]}",
        )
    for episode in there if only is None else [only]:
        part = frame.loc[frame["episode_index"] == episode].reset_index(drop=True)
        yield f"episode_{episode}", _table(source, part, told)


def _info(source: str, folder: Path) -> dict[str, Any]:
    try:
        told = json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))
        features = {str(k): dict(v) for k, v in told["features"].items()}
        rate = float(told.get("fps") or 0)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise problem(
            source,
            f"meta/info.json does not describe features ({type(error).__name__}: {error})",
            "write or copy the dataset again",
        ) from error
    return {"features": features, "fps": rate}


def _frames(
    source: str,
    folder: Path,
    features: dict[str, Any],
    largest: int,
    refuse: Callable[[int], Exception],
) -> "pd.DataFrame":
    parquet = require("pyarrow.parquet", "parquet")
    files = sorted((folder / "data").rglob("*.parquet"))
    if not files:
        raise problem(
            source, "there is no Parquet file in data", "download the dataset's data folder"
        )
    numbers = {n for n, f in features.items() if f.get("dtype") not in ("image", "video", "string")}
    numbers |= {"episode_index", "timestamp", "frame_index"}
    frames, size = [], 0
    for path in files:
        file = parquet.ParquetFile(path, page_checksum_verification=True)
        groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
        chunks = [g.column(c) for g in groups for c in range(g.num_columns)]
        wanted = [c for c in chunks if c.path_in_schema.removesuffix(".list.element") in numbers]
        # A page with one value can encode any number of rows.
        size += sum(max(c.total_uncompressed_size, 8 * c.num_values) for c in wanted)
        if size > largest:
            raise refuse(size)
        names = [name for name in file.schema_arrow.names if name in numbers]
        frames.append(file.read(columns=names).to_pandas(ignore_metadata=True))
    import pandas as pd

    return pd.concat(frames, ignore_index=True)


def _table(source: str, frame: "pd.DataFrame", told: dict[str, Any]) -> Table:
    """Columns of an episode: each feature as a whole, and each of its parts by name."""
    columns = dict(from_frame(source, frame).columns)
    names, about = {}, []
    for key, feature in told["features"].items():
        if key not in columns:
            continue
        listed = _names(feature.get("names"))
        values = numeric(source, key, columns[key])
        about.append(f"{key}: {', '.join(listed) or 'x'.join(map(str, values.shape[1:])) or 'one'}")
        if values.ndim != 2 or not listed:
            continue
        if len(listed) != values.shape[1]:
            raise problem(
                source,
                f"meta/info.json names {len(listed)} parts of {key}, but it has {values.shape[1]}",
                "correct the names there",
            )
        columns |= {f"{key}.{n}": values[:, k] for k, n in enumerate(listed)}
        names[key] = listed
    columns["time"] = _time(columns, told["fps"])
    defaults = _defaults(names, columns)
    return Table(columns, defaults=defaults, ordered=True, about=tuple(about))


def _names(given: Any) -> list[str]:
    """Names of a feature's parts, given as a list or as a list under the name of an axis."""
    if isinstance(given, dict):
        given = next((v for v in given.values() if isinstance(v, list)), None)
    if isinstance(given, list) and len(given) == 1 and isinstance(given[0], list):
        given = given[0]
    return [str(name) for name in given] if isinstance(given, list) else []


def _time(columns: dict[str, Any], rate: float) -> Any:
    """Times; from the frame numbers if these agree, because files keep only seven digits."""
    time = columns.get("timestamp")
    if time is None or rate <= 0 or "frame_index" not in columns:
        return time
    exact = np.asarray(columns["frame_index"], dtype=np.float64) / rate
    stored = np.asarray(time, dtype=np.float64)
    return exact if np.allclose(stored, exact, rtol=1e-6, atol=1e-9) else time


def _defaults(names: dict[str, list[str]], columns: dict[str, Any]) -> dict[str, dict[str, str]]:
    """Columns by signal and joint."""
    found: dict[str, dict[str, str]] = {}
    for signal, keys in _CALLED.items():
        # The state may contain velocities and torques in addition to positions.
        for key in (*keys, *(("observation.state",) if signal in ("v", "tau") else ())):
            joints = _joints(names.get(key, []), signal, own=key in keys)
            if joints:
                found[signal] = {joint: f"{key}.{name}" for joint, name in joints.items()}
                break
    if found.get("q_ref", {}).keys() != found.get("q", {}).keys():
        found.pop("q_ref", None)
    return {signal: by_joint for signal, by_joint in found.items() if by_joint}


def _joints(listed: list[str], signal: str, own: bool) -> dict[str, str]:
    """Parts of a feature that belong to a signal, by joint name."""
    endings = _ENDINGS[signal]
    any_ending = tuple(e for several in _ENDINGS.values() for e in several)
    ended = {n.removesuffix(e): n for n in listed for e in endings if n.endswith(e)}
    if ended or not own:
        return ended
    return {name: name for name in listed if not name.endswith(any_ending)}
