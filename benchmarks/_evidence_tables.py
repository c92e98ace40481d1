"""Tables from result files: scores by tool and by world, and calibration of probabilities."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from ._world_departures import describing

Line = dict[str, Any]
Count = tuple[int, int]
# Tools that do not name effects.
NAMELESS = ("rigid", "Gaussian process", "network")
# Bounds of the probabilities of added effects.
CLAIMS = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)
# Smallest probability of an effect that the models of an answer share.
_LIKELY = 0.05
WORLDS = ("world", "friction", "noise", "robot", "law")


def interval(right: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share, %."""
    low, high = stats.binomtest(right, of).proportion_ci(method="wilson")
    return 100 * low, 100 * high


def share(count: Count) -> str:
    """A share with its 95 % interval, as text."""
    right, of = count
    if of == 0:
        return "–"
    low, high = interval(right, of)
    return f"{right} of {of} ({low:.0f} to {high:.0f} %)"


def counts(lines: Sequence[Line]) -> dict[str, Count]:
    """Numbers of correct answers and of cases in one tool's lines; errors count as wrong."""
    of = {k: [x for x in lines if x["kind"] == k] for k in ("single", "double", "clean", "outside")}
    effects = [*of["single"], *of["double"]]
    named = [n for x in effects for n in x.get("marks", {}).get("named", [False] * _size(x))]

    def count(some: Sequence[Line], mark: Callable[[Line], bool]) -> Count:
        return sum("marks" in x and mark(x["marks"]) for x in some), len(some)

    return {
        "one effect: named": count(of["single"], lambda m: m["right"]),
        "one effect: named first": count(of["single"], lambda m: m["first"]),
        "effects named": (sum(named), len(named)),
        "whole set, nothing else": count(effects, lambda m: m["right"] and not m["extra"]),
        "clean: left alone": count(of["clean"], lambda m: m["right"]),
        "clean: nothing wrong added": count(of["clean"], lambda m: not m["alarm"]),
        "outside: no wrong name taken for it": count(of["outside"], lambda m: m["right"]),
        "outside: recognised": count(of["outside"], lambda m: m["recognised"]),
    }


def _size(line: Line) -> int:
    return len(line["effects"])


def row_of(lines: Sequence[Line]) -> dict[str, str]:
    """One row of a table: counts with intervals, held-out error over floor, and CPU seconds."""
    tool = lines[0]["tool"]
    row = {name: _cell(tool, name, count) for name, count in counts(lines).items()}
    done = [x for x in lines if "marks" in x]
    row["held out over floor: median, 95th percentile"] = "–"
    row["CPU s, median"] = "–"
    if done:
        ratios = np.array([x["marks"]["ratio"] for x in done])
        middle, high = np.percentile(ratios, [50, 95])
        row["held out over floor: median, 95th percentile"] = f"{middle:.2f}, {high:.2f}"
        row["CPU s, median"] = f"{np.median([x['story']['cpu'] for x in done]):.1f}"
    row["errors"] = str(len(lines) - len(done))
    return row | _verdicts(lines) if tool == "jaxid" else row


def _cell(tool: str, name: str, count: Count) -> str:
    if tool == "rigid":
        return "does not say"
    asks_names = not name.startswith("clean") and name != "outside: recognised"
    return "cannot name" if tool in NAMELESS and asks_names else share(count)


def _verdicts(lines: Sequence[Line]) -> dict[str, str]:
    """Scores that only a tool with verdicts and probabilities has."""
    done = [x for x in lines if "marks" in x]
    effects = [x for x in done if x["kind"] in ("single", "double")]
    sure = [x["marks"]["ratio"] for x in done if x["marks"]["sure"]]
    wrong = sum(x["marks"]["wrong_and_sure"] > 0 for x in effects)
    sizes = [
        1 + len(added["indistinguishable"])
        for x in effects
        for added in x["story"]["added"]
        if any(key in _true(x) for key in _group(added))
    ]
    undetermined = sum(x["marks"]["verdict"] == "undetermined" for x in done)
    likely = [found for x in effects for found in _named_or_likely(x)]
    return {
        f"effects named, or with a probability above {_LIKELY:g}": share(
            (sum(likely), len(likely))
        ),
        "an addition wrong, of probability above 0.9": share((wrong, len(effects))),
        "undetermined": share((undetermined, len(done))),
        "called adequate or explained above 1.3 of the floor": share(
            (sum(ratio > 1.3 for ratio in sure), len(sure))
        ),
        "held out over floor, worst of these": f"{max(sure):.2f}" if sure else "–",
        "names in the group of a right addition: median, most": (
            f"{np.median(sizes):.0f}, {max(sizes)}" if sizes else "–"
        ),
    }


def _named_or_likely(line: Line) -> list[bool]:
    """Whether each hidden effect is named, or part of models with a share of the weight."""
    rivals = line["story"].get("probabilities", ())
    likely = {(e["effect"], e["joint"]) for e in rivals if e["probability"] > _LIKELY}
    named = zip(_true(line), line["marks"]["named"], strict=True)
    return [was_named or key in likely for key, was_named in named]


def _true(line: Line) -> list[tuple[str, int]]:
    return [(t["effect"], t["joint"]) for t in line.get("truth", ())]


def _group(added: dict[str, Any]) -> list[tuple[str, int | None]]:
    """An added effect with its indistinguishable alternatives."""
    return [(e["effect"], e["joint"]) for e in (added, *added["indistinguishable"])]


def by_tool(lines: Iterable[Line]) -> pd.DataFrame:
    """Scores, with a column for each tool."""
    return _grouped(list(lines), lambda x: x["tool"])


def by_world(lines: Iterable[Line], world: str) -> pd.DataFrame:
    """Scores of one tool's lines, with a column for each value of a property of the worlds."""
    return _grouped(list(lines), lambda x: x[world])


def _grouped(lines: Sequence[Line], key: Callable[[Line], str]) -> pd.DataFrame:
    groups = {name: [x for x in lines if key(x) == name] for name in dict.fromkeys(map(key, lines))}
    return pd.DataFrame({name: row_of(group) for name, group in groups.items()}).fillna("–")


def calibration(lines: Iterable[Line]) -> pd.DataFrame:
    """Share of added effects that were hidden, by their probability.

    An effect also counts as in its group if one that shares the weight with it was hidden. Effects
    that describe the world beside the hidden ones are left out.
    """
    claims: list[tuple[float, bool, bool]] = []
    for line in lines:
        true = _true(line)
        for added in line.get("story", {}).get("added", ()):
            keys = _group(added)
            beside = keys[0][0] in describing(line["world"], line["law"])
            if added["probability"] is not None and (any(k in true for k in keys) or not beside):
                claims.append((added["probability"], keys[0] in true, any(k in true for k in keys)))
    rows = {}
    for low, high in pairwise(CLAIMS):
        last = high == CLAIMS[-1]
        # Upper bounds belong to the next row, except a probability of one.
        within = [c for c in claims if low <= c[0] < high or (last and c[0] >= high)]
        label = (
            f"above {low:g}" if last else f"below {high:g}" if low == 0 else f"{low:g} to {high:g}"
        )
        mean = f"{np.mean([c[0] for c in within]):.3f}" if within else "–"
        rows[label] = {
            "mean of them": mean,
            "there": share((sum(c[1] for c in within), len(within))),
            "there, or in its group": share((sum(c[2] for c in within), len(within))),
        }
    return pd.DataFrame.from_dict(rows, orient="index")
