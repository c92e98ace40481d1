"""One simulation, one Jacobian, one whole fit and one start, by jaxid and by other programs.

All solve the same problem: RK4 with four steps in each sampling interval and the same cubic of the
reference (SciPy: an adaptive solver with a tolerance for the same accuracy). MuJoCo has no arctan
friction and no reference between steps, so its numbers are for a model of the same size; its
Jacobian is by finite differences over `mujoco.rollout`, as in its sysid toolbox. A program that is
not installed is left out.

python -m benchmarks.peers [--quick] [--json FILE]
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy import optimize

import jaxid
from jaxid.estimate.minimise import linearisation, minimise
from jaxid.simulation import runs
from jaxid.simulation.batch import prepare

from ._output import options, report
from ._peer_programs import P, Peer, of_c, of_casadi, of_jaxid, of_mujoco, of_scipy
from ._problem import (
    NOISE,
    SUBSTEPS,
    TRUTH,
    arrays,
    cad,
    interleaved,
    machine,
    once,
    problem,
    recordings,
)


@dataclasses.dataclass(frozen=True)
class Ended:
    """A whole fit: the estimate, seconds warm and cold, and numbers of evaluations."""

    theta: np.ndarray
    warm: float
    cold: float
    simulations: int
    jacobians: int


def fitted(peer: Peer, recs: jaxid.Recordings, repeats: int) -> Ended:
    """SciPy's least squares with a peer's Jacobian, from the CAD start."""
    measured = np.stack([d["tau"] for d in arrays(recs)])
    start = np.maximum(np.asarray(cad().theta), 1e-9)
    low = np.where([name in ("MX2", "MY2") for name in TRUTH], -np.inf, 0.0)

    def solve() -> Any:
        return optimize.least_squares(
            lambda theta: np.nan_to_num(
                ((np.asarray(peer.simulate(theta)) - measured) / NOISE).ravel(), nan=1e6
            ),
            start,
            jac=lambda theta: (np.asarray(peer.jacobian(theta)[1]) / NOISE).reshape(-1, P),
            x_scale="jac",
            bounds=(low, np.inf),
            max_nfev=60,
        )

    started = time.perf_counter()
    solved = solve()
    first = time.perf_counter() - started
    warm = min((once(solve) for _ in range(repeats)), default=first)
    return Ended(solved.x, warm, peer.cold + first, int(solved.nfev), int(solved.njev or 0))


def fitted_by_jaxid(recs: jaxid.Recordings, repeats: int) -> tuple[Ended, np.ndarray]:
    """A complete `jaxid.fit`, and its deviations."""
    loop, counts = cad(), {"simulations": 0, "jacobians": 0}

    def counted(kind: str, fun: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            counts[kind] += 1
            return fun(*args)

        return call

    cold = once(lambda: jaxid.fit(loop, recs).theta)
    warm = min(once(lambda: jaxid.fit(loop, recs).theta) for _ in range(repeats))
    simulate = counted("simulations", runs.simulate_batch)
    with (
        mock.patch("jaxid.estimate.start.simulate_batch", simulate),
        mock.patch("jaxid.estimate.converge.simulate_batch", simulate),
        mock.patch(
            "jaxid.estimate.minimise.minimum.linearisation",
            lambda asked: counted("jacobians", linearisation(asked)),
        ),
    ):
        fit = jaxid.fit(loop, recs)
    return Ended(np.asarray(fit.theta), warm, cold, **counts), np.asarray(fit.std)


def minimised_by_jaxid(recs: jaxid.Recordings, repeats: int) -> Ended:
    """Only the minimisation, like the other programs: from the CAD start with known weights."""
    loop = cad()
    batch = prepare(loop, recs)
    asked = dataclasses.replace(problem(loop, batch), weights=jnp.full(2, 1 / NOISE))
    start = np.concatenate([batch.q0, batch.v0], axis=1)
    cold = once(lambda: minimise(asked, loop.theta, start).point.theta)
    warm = min(once(lambda: minimise(asked, loop.theta, start).point.theta) for _ in range(repeats))
    found = minimise(asked, loop.theta, start)
    return Ended(np.asarray(found.point.theta), warm, cold, 0, found.iterations)


def main() -> None:
    """Prints all measurements as one table."""
    given = options(__doc__)
    seconds, count, budget = (2.0, 4, 3.0) if given.quick else (20.0, 64, 60.0)
    print(machine())
    rows = per_call(seconds, count, budget)
    rows += whole_fits(seconds, given.quick)
    if not given.quick:
        rows += cold_starts()
    report(pd.DataFrame(rows).set_index(["task", "recordings", "who"]), given.json)


def per_call(seconds: float, many: int, budget: float) -> list[dict[str, Any]]:
    """Time per simulation and per Jacobian, with one recording and with many."""
    theta, rows = np.array(list(TRUTH.values())), []
    for count in (1, many):
        recs = recordings(count, seconds)
        peers = [of_jaxid(recs), of_jaxid(recs, alone=True), of_c(recs)]
        peers += [of_casadi(recs, False), of_casadi(recs, True), of_mujoco(recs)]
        if count == 1:
            peers.append(of_scipy(recs))
        there = {p.name: p for p in peers if p is not None}
        exact = [p for p in there.values() if "MuJoCo" not in p.name]
        expected = np.asarray(exact[0].simulate(theta))
        slopes = np.asarray(exact[0].jacobian(theta)[1])
        errors = {p.name: _relative(p.simulate(theta), expected) for p in exact}
        wrong = {p.name: _relative(p.jacobian(theta)[1], slopes) for p in exact}
        calls = {
            "simulation": {n: (lambda p=p: p.simulate(theta)) for n, p in there.items()},
            "Jacobian": {n: (lambda p=p: p.jacobian(theta)) for n, p in there.items()},
        }
        steps = SUBSTEPS * sum(r.samples for r in recs)
        for task, funs in calls.items():
            best = interleaved(funs, budget)
            differ = errors if task == "simulation" else wrong
            for name, value in best.items():
                rows.append(
                    {
                        "task": task,
                        "recordings": count,
                        "who": name,
                        "ms": 1e3 * value,
                        "us_per_step": 1e6 * value / steps,
                        "times_jaxid": value / best["jaxid"],
                        "differs": differ.get(name, np.nan),
                        "cold_s": there[name].cold,
                    }
                )
    return rows


def _relative(a: Any, b: np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(a) - b) / np.linalg.norm(b))


def whole_fits(seconds: float, quick: bool) -> list[dict[str, Any]]:
    """A fit of two recordings from the CAD start: seconds, and distance from the optimum."""
    recs, repeats = recordings(2, seconds), 5 if quick else 3
    ours, deviations = fitted_by_jaxid(recs, 2 * repeats)
    best = {"jaxid": ours, "jaxid, minimisation alone": minimised_by_jaxid(recs, 2 * repeats)}
    peers = [of_c(recs), of_casadi(recs, False), of_casadi(recs, True)]
    for peer in [p for p in peers if p is not None]:
        best[f"least_squares, {peer.name}"] = fitted(peer, recs, repeats)
    if not quick:
        best["least_squares, SciPy solve_ivp, differences"] = fitted(of_scipy(recs), recs, 0)
    return [
        {
            "task": "whole fit",
            "recordings": 2,
            "who": name,
            "ms": 1e3 * end.warm,
            "times_jaxid": end.warm / ours.warm,
            "cold_s": end.cold,
            "simulations": end.simulations,
            "Jacobians": end.jacobians,
            # In units of the deviations that the fit reports.
            "differs": float(np.abs((end.theta - ours.theta) / deviations).max()),
        }
        for name, end in best.items()
    ]


def cold_starts(turns: int = 3) -> list[dict[str, Any]]:
    """Seconds from the start of Python to the table of `jaxid fit`, and of imports alone."""
    files = sorted(str(f) for f in (Path(jaxid.__file__).parent / "demo" / "clean").glob("fit_*"))
    command = "from jaxid.cli import main; main()"
    imports, filled = "imports of jax, diffrax, optimistix", "jaxid fit, filled cache"
    best: dict[str, float] = {}

    def started(name: str, cache: str, code: str, *arguments: str) -> None:
        environment = {**os.environ, "XDG_CACHE_HOME": cache}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        begun = time.perf_counter()
        argv = [sys.executable, "-c", code, *arguments]
        subprocess.run(argv, env=environment, check=True, stdout=subprocess.DEVNULL)
        best[name] = min(best.get(name, np.inf), time.perf_counter() - begun)

    for _ in range(turns):
        with tempfile.TemporaryDirectory() as cache:
            started(imports, cache, "import jax, diffrax, optimistix")
            started("jaxid fit, empty cache", cache, command, "fit", *files)
            started(filled, cache, command, "fit", *files)
    return [
        {
            "task": "cold start",
            "recordings": len(files) if name != imports else 0,
            "who": name,
            "cold_s": seconds,
            "times_imports": seconds / best[imports],
        }
        for name, seconds in best.items()
    ]


if __name__ == "__main__":
    main()
