"""The worlds benchmark: robots simulated by MuJoCo, with physics and laws that jaxid does not have.

Robots of one to three joints are drawn (planar, SCARA, polar, gantry, axis, pendulum, elbow) with
the friction's sign by tanh, a root, arctan or dry, a law held at 1 kHz from quantised encoders, and
noise that is white, coloured, heavy-tailed or in bursts. Outside the plain world there is something
else beside the hidden effect (see `_world_departures.py`). The user has a URDF whose bodies are
wrong by up to a quarter, and knows the law as sampled, takes it for continuous, or does not know
it.

python -m benchmarks.worlds [--seed N] [--quick] [--count 40] [--law unknown|sampled|continuous|any]
                            [--world NAME|any] [--robot NAME|any] [--effect NAME] [--joint N]
                            [--friction NAME ...] [--jobs 2] [--out DIR] [--json FILE] [--case N]
                            [--results FILE]
"""

import argparse
import json
import secrets
import tempfile
import time
import traceback
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from jaxid.storage.campaign import Campaign, Failed

from ._world_cases import (
    KINDS,
    LAWS,
    Case,
    Wanted,
    draw_wanted,
    make,
    read_case,
    start_model,
    unexplained,
)
from ._world_departures import WORLDS, describing
from ._world_physics import EFFECTS, FRICTIONS, LARGER, OUTSIDE, ROBOTS
from ._world_results import append, line_of, origin
from .hidden_effects import configure_jax, floor_percent

# An effect and its joint, from 1; None for those of the whole arm.
Key = tuple[str, int | None]


def run_case(wanted: Wanted, seed: int) -> dict[str, Any]:
    """Makes, solves and marks one case of the benchmark with this seed."""
    started = time.perf_counter()
    try:
        record = _solve(wanted)
    except Exception:
        record = {"error": traceback.format_exc()}
    seconds = time.perf_counter() - started
    return {"run": origin(seed), **asdict(wanted), **record, "seconds": seconds}


def _solve(wanted: Wanted) -> dict[str, Any]:
    case = make(wanted)
    with tempfile.TemporaryDirectory() as folder:
        fitting, held_out = read_case(Path(folder), case)
    started, cpu = time.perf_counter(), time.process_time()
    start = start_model(case, wanted.law)
    found = jaxid.discover(start, fitting, validate=held_out, progress=False)
    took = {"took": time.perf_counter() - started, "cpu": time.process_time() - cpu}
    story = found.to_dict()
    signals, along = case.recordings["held_out"], found.loop.controller.imposes
    noise = unexplained(signals, along_motion=along)
    floor = floor_percent(found.loop, noise, held_out)
    return {
        "truth": [
            {"effect": e.name, "joint": e.joint + 1, "size": e.size, **e.drawn} for e in case.hidden
        ],
        "strength": case.strength,
        "floor": floor.tolist(),
        "story": {**story, **took},
        "marks": judge(case, wanted, story, floor),
    }


def judge(case: Case, wanted: Wanted, story: dict[str, Any], floor: np.ndarray) -> dict[str, Any]:
    """The marks of a story.

    An effect is named if it was added, or shares the weight with an added one. One that describes
    the world is no further effect. If the law is taken for continuous, that is also true of a delay
    of a drive, which is that of the sampled law.
    """
    kind, law = wanted.kind, wanted.law
    true = [(e.name, e.joint + 1) for e in case.hidden]
    beside = describing(wanted.world, law)
    named = [
        (a, [(e["effect"], e["joint"]) for e in (a, *a["indistinguishable"])])
        for a in story["added"]
    ]
    kept = [(a, g) for a, g in named if g[0][0] not in beside or any(t in g for t in true)]
    groups = [group for _, group in kept]
    after = np.array(story["error_percent"]["after"]["validate"])
    ratio = float((after / floor).max())
    sure = story["verdict"] in ("adequate", "explained")
    marks: dict[str, Any] = {"verdict": story["verdict"], "ratio": ratio, "sure": sure}
    if law == "continuous":
        said = ("like a law that is sampled", "as if it is held from one sample to the next")
        marks["sampling_named"] = any(text in note for note in story["notes"] for text in said)
    if kind == "clean":
        return {**marks, "right": sure and not groups, "alarm": bool(groups)}
    if kind == "outside":
        return {**marks, "right": not sure, "recognised": story["verdict"] == "outside_catalogue"}
    marks |= names_right(groups, true)
    marks["wrong_and_sure"] = sum(
        not any(t in group for t in true) and (a["probability"] or 0) > 0.9 for a, group in kept
    )
    return {**marks, "right": all(marks["named"])}


def names_right(groups: Sequence[Sequence[Key]], true: Sequence[Key]) -> dict[str, Any]:
    """Whether the first name is right, which of the true effects are named, and the number of
    wrong names.

    **Arguments:**

    - `groups`: added effects, each with its indistinguishable alternatives.
    """
    return {
        "first": bool(groups) and groups[0][0] in true,
        "named": [any(t in group for group in groups) for t in true],
        "extra": sum(not any(t in group for t in true) for group in groups),
    }


def row(record: dict[str, Any]) -> str:
    """One line of the table."""
    head = f"{record['number']:3d} {record['law']:11s}{record['kind']:8s}{record['robot']:9s}"
    head += f"{record['world']:14s}{record['friction']:7s}{record['noise']:9s}"
    if "error" in record:
        return f"{head}ERROR {record['error'].strip().splitlines()[-1][:150]}"
    truth = " + ".join(f"{t['effect']}({t['joint']})" for t in record["truth"]) or "-"
    found = " + ".join(f"{a['effect']}({a['joint']})" for a in record["story"]["added"]) or "-"
    marks = record["marks"]
    state = (
        "ok" if marks["right"] and not marks.get("extra") else "part" if marks["right"] else "NO"
    )
    return (
        f"{head}{truth:44s}{state:5s}{marks['ratio']:7.2f}{record['story']['cpu']:6.0f} s  "
        f"{marks['verdict']}: {found}"
    )


def summary(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scores by law: (right, of)."""
    table: dict[str, Any] = {}
    for law in dict.fromkeys(r["law"] for r in records):
        done = [r for r in records if r["law"] == law and "marks" in r]
        of = {kind: [r["marks"] for r in done if r["kind"] == kind] for kind in KINDS}
        effects = [*of["single"], *of["double"]]
        named = [n for m in effects for n in m["named"]]
        sure = [r["marks"]["ratio"] for r in done if r["marks"]["sure"]]
        ratios = sorted(r["marks"]["ratio"] for r in done)
        table[law] = {
            "one effect: named": (sum(m["right"] for m in of["single"]), len(of["single"])),
            "one effect: first": (sum(m["first"] for m in of["single"]), len(of["single"])),
            "effects named, each counted": (sum(named), len(named)),
            "whole set named and nothing else": (
                sum(m["right"] and not m["extra"] for m in effects),
                len(effects),
            ),
            "with an addition that is wrong and sure": (
                sum(m["wrong_and_sure"] > 0 for m in effects),
                len(effects),
            ),
            "clean: left alone": (sum(m["right"] for m in of["clean"]), len(of["clean"])),
            "clean: something added": (sum(m["alarm"] for m in of["clean"]), len(of["clean"])),
            "outside: not called explained": (
                sum(m["right"] for m in of["outside"]),
                len(of["outside"]),
            ),
            "outside: recognised": (
                sum(m["recognised"] for m in of["outside"]),
                len(of["outside"]),
            ),
            "undetermined": (
                sum(r["marks"]["verdict"] == "undetermined" for r in done),
                len(done),
            ),
            "adequate or explained above 1.3 of the floor": (
                sum(x > 1.3 for x in sure),
                len(sure),
            ),
            "held out over floor, median and worst": (
                float(np.median(ratios)) if ratios else None,
                ratios[-3:],
            ),
            "CPU seconds, median": float(np.median([r["story"]["cpu"] for r in done] or [0])),
            "errors": [r["number"] for r in records if r["law"] == law and "error" in r],
        }
    return table


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="of everything; drawn anew if not given")
    parser.add_argument("--quick", action="store_true", help="two cases of one joint, plain")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--law", choices=(*LAWS, "any"), default="unknown")
    parser.add_argument("--world", choices=(*WORLDS, "any"), default="any")
    parser.add_argument("--robot", choices=(*ROBOTS, *LARGER, "any"), default="any")
    parser.add_argument("--effect", choices=(*EFFECTS, *OUTSIDE), help="the same in every case")
    parser.add_argument("--joint", type=int, help="joint of the effects, from 1; random by default")
    parser.add_argument("--friction", choices=FRICTIONS, nargs="+", default=FRICTIONS)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder in which a stopped run continues")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument(
        "--results", type=Path, help="file for a line of each case, as evidence.py reads them"
    )
    parser.add_argument("--case", type=int, action="append", help="only the case of this number")
    given = parser.parse_args(arguments)
    drawn = 1 if given.quick else secrets.randbits(31)
    seed = drawn if given.seed is None else given.seed
    laws = LAWS if given.law == "any" else (given.law,)
    count, robot, world = given.count, given.robot, given.world
    if given.quick:
        count, robot, world = 2, "axis", "plain"
    same: dict[str, Any] = {"robot": robot, "effect": given.effect, "joint": given.joint}
    same |= {"frictions": tuple(given.friction), "world": world}
    cases = draw_wanted(seed, count, laws, **same)
    cases = [w for w in cases if given.case is None or w.number in given.case]
    out = given.out or Path(tempfile.mkdtemp(prefix="worlds_"))
    print(f"seed {seed}, {len(cases)} cases, results in {out}", flush=True)
    configure_jax()
    records = []
    wanted = {case.label: case for case in cases}
    lines = nullcontext() if given.results is None else given.results.open("w", encoding="utf-8")
    with Campaign(out, {"seed": seed, **same}) as campaign, lines as file:
        for label, record in campaign.run(partial(run_case, seed=seed), wanted, jobs=given.jobs):
            if isinstance(record, Failed):
                failed = {"run": origin(seed), **asdict(wanted[label])}
                record = {**failed, "error": record.reason}
            print(row(record), flush=True)
            records.append(record)
            if file is not None:
                # Pieces of older folders have no dates.
                append(
                    file, line_of({"run": {"seed": seed, "date": None, "commit": None}, **record})
                )
    scores = summary(records)
    for law, lines in scores.items():
        print(f"\nlaw {law}")
        for name, value in lines.items():
            print(f"  {name:48s}{value}")
    if given.json is not None:
        content = {**origin(seed), "scores": scores, "cases": records}
        given.json.write_text(json.dumps(content, indent=1, default=float) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
