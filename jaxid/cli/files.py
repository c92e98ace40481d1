"""Recordings that commands read, and results that they write."""

import json
import math
from pathlib import Path
from typing import Any

from ..errors import ModelError


def read_files(files: list[Path], column: list[str] | None, unit: list[str] | None) -> Any:
    """The recordings in files, read as the options `--column` and `--unit` say."""
    from ..recording import read

    named = _pairs(column, "column")
    columns = {k: v if k == "time" else v.split(",") for k, v in named.items()} if named else None
    return read(*files, columns=columns, units=_pairs(unit, "unit"))


def _pairs(given: list[str] | None, what: str) -> dict[str, str] | None:
    if not given:
        return None
    pairs = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not equals:
            raise ModelError(f"--{what} {item!r} has no '=': write for instance q=pos_1,pos_2")
        pairs[name.strip()] = value.strip()
    return pairs


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Writes a result where `--json` asks for it."""
    if path is not None:
        text = json.dumps(_plain(content), indent=1, ensure_ascii=False, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """The same with null for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_outputs(*paths: Path | None) -> None:
    """Says before the work, not after it, that a result would have nowhere to go."""
    for path in paths:
        if path is not None and not path.resolve().parent.is_dir():
            raise ModelError(f"there is no folder {path.parent} for {path.name}: make it first")
        if path is not None and path.is_dir():
            raise ModelError(f"{path} is a folder: name a file in it")
