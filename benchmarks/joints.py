"""Processor time and memory over the number of joints.

The arms are those of published URDFs: the first one, two or three joints of a UR5, with the others
locked, the whole UR5, and a Panda. Each row is a separate process without a cache of compiled
programs. *First* is the processor time of a first call, including compilation; *again* is that of a
second one. The law of the first two tasks is PD, that of the others is unknown.

- *simulation*: 10 s at 1 kHz.
- *Jacobian*: of that simulation, by all base parameters and frictions, with normal equations.
- *fit*, *diagnosis*, *discovery*: of two recordings of 10 s at 250 Hz; a discovery runs once. They
  are simulated by MuJoCo under a sampled law on quantised encoders, without a hidden effect.

python -m benchmarks.joints [--quick] [--json FILE]
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
import numpy as np
import pandas as pd

import jaxid
from jaxid.estimate.minimise.problem import point_around
from jaxid.simulation.batch import prepare
from jaxid.simulation.steps import with_substeps

from ._output import options, report
from ._problem import machine, peak_memory, problem

# Arms by number of joints.
ARMS = {1: "ur5_1", 2: "ur5_2", 3: "ur5_3", 6: "ur5", 7: "panda"}
TASKS = ("simulation", "Jacobian", "fit", "diagnosis", "discovery")


def measure(robot: str, task: str) -> None:
    """Prints processor time and memory of a task in this process as JSON.

    **Arguments:**

    - `robot`: a name in `ARMS`.
    """
    # MuJoCo and its URDFs are needed only here.
    from . import six_joints as bench

    case = bench.make(bench.Wanted(0, 5, robot, "", "free"))
    recordings = jaxid.Recordings.of(case.recordings[:2])
    run = _task(case.loop, recordings, task)
    before, took = peak_memory(), []
    for _ in range(1 if task == "discovery" else 2):
        started = time.process_time()
        jax.block_until_ready(run())
        took.append(time.process_time() - started)
    again = took[1] if len(took) > 1 else None
    row = {"first_s": took[0], "again_s": again, "before_MiB": before, "peak_MiB": peak_memory()}
    print(json.dumps(row))


def _task(loop: jaxid.ClosedLoop, recordings: jaxid.Recordings, task: str) -> Callable[[], Any]:
    """A function without arguments that runs the task."""
    match task:
        case "fit":
            return lambda: jaxid.fit(loop, recordings, jaxid.OEM(progress=False)).theta
        case "diagnosis":
            found = jaxid.fit(loop, recordings, jaxid.OEM(progress=False))
            return lambda: jaxid.diagnose(found, progress=False).floor
        case "discovery":
            return lambda: jaxid.discover(loop, recordings, progress=False).fit.theta
    known, fine = _known(loop, recordings[0])
    if task == "simulation":
        return lambda: jaxid.simulate(known, [fine])[0].tau
    batch = prepare(known, jaxid.Recordings.of(fine))
    posed, start = problem(known, batch), jnp.concatenate([batch.q0, batch.v0], axis=1)
    return lambda: point_around(posed, known.theta, start)


def _known(
    loop: jaxid.ClosedLoop, recording: jaxid.Recording
) -> tuple[jaxid.ClosedLoop, jaxid.Recording]:
    """The arm under a known law, and a recording at 1 kHz with its reference."""
    time_ = np.arange(0.0, recording.duration, 1e-3)
    q = np.stack([np.interp(time_, recording.time, x) for x in recording.q.T], axis=1)
    # Only its reference and its start are used.
    fine = jaxid.Recording.from_arrays(time_, q, q, q_ref=q, name="fine")
    inertia = np.diag(np.asarray(loop.arm.mass_matrix(jax.device_put(q[0])))) + 0.05
    law = jaxid.control.PD(Kp=400.0 * inertia, Kv=40.0 * inertia)
    known = jaxid.ClosedLoop(loop.arm, law, loop.effects)
    return with_substeps(known, jaxid.Recordings.of(fine)), fine


def row(joints: int, task: str) -> dict[str, Any]:
    """The measurement of a new process."""
    code = f"from benchmarks.joints import measure; measure({ARMS[joints]!r}, {task!r})"
    out = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout
    return {"joints": joints, "task": task, **json.loads(out.splitlines()[-1])}


def main() -> None:
    """Prints one table."""
    given = options(__doc__)
    print(machine())
    joints, tasks = ((2,), TASKS[:2]) if given.quick else (tuple(ARMS), TASKS)
    rows = [row(n, task) for task in tasks for n in joints]
    report(pd.DataFrame(rows).set_index(["task", "joints"]), given.json, ".1f")


if __name__ == "__main__":
    main()
