"""Benchmark of hidden effects: random effects, found by `jaxid.discover`, compared with the truth.

python -m benchmarks.hidden_effects [--seed N] [--quick] [--json FILE] [--jobs 2] [--out DIR]
                                    [--robot scara|two_link|axis|any] [--law known|unknown]
"""

import argparse
import json
import os
import secrets
import tempfile
import time
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from jaxid.parameters import list_parameters
from jaxid.simulation.batch import compared
from jaxid.storage.campaign import Campaign, Failed
from tests import independent as sim

from . import stepwise
from ._hidden_cases import KINDS, ROBOTS, Wanted, build, draw_wanted, read_case, start_model
from ._hidden_marks import failed, judge, row, show_failure, show_summary, summary
from ._hidden_truth import chi_squared, hidden_in_base, same, true_key, visible


def run_case(wanted: Wanted) -> dict[str, Any]:
    """Makes, solves and marks one case."""
    started = time.perf_counter()
    try:
        record = _solve(wanted)
    except Exception:
        record = {"error": traceback.format_exc()}
    return {**asdict(wanted), **record, "seconds": time.perf_counter() - started}


def _solve(wanted: Wanted) -> dict[str, Any]:
    case = build(wanted)
    with tempfile.TemporaryDirectory() as folder:
        fitting, held_out = read_case(Path(folder), case)
    started, cpu = time.perf_counter(), time.process_time()
    start = start_model(case, wanted.law)
    found = jaxid.discover(start, fitting, validate=held_out, progress=False)
    took = {"took": time.perf_counter() - started, "cpu": time.process_time() - cpu}
    story = {**found.to_dict(), **took}
    noise = case.recordings["held_out"]["noise"]
    marks = judge(case, wanted.kind, story, floor_percent(found.loop, noise, held_out))
    record = {"truth": sim.truth(case), "marks": marks, "story": story}
    record["truth"]["classes"] = [type(e).__name__ for e in case.effects]
    steps = range(len(found.steps))
    record["steps"] = [_seen(found, k, case, held_out, wanted.law) for k in steps]
    record["stepwise"] = _stepwise_marks(case, wanted.kind, fitting)
    record["failed"] = failed(wanted.kind, marks)
    if record["failed"] and wanted.law == "known":
        if wanted.kind in ("single", "double"):
            record["oracle"] = visible(case, fitting, held_out, found.steps[0].fit)
        elif wanted.kind == "outside":
            record["oracle"] = hidden_in_base(case)
    return record


def floor_percent(
    loop: jaxid.ClosedLoop, noise: np.ndarray, held_out: jaxid.Recordings
) -> np.ndarray:
    """Relative error of the held-out recording due to noise, by joint, in the compared band, %.

    **Arguments:**

    - `noise`: noise of the recorded torque, `(samples, joints)`, N·m or N.
    """
    left, torque = (compared(loop, held_out, [x])[0] for x in (noise, np.asarray(held_out[0].tau)))
    return 100 * np.linalg.norm(left, axis=0) / np.linalg.norm(torque, axis=0)


def _seen(
    found: jaxid.Discovery, k: int, case: sim.Case, held_out: jaxid.Recordings, law: str
) -> dict[str, Any]:
    """Details of a step of the story, for the analysis of failures."""
    step = found.steps[k]

    def line(verdict: Any) -> dict[str, Any]:
        effect = verdict.hypothesis.effect
        shapes = {
            p.name: np.asarray(p.where(effect)).tolist()
            for p in list_parameters(effect)
            if p.declaration.free and not p.declaration.linear
        }
        return {
            "name": getattr(effect, "label", verdict.hypothesis.name),
            "joint": verdict.hypothesis.joint,
            "evidence": verdict.evidence,
            "p": verdict.p_value,
            "possible": verdict.possible,
            "shape": shapes,
        }

    values = dict(zip(step.fit.names, step.fit.theta.tolist(), strict=True))
    return {
        "label": step.label,
        "status": step.fit.status.name,
        "theta": values,
        # The true noise is not restricted to a band.
        "chi_squared": chi_squared(case, step.fit, held_out) if law == "known" else None,
        "ranking": [line(v) for v in (step.diagnosis.ranking[:8] if step.diagnosis else ())],
        "where": [line(v) for v in (step.diagnosis.where[:4] if step.diagnosis else ())],
        "contenders": [
            {"name": name, "joint": joint, "criterion": m.score, "status": m.status}
            for m in (found.contenders(k) if k else ())
            for name, joint in m.names[-1:]
        ],
    }


def _stepwise_marks(case: sim.Case, kind: str, fitting: jaxid.Recordings) -> dict[str, Any]:
    first = stepwise.first_effect(start_model(case), fitting)
    if kind == "clean":
        return {"first": first, "right": first is None}
    true = [true_key(e) for e in case.effects]
    right = kind != "outside" and first is not None and any(same(first, t) for t in true)
    return {"first": first, "right": right}


def configure_jax() -> None:
    """One thread for each worker; compiled programs are kept between workers and runs."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxid-bench"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def settle(
    out: Path, seed: int | None, quick: bool, robot: str, law: str
) -> tuple[int, bool, str, str]:
    """The run that a folder already contains, or a new one, which is noted there."""
    note = out / "bench.json"
    if note.exists():
        had = json.loads(note.read_text(encoding="utf-8"))
        if seed is not None and seed != had["seed"]:
            raise SystemExit(f"{out} holds a run of seed {had['seed']}: give another folder")
        return had["seed"], had["quick"], had["robot"], had["law"]
    seed = secrets.randbits(31) if seed is None else seed
    out.mkdir(parents=True, exist_ok=True)
    content = json.dumps({"seed": seed, "quick": quick, "robot": robot, "law": law})
    note.write_text(content + "\n", encoding="utf-8")
    return seed, quick, robot, law


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="of everything; drawn anew if not given")
    parser.add_argument("--quick", action="store_true", help="six cases")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder in which a stopped run goes on")
    parser.add_argument("--robot", choices=(*ROBOTS, "any"), default="scara")
    parser.add_argument("--law", choices=("known", "unknown"), default="known")
    parser.add_argument("--only", choices=KINDS, help="cases of one kind")
    parser.add_argument("--case", type=int, action="append", help="only the case of this number")
    given = parser.parse_args(arguments)
    out = given.out or Path(tempfile.mkdtemp(prefix="hidden_effects_"))
    seed, quick, robot, law = settle(out, given.seed, given.quick, given.robot, given.law)
    cases = [w for w in draw_wanted(seed, quick, robot, law) if given.only in (None, w.kind)]
    cases = [w for w in cases if given.case is None or w.number in given.case]
    print(f"seed {seed}, {robot}, law {law}, {len(cases)} cases, results in {out}", flush=True)
    configure_jax()
    with Campaign(out, {"seed": seed, "quick": quick}) as campaign:
        records = list(_all(cases, campaign, given.jobs))
    result = summary(records)
    print()
    show_summary(result)
    for record in records:
        if record.get("failed", True):
            show_failure(record)
    if given.json is not None:
        content = {"seed": seed, **result, "cases": records}
        given.json.write_text(json.dumps(content, indent=1, default=float) + "\n", encoding="utf-8")


def _all(cases: Sequence[Wanted], campaign: Campaign, jobs: int) -> Iterable[dict[str, Any]]:
    """Stored cases first, then the others as they finish."""
    wanted = {case.label: case for case in cases}
    for label, record in campaign.run(run_case, wanted, jobs=jobs):
        if isinstance(record, Failed):
            record = {**asdict(wanted[label]), "error": record.reason}
        print(row(record), flush=True)
        yield record


if __name__ == "__main__":
    main()
