"""Result files of the worlds benchmark: a line of JSON for each case, with its origin."""

import json
import math
import subprocess
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

# Fields of a story that a result file keeps, in addition to the probabilities.
_KEPT = (
    "verdict",
    "reason",
    "added",
    "removed",
    "depends_on",
    "error_percent",
    "noise_floor_percent",
    "took",
    "cpu",
)


def origin(seed: int) -> dict[str, Any]:
    """Seed of the benchmark, date (UTC) and commit of the running code; the commit ends in `-dirty`
    if files were changed, and is None outside a checkout."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        ran = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    except OSError:
        ran = None
    commit = ran.stdout.strip() if ran is not None and ran.returncode == 0 else None
    return {"seed": seed, "date": datetime.now(UTC).date().isoformat(), "commit": commit}


def probabilities(models: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The probability of every effect of a story, among its models without a free-form curve."""
    total: dict[tuple[str, int | None], float] = {}
    plain = [m for m in models if not m["curve"]]
    best = min(m["difference"] for m in plain)
    weights = [math.exp(-0.5 * (m["difference"] - best)) for m in plain]
    for model, weight in zip(plain, weights, strict=True):
        for key in {(e["effect"], e["joint"]) for e in model["effects"]}:
            total[key] = total.get(key, 0.0) + weight / sum(weights)
    ranked = sorted(total.items(), key=lambda pair: -pair[1])
    # Models of negligible weight would fill most of the file.
    return [
        {"effect": name, "joint": joint, "probability": min(weight, 1.0)}
        for (name, joint), weight in ranked
        if weight > 1e-3
    ]


def line_of(record: dict[str, Any]) -> dict[str, Any]:
    """A case of jaxid for a result file: marks and answer, without tables of models."""
    if "story" not in record:
        return {"tool": "jaxid", **record}
    story = record["story"]
    kept = {name: story[name] for name in _KEPT if name in story}
    kept["probabilities"] = probabilities(story["models"])
    return {"tool": "jaxid", **record, "story": kept}


def append(file: TextIO, line: dict[str, Any]) -> None:
    """Writes a line immediately; a stopped run keeps its finished cases."""
    file.write(json.dumps(line, ensure_ascii=False, default=float) + "\n")
    file.flush()


def read_lines(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """The lines of result files, of any tools.

    **Raises:** `ValueError` for a line that is not a case.
    """
    found = []
    for path in paths:
        for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            try:
                line = json.loads(text)
                line["tool"], line["run"]["seed"], line["number"]
                # Files of the first runs have the plain world only.
                line.setdefault("world", "plain")
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"{path.name}, line {number}: no case of a result file ({error!r}); give files "
                    "that --results of benchmarks.worlds or benchmarks.baselines wrote"
                ) from error
            found.append(line)
    return found
