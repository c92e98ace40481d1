"""Other tools on the recordings of the worlds benchmark.

Stepwise regression, pysindy, gplearn, a Gaussian process and a small network explain the residual
of the rigid robot with friction (SciPy's filters, Pinocchio's regressor), on the recordings that
`benchmarks.worlds` makes from the same seed. Torque errors are in the band of an unknown law.

python -m benchmarks.baselines [--seed N] [--quick] [--count 40] [--world NAME|any] [--robot NAME]
                               [--tool NAME] [--jobs 1] [--out DIR] [--results FILE] [--json FILE]
                               [--case N]
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
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from jaxid.storage.campaign import Campaign, Failed

from ._baseline_rows import Motion, Table, residual, table_of
from ._baseline_tools import TOOLS, Found
from ._evidence_tables import by_tool
from ._world_cases import Case, Wanted, draw_wanted, make, read_case, start_model, unexplained
from ._world_departures import WORLDS, describing
from ._world_physics import LARGER, ROBOTS
from ._world_results import append, origin
from .hidden_effects import configure_jax, floor_percent
from .worlds import Key, names_right

LAW = "unknown"
NEEDED = ("gplearn", "pinocchio", "pysindy", "sklearn")


def run_case(wanted: Wanted, seed: int, tools: Sequence[str]) -> dict[str, Any]:
    """Makes one case of the benchmark with this seed, and runs every tool on it."""
    head = {"run": origin(seed), **asdict(wanted)}
    try:
        case = make(wanted)
        with tempfile.TemporaryDirectory() as folder:
            fitting, held_out = read_case(Path(folder), case)
        loop = start_model(case, LAW)
        noise = unexplained(case.recordings["held_out"], along_motion=True)
        floor = floor_percent(loop, noise, held_out)
        started = time.process_time()
        table = table_of(case.drawn, fitting)
        prepared = time.process_time() - started
        unseen = Motion.of(case.drawn, held_out[0])
        shared = {
            **head,
            "truth": [
                {"effect": e.name, "joint": e.joint + 1, "size": e.size} for e in case.hidden
            ],
            "strength": case.strength,
            "visible": visible(case, table),
            "floor": floor.tolist(),
        }
    except Exception:
        error = {"error": traceback.format_exc()}
        return {"lines": [{"tool": name, **head, **error} for name in tools]}
    lines = []
    for name in tools:
        try:
            answer = _asked(name, case, wanted, table, loop, held_out, unseen)
            answer["story"]["cpu"] += prepared
            answer["marks"]["ratio"] = float((np.array(_after(answer)) / floor).max())
        except Exception:
            answer = {"error": traceback.format_exc()}
        lines.append({"tool": name, **shared, **answer})
    return {"lines": lines}


def _asked(
    name: str,
    case: Case,
    wanted: Wanted,
    table: Table,
    loop: jaxid.ClosedLoop,
    held_out: jaxid.Recordings,
    unseen: Motion,
) -> dict[str, Any]:
    started = time.process_time()
    found = TOOLS[name](table, tuple(link.slides for link in case.robot.links), wanted.seed)
    cpu = time.process_time() - started
    errors = np.asarray(held_out[0].tau) - found.predict(unseen)
    after = floor_percent(loop, errors, held_out)
    added = [{"effect": effect, "joint": joint} for effect, joint in found.named]
    story = {"added": added, "error_percent": {"after": {"validate": after.tolist()}}, "cpu": cpu}
    return {"story": story, "marks": judge(case, wanted, found)}


def _after(answer: dict[str, Any]) -> list[float]:
    return answer["story"]["error_percent"]["after"]["validate"]


def judge(case: Case, wanted: Wanted, found: Found) -> dict[str, Any]:
    """The marks of a tool's answer.

    For a clean arm the right answer is that nothing is missing, or nothing but effects that
    describe the world. For an effect outside the catalogue it is right to name no other effect; the
    effect is recognised if the tool also reports that something is missing.
    """
    true: list[Key] = [(e.name, e.joint + 1) for e in case.hidden]
    beside = describing(wanted.world, LAW)
    named = [key for key in found.named if key in true or key[0] not in beside]
    marks: dict[str, Any] = {"missing": found.missing}
    if wanted.kind == "clean":
        alarm = found.missing and (bool(named) or not found.named)
        return {**marks, "right": not alarm, "alarm": alarm}
    if wanted.kind == "outside":
        return {**marks, "right": not named, "recognised": not named and found.missing}
    marks |= names_right([[key] for key in named], true)
    return {**marks, "right": all(marks["named"])}


def visible(case: Case, table: Table) -> list[float]:
    """The part of each effect's torque that the rigid robot cannot absorb, over the noise.

    Root mean squares over the rows of its joint, with the same low-pass for torque and noise. Two
    effects are taken separately.
    """
    found = []
    names = list(case.recordings)[: len(table.motions)]
    for effect, torques in zip(case.hidden, case.torques, strict=True):
        own = np.zeros((0, table.joints))
        noise = np.zeros((0, table.joints))
        for motion, name in zip(table.motions, names, strict=True):
            wave = np.zeros_like(motion.q)
            wave[:, effect.joint] = torques[name]
            own = np.concatenate([own, motion.thinned(wave)])
            rest = unexplained(case.recordings[name], along_motion=True)
            noise = np.concatenate([noise, motion.thinned(rest)])
        here = table.joint == effect.joint
        left = residual(table.base, table.rows(own))[here]
        found.append(float(np.linalg.norm(left) / np.linalg.norm(table.rows(noise)[here])))
    return found


def row(line: dict[str, Any]) -> str:
    """One line of the table."""
    head = f"{line['number']:3d} {line['kind']:8s}{line['robot']:9s}{line['tool']:20s}"
    if "error" in line:
        return f"{head}ERROR {line['error'].strip().splitlines()[-1][:150]}"
    truth = " + ".join(f"{t['effect']}({t['joint']})" for t in line["truth"]) or "-"
    found = " + ".join(f"{a['effect']}({a['joint']})" for a in line["story"]["added"]) or "-"
    marks = line["marks"]
    state = "ok" if marks["right"] else "NO"
    return f"{head}{truth:44s}{state:5s}{marks['ratio']:7.2f}{line['story']['cpu']:6.1f} s  {found}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="of everything; drawn anew if not given")
    parser.add_argument("--quick", action="store_true", help="two cases of one joint, plain")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--world", choices=(*WORLDS, "any"), default="any")
    parser.add_argument("--robot", choices=(*ROBOTS, *LARGER, "any"), default="any")
    parser.add_argument("--tool", choices=tuple(TOOLS), action="append", help="only this one")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder in which a stopped run continues")
    parser.add_argument("--results", type=Path, help="file for a line of each case and tool")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--case", type=int, action="append", help="only the case of this number")
    given = parser.parse_args(arguments)
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise SystemExit(f"{', '.join(missing)} not found: install the extra `baselines`")
    drawn = 1 if given.quick else secrets.randbits(31)
    seed = drawn if given.seed is None else given.seed
    count, robot, world = given.count, given.robot, given.world
    if given.quick:
        count, robot, world = 2, "axis", "plain"
    tools = tuple(given.tool or TOOLS)
    cases = draw_wanted(seed, count, (LAW,), robot, world=world)
    wanted = {w.label: w for w in cases if given.case is None or w.number in given.case}
    out = given.out or Path(tempfile.mkdtemp(prefix="baselines_"))
    print(f"seed {seed}, {len(wanted)} cases, results in {out}", flush=True)
    configure_jax()
    work = partial(run_case, seed=seed, tools=tools)
    file = nullcontext() if given.results is None else given.results.open("w", encoding="utf-8")
    records: list[dict[str, Any]] = []
    plan = {"seed": seed, "robot": robot, "world": world, "tools": list(tools)}
    with Campaign(out, plan) as campaign, file as written:
        for label, record in campaign.run(work, wanted, jobs=given.jobs):
            if isinstance(record, Failed):
                failed = {"run": origin(seed), **asdict(wanted[label]), "error": record.reason}
                record = {"lines": [{"tool": name, **failed} for name in tools]}
            for line in record["lines"]:
                print(row(line), flush=True)
                records.append(line)
                if written is not None:
                    append(written, line)
    print("\n" + by_tool(records).to_string())
    if given.json is not None:
        content = {**origin(seed), "lines": records}
        given.json.write_text(json.dumps(content, indent=1, default=float) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
