"""Recordings that commands read, and results that they write."""

import itertools
import json
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx

from ..errors import ModelError, RecordingError, near


class ReadOptions(eqx.Module):
    """Options that describe the contents of files and how they are read."""

    column: list[str] | None = None
    unit: list[str] | None = None
    log: Path | None = None
    gaps: str | None = None
    clock: str | None = None
    drop_nan: bool = False

    def told(self) -> dict[str, Any]:
        """Arguments of `jaxid.read` other than files, from the description and the options.

        **Raises:** `ModelError` for a description or an option that cannot be understood.
        """
        told = {} if self.log is None else described(self.log)
        told["columns"] = told.get("columns", {}) | _several(_pairs(self.column, "column"))
        told["units"] = told.get("units", {}) | _several(_pairs(self.unit, "unit"))
        told |= {} if self.gaps is None else {"gaps": self.gaps}
        told |= {} if self.clock is None else {"clock": self.clock}
        if self.drop_nan:
            told["nan"] = "drop"
        return {key: value for key, value in told.items() if value != {}}

    def __call__(self, files: Sequence[Path]) -> Any:
        """The recordings in files.

        **Raises:** `RecordingError` or `ModelError` if a file cannot be read.
        """
        from ..recording import read

        return read(*files, **self.told())

    def fitted(self, files: Sequence[Path]) -> Any:
        """The recordings in files that are to be fitted.

        **Raises:** `RecordingError` or `ModelError` for what cannot be read, or is there twice.
        """
        recordings = self(files)
        for one, other in itertools.combinations(recordings, 2):
            if one.same_samples(other):
                raise RecordingError(
                    f"{one.name} and {other.name} have the same samples: name each recording "
                    "once, since a copy makes deviations too small"
                )
        return recordings


def described(path: Path) -> dict[str, Any]:
    """The description of logs in a TOML file, by the argument names of `jaxid.read`.

    **Raises:** `ModelError` for a file with other contents.
    """
    known: dict[str, Any] = {"columns": dict, "units": dict, "scale": dict, "joints": list}
    known |= {"resolution": (int, float, list), "gaps": str, "nan": str, "clock": str}
    try:
        told = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ModelError(f"there is no file {path}: jaxid inspect --write creates one") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"{path} is not valid TOML ({error}): correct that line") from error
    for key, value in told.items():
        if not isinstance(value, known.get(key, ())):
            raise ModelError(
                f"{path} has an unexpected {key!r}{near(key, known)}: allowed are the tables "
                "[columns], [units] and [scale], the lists joints and resolution, and gaps = "
                '"allow", nan = "drop" and clock = "even"'
            )
    return told


def _several(named: dict[str, str] | None) -> dict[str, Any]:
    """The values, with comma-separated ones split into one item per joint."""
    return {
        name: value.split(",") if "," in value else value for name, value in (named or {}).items()
    }


def _pairs(given: list[str] | None, what: str) -> dict[str, str] | None:
    if not given:
        return None
    pairs = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not equals:
            raise ModelError(f"--{what} {item!r} has no '=': write, for example, q=pos_1,pos_2")
        pairs[name.strip()] = value.strip()
    return pairs


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Writes a result where `--json` asks for it."""
    if path is not None:
        text = json.dumps(_plain(content), indent=1, ensure_ascii=False, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """The same value with null for numbers that JSON cannot represent."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_outputs(*paths: Path | None) -> None:
    """Checks before the computation that results can be written."""
    for path in paths:
        if path is not None and not path.resolve().parent.is_dir():
            raise ModelError(f"there is no folder {path.parent} for {path.name}: create it first")
        if path is not None and path.is_dir():
            raise ModelError(f"{path} is a folder: name a file in it")
