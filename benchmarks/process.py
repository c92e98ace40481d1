"""The benefit of each setting that jaxid makes in its process: compilation time and run time.

Every row is a separate process without a cache of compiled programs. `first_s` is the processor
time of a first call over all threads, including tracing and compilation. `run_ms` is the wall-clock
time of a later call. Both are the smallest of several processes run in turns; `first` and `run` are
the ratios to jaxid's own settings.

python -m benchmarks.process [--quick] [--json FILE]
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import pandas as pd

import jaxid
from jaxid.estimate.minimise.problem import point_around
from jaxid.simulation.batch import prepare

from ._output import options, report
from ._problem import cad, interleaved, machine, problem, recordings, truth

# Environment variables that disable one setting, the other, or both.
OPTIONS = (
    "--xla_backend_optimization_level=3 --xla_cpu_use_fusion_emitters=true "
    "--xla_cpu_parallel_codegen_split_count=32"
)
SETTINGS: dict[str, dict[str, str]] = {
    "as jaxid sets them": {},
    "loop threshold off": {"JAXID_SET_XLA_FLAGS": "0"},
    "options off": {"XLA_FLAGS": OPTIONS},
    "both off": {"JAXID_SET_XLA_FLAGS": "0", "XLA_FLAGS": OPTIONS},
}


def measure(seconds: float, budget: float, diagnosed: bool) -> None:
    """Prints the times of this process as JSON, by task.

    **Arguments:**

    - `seconds`: length of each of two recordings. `budget`: seconds for the runs of each task.
    - `diagnosed`: whether a diagnosis is among the tasks; it compiles more than all others.
    """
    recs = recordings(2, seconds)
    batch = prepare(cad(), recs)
    posed, theta = problem(cad(), batch), truth().theta
    start = jnp.concatenate([batch.q0, batch.v0], axis=1)
    tasks: dict[str, Callable[[], Any]] = {
        "simulation": lambda: [run.tau for run in jaxid.simulate(cad(), recs)],
        "Jacobian": lambda: point_around(posed, theta, start),
        "whole fit": lambda: jaxid.fit(cad(), recs).theta,
    }
    if diagnosed:
        found_fit = jaxid.fit(cad(), recs)
        tasks["diagnosis"] = lambda: jaxid.diagnose(found_fit)
    found = {}
    for task, fun in tasks.items():
        # Each is timed like the first of its process; programs of the others are cleared.
        jax.clear_caches()
        started = time.process_time()
        jax.block_until_ready(fun())
        first = time.process_time() - started
        run = interleaved({task: fun}, budget, most=30)[task]
        found[task] = {"first_s": first, "run_ms": 1e3 * run}
    print(json.dumps(found))


def with_settings(
    setting: str, seconds: float, budget: float, diagnosed: bool
) -> dict[str, dict[str, float]]:
    """The measurements of a new process with these settings."""
    ours = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAXID_SET_XLA_FLAGS")}
    code = f"from benchmarks.process import measure; measure({seconds}, {budget}, {diagnosed})"
    out = subprocess.run(
        [sys.executable, "-c", code],
        env=ours | SETTINGS[setting] | {"JAX_ENABLE_COMPILATION_CACHE": "false"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout
    return json.loads(out.splitlines()[-1])


def main() -> None:
    args = options(__doc__)
    seconds, budget, turns = (2.0, 0.5, 1) if args.quick else (20.0, 2.0, 4)
    found = [
        {"task": task, "setting": setting, **times}
        for _ in range(turns)
        for setting in SETTINGS
        for task, times in with_settings(setting, seconds, budget, not args.quick).items()
    ]
    keys = ["task", "setting"]
    best = (
        pd.DataFrame(found)
        .groupby(keys, sort=False)
        .min()
        .sort_index(level="task", sort_remaining=False)
    )
    ours = best.xs("as jaxid sets them", level="setting")
    table = best.assign(
        first=best["first_s"] / ours["first_s"], run=best["run_ms"] / ours["run_ms"]
    )
    print(machine())
    report(table, args.json)


if __name__ == "__main__":
    main()
