"""Time and memory over the number and length of recordings, parameters, hypotheses and devices.

`us_per_step` is the time of one weighted residual with its Jacobian (the repeated part of a fit),
divided by the number of steps; for hypotheses it is the response of the linearised loop to each.

python -m benchmarks.scaling [--quick] [--json FILE]
"""

import json
import os
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import jaxid
from jaxid.discovery.linear import linearise as linear_system
from jaxid.discovery.linear import respond
from jaxid.estimate.minimise import linearisation
from jaxid.simulation.batch import Batch, prepare

from ._output import options, report
from ._problem import SUBSTEPS, cad, interleaved, machine, problem, recordings, truth


def grown(parameters: int) -> jaxid.ClosedLoop:
    """The SCARA with 8 parameters, or 58 with free-form curves and Stribeck friction."""
    if parameters == 8:
        return truth()
    curves = [
        jaxid.Curve(joint=joint, coordinate=kind, of=joint, low=-1.5, high=1.5)
        for joint in (1, 2)
        for kind in ("q", "v")
    ]
    return truth().add(*curves, jaxid.effects.Stribeck(joint=2, level=0.01))


def calls(cases: dict[tuple, tuple[jaxid.ClosedLoop, Batch]]) -> dict[tuple, Any]:
    """A function of each case that evaluates its residual and Jacobian once."""
    made = {}
    for key, (loop, batch) in cases.items():
        asked, theta = problem(loop, batch), loop.theta
        start = jnp.concatenate([batch.q0, batch.v0], axis=1)
        around = linearisation(asked)
        made[key] = lambda around=around, theta=theta, start=start: around(theta, start)
        made[key]()
    return made


def grow(name: str, cases: dict[tuple, tuple[jaxid.ClosedLoop, Batch]], budget: float) -> list:
    """Rows of one family of cases, timed in turns."""
    best = interleaved(calls(cases), budget, most=30)
    rows = []
    for key, seconds in best.items():
        batch = cases[key][1]
        steps = SUBSTEPS * batch.mask.size
        jacobian = batch.mask.size * 2 * cases[key][0].theta.shape[0] * 8
        rows.append(
            {
                "grows": name,
                "recordings": key[0],
                "seconds": key[1],
                "parameters": key[2],
                "ms": 1e3 * seconds,
                "us_per_step": 1e6 * seconds / steps,
                "jacobian_MiB": jacobian / 2**20,
            }
        )
    return rows


def repeated(batch: Batch, count: int) -> Batch:
    """A batch of one recording, repeated; differences between recordings do not affect the time."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), batch)


def hypotheses(batch: Batch, counts: tuple[int, ...], budget: float) -> list[dict[str, Any]]:
    """Responses of the linearised loop to torque on the joints, many at once."""
    linear = linear_system(truth(), batch, "tau")
    points = batch.intervals.h.shape[1]
    rng = np.random.default_rng(0)
    funs = {}
    for count in counts:
        push = jnp.asarray(rng.standard_normal((batch.q0.shape[0], points, 2, count)))
        funs[count] = lambda push=push: respond(linear, "push", push)
        funs[count]()
    best = interleaved(funs, budget, most=30)
    return [
        {
            "grows": "hypotheses",
            "recordings": batch.q0.shape[0],
            "hypotheses": count,
            "ms": 1e3 * seconds,
            "us_per_step": 1e6 * seconds / (SUBSTEPS * points * batch.q0.shape[0] * count),
        }
        for count, seconds in best.items()
    ]


def devices(seconds: float, count: int, turns: int = 3) -> list[dict[str, Any]]:
    """One host device compared with two that share the recordings, in separate processes."""
    best: dict[int, dict[str, float]] = {}
    for used in turns * (1, 2):
        flags = os.environ.get("XLA_FLAGS", "")
        flags = f"{flags} --xla_force_host_platform_device_count={used}".strip()
        code = f"from benchmarks.scaling import shared; shared({seconds}, {count})"
        out = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "XLA_FLAGS": flags},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        found = json.loads(out)
        best[used] = min(found, best.get(used, found), key=lambda x: x["ms"])
    return [
        {"grows": "devices", "devices": used, "recordings": count, **found}
        for used, found in best.items()
    ]


def shared(seconds: float, count: int) -> None:
    """Prints the time of a Jacobian on all devices of this process."""
    batch = repeated(prepare(cad(), recordings(1, seconds)), count)
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("recordings",))
    around = linearisation(problem(truth(), batch, mesh))
    theta, start = truth().theta, jnp.concatenate([batch.q0, batch.v0], axis=1)
    around(theta, start)
    best = interleaved({0: lambda: around(theta, start)}, 10.0, most=10)[0]
    print(json.dumps({"ms": 1e3 * best, "us_per_step": 1e6 * best / SUBSTEPS / batch.mask.size}))


def main() -> None:
    """Prints one table."""
    given = options(__doc__)
    quick = given.quick
    length, budget = (1.0, 1.0) if quick else (20.0, 40.0)
    one = prepare(cad(), recordings(1, length))
    counts = (1, 4) if quick else (1, 16, 64, 256, 1024)
    lengths = (1.0, 2.0) if quick else (1.0, 10.0, 100.0, 1000.0)
    print(machine())
    rows = grow("recordings", {(n, length, 8): (truth(), repeated(one, n)) for n in counts}, budget)
    long = {(1, s, 8): (truth(), prepare(cad(), recordings(1, s))) for s in lengths}
    rows += grow("length", long, budget)
    many = (8,) if quick else (8, 58)
    rows += grow("parameters", {(1, length, p): (grown(p), one) for p in many}, budget)
    rows += hypotheses(one, (1, 10) if quick else (1, 10, 100, 500), budget)
    if not quick:
        rows += devices(length, 64)
    report(pd.DataFrame(rows).set_index("grows"), given.json)


if __name__ == "__main__":
    main()
