"""Duration of screening, compared with the refits that it replaces, as ratios within one run.

python -m benchmarks.screening [--quick] [--json FILE]

Two recordings of 20 s of a simulated SCARA with one hidden effect (`tests/independent`). The unit
is one Jacobian of the output error with 8 parameters. Everything is compiled before.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import jaxid
from jaxid.discovery.hypotheses import candidates
from jaxid.estimate.minimise import sensitivity
from jaxid.estimate.pieces import pieces_of
from jaxid.simulation.batch import prepare
from jaxid.simulation.steps import with_substeps
from tests import independent as sim

from ._output import options, report

SEED = 5
FITTING = ("fit_1", "fit_2")


def recorded() -> jaxid.Recordings:
    """Two recordings with Stribeck friction on joint 2."""
    case = sim.make_case(SEED, [("stribeck", 2)])
    made = []
    for name in FITTING:
        r = case.recordings[name]
        made.append(jaxid.Recording(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name=name))
    return jaxid.Recordings.of(made)


def least(task: Callable[[], Any], repeats: int) -> float:
    """The shortest of several runs, s, which is least disturbed by other work."""
    task()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        task()
        times.append(time.perf_counter() - started)
    return min(times)


def jacobian(fit: jaxid.Fit) -> Callable[[], Any]:
    """One residual with its derivatives by the 8 parameters."""
    loop = with_substeps(fit.loop, fit.recordings)
    batch = prepare(loop, pieces_of(fit.recordings, None))
    weights, noise = jnp.ones(2), jnp.ones((2, 1))
    return lambda: jax.block_until_ready(
        sensitivity(loop, batch, weights, noise, ("tau",), False).jacobian
    )


def table(quick: bool) -> pd.DataFrame:
    """Seconds and multiples of one Jacobian."""
    recordings, method = recorded(), jaxid.OEM(progress=False)
    repeats = 3 if quick else 10
    fit = jaxid.fit(jaxid.scara(), recordings, method)
    diagnosis = jaxid.diagnose(fit, progress=False)
    settings = [v for v in diagnosis.forms if v.possible][: 2 if quick else 12]
    columns = len(diagnosis.gram.score) - sum(len(v.hypothesis.columns) for v in diagnosis.where)
    proposed = len(candidates(jaxid.catalogue, diagnosis.scene, 1.0))
    refits = []
    for verdict in settings:
        grown = fit.loop.add(diagnosis.predicted(verdict))
        given = jaxid.OEM(start="given", progress=False)
        refits.append(least(lambda g=grown, m=given: jaxid.fit(g, recordings, m), 1))
    one = least(jacobian(fit), repeats)
    screening = least(lambda: jaxid.diagnose(fit, progress=False), repeats)
    whole_fit = least(lambda: jaxid.fit(jaxid.scara(), recordings, method), repeats)
    story = least(
        lambda: jaxid.discover(jaxid.scara(), recordings, method=method, progress=False), 1
    )
    every = float(np.mean(refits)) * proposed
    seconds = {
        "one Jacobian, 8 parameters": one,
        f"screening, {columns} signatures and {len(diagnosis.where)} curves": screening,
        f"refitting all {proposed} settings (mean of {len(refits)})": every,
        "one OEM fit from CAD": whole_fit,
        "whole discovery of one effect": story,
    }
    rows = {
        name: {"seconds": s, "in Jacobians": s / one, "in fits": s / whole_fit}
        for name, s in seconds.items()
    }
    return pd.DataFrame(rows).T.rename_axis("task")


def main() -> None:
    """Prints the table."""
    given = options(__doc__)
    report(table(given.quick), given.json)


if __name__ == "__main__":
    main()
