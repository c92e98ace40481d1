"""The same fit with every way to its derivatives: error, time, memory, compilation, success.

Reverse mode and the backsolve adjoint give the gradient of one number, so for them a row is the
gradient of the sum of squares; all others give the whole Jacobian. Errors are against forward mode
with eight times as many steps: they hold the integration's error too, which is the first row's.

python -m benchmarks.gradients [--quick] [--json FILE]
"""

import time
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy import optimize

import jaxid
from jaxid.simulation.runs import (
    Interval,
    _instant_at,
    advance,
    each,
    initial,
    prepare,
    run,
    run_with_sensitivities,
    set_substeps,
    unflatten,
)

from ._output import options, report
from ._problem import (
    NOISE,
    PERIOD,
    SUBSTEPS,
    TRUTH,
    cad,
    interleaved,
    machine,
    recordings,
)

P = 8
Way = Callable[[jax.Array], jax.Array]


def ways(recs: jaxid.Recordings, loop: jaxid.ClosedLoop) -> tuple[dict[str, Way], dict[str, Way]]:
    """Functions of the parameters: those that give Jacobians, and those that give gradients."""
    batch = prepare(loop, recs)
    starts = batch.intervals, batch.q0, batch.v0

    def torque(theta):
        changed = loop.with_theta(theta)
        return each(lambda i, q, v: run(changed, i, initial(changed, i, q, v))[1][:, 0], *starts)

    def forward(theta):
        changed = loop.with_theta(theta)

        def one(i, q, v):
            x0 = initial(changed, i, q, v)
            return run_with_sensitivities(changed, i, x0, jnp.zeros((x0.shape[0], P)), (0,))[1]

        return each(one, *starts)[:, :, 0]

    def augmented(theta):
        return each(lambda i, q, v: _augmented(loop, theta, i, q, v), *starts)

    def two_point(theta):
        h = 1e-6 * jnp.maximum(jnp.abs(theta), 0.1)
        # One program for all points, or the compiler would see each as another simulation.
        points = jax.lax.map(torque, jnp.concatenate([theta[None], theta + jnp.diag(h)]))
        return jnp.moveaxis(points[1:] - points[0], 0, -1) / h

    def three_point(theta):
        h = 1e-5 * jnp.maximum(jnp.abs(theta), 0.1)
        points = jax.lax.map(torque, jnp.concatenate([theta + jnp.diag(h), theta - jnp.diag(h)]))
        return jnp.moveaxis(points[:P] - points[P:], 0, -1) / (2 * h)

    def loss(theta):
        changed = loop.with_theta(theta)

        @jax.checkpoint
        def interval(x, i):
            after, seen = advance(changed, i, x)
            return after, seen[0]

        def one(i, q, v):
            return jax.lax.scan(interval, initial(changed, i, q, v), i)[1]

        return jnp.sum((batch.tau - each(one, *starts)) ** 2)

    # The adjoint differentiates by all that is handed to it, so the reference stays outside.
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[0], starts)

    def backsolve(theta):
        return jnp.sum((batch.tau[0] - _backsolved(loop, theta, *first)) ** 2)

    jacobians = {
        "forward mode through the steps": forward,
        "sensitivity equations, augmented": augmented,
        "two-point differences": two_point,
        "three-point differences": three_point,
    }
    gradients = {"reverse mode, checkpoints": jax.grad(loss)}
    if len(recs) == 1:
        gradients["backsolve adjoint"] = jax.grad(backsolve)
    return jacobians, gradients


def _rate(loop: jaxid.ClosedLoop, theta: jax.Array, interval: Interval, t, x):
    changed = loop.with_theta(theta)
    now = _instant_at(changed, interval, t, unflatten(changed)(x))
    return jnp.concatenate([now.derivative.q, now.derivative.v]), now.command


def _augmented(loop, theta, intervals: Interval, q, v):
    """Torque's derivatives by integrating S' = df/dx S + df/dtheta beside the state."""

    def rate(i, t, x, s):
        field = lambda th, y: _rate(loop, th, i, t, y)  # noqa: E731
        along = lambda e, d: jax.jvp(field, (theta, x), (e, d))  # noqa: E731
        (dx, _), (ds, dtau) = jax.vmap(along, in_axes=(0, 1), out_axes=((None, None), -1))(
            jnp.eye(P), s
        )
        return dx, ds, dtau

    def body(carry, i):
        h = i.h / SUBSTEPS
        shown = rate(i, i.t0, *carry)[2]

        def substep(k, carry):
            x, s = carry
            t = i.t0 + k * h
            a = rate(i, t, x, s)[:2]
            b = rate(i, t + h / 2, x + h / 2 * a[0], s + h / 2 * a[1])[:2]
            c = rate(i, t + h / 2, x + h / 2 * b[0], s + h / 2 * b[1])[:2]
            d = rate(i, t + h, x + h * c[0], s + h * c[1])[:2]
            return tuple(
                y + h / 6 * (ka + 2 * (kb + kc) + kd)
                for y, ka, kb, kc, kd in zip(carry, a, b, c, d, strict=True)
            )

        return jax.lax.fori_loop(0, SUBSTEPS, substep, carry), shown

    first = jnp.concatenate([q, v]), jnp.zeros((4, P))
    return jax.lax.scan(body, first, intervals)[1]


def _backsolved(loop, theta, intervals: Interval, q, v):
    """Torque by diffrax over the whole recording, with its continuous adjoint."""
    times = intervals.t0

    def at(t):
        k = jnp.clip(((t - times[0]) / PERIOD).astype(int), 0, len(times) - 1)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[k], intervals)

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, x, theta: _rate(loop, theta, at(t), t, x)[0]),
        diffrax.Tsit5(),
        times[0],
        times[-1],
        PERIOD / SUBSTEPS,
        jnp.concatenate([q, v]),
        theta,
        saveat=diffrax.SaveAt(ts=times),
        adjoint=diffrax.BacksolveAdjoint(),
        max_steps=None,
    )
    return jax.vmap(lambda t, x, i: _rate(loop, theta, i, t, x)[1])(times, solution.ys, intervals)


def table(recs: jaxid.Recordings, budget: float) -> list[dict[str, Any]]:
    """Error, time, memory and compilation of each way."""
    theta = jnp.asarray(list(TRUTH.values())) * 1.05
    fine, _ = ways(recs, set_substeps(cad(), 8 * SUBSTEPS))
    exact = np.asarray(jax.jit(fine["forward mode through the steps"])(theta))
    simulated = _residual(recs, set_substeps(cad(), 8 * SUBSTEPS), theta)
    gradient = -2 * np.einsum("rkj,rkjp->p", simulated, exact)
    jacobians, gradients = ways(recs, cad())
    calls, rows = {}, {}
    for name, way in {**jacobians, **gradients}.items():
        started = time.perf_counter()
        made = jax.jit(way).lower(theta).compile()
        seconds = time.perf_counter() - started
        found = np.asarray(made(theta))
        target = gradient if name in gradients else exact
        calls[name] = lambda made=made: made(theta)
        memory = made.memory_analysis()
        rows[name] = {
            "task": "gradient" if name in gradients else "Jacobian",
            "recordings": len(recs),
            "way": name,
            "error": np.linalg.norm(found - target) / np.linalg.norm(target),
            "compile_s": seconds,
            "temporary_MiB": memory.temp_size_in_bytes / 2**20 if memory else np.nan,
        }
    best = interleaved(calls, budget, most=50)
    return [{**row, "ms": 1e3 * best[name]} for name, row in rows.items()]


def _residual(recs: jaxid.Recordings, loop: jaxid.ClosedLoop, theta: jax.Array) -> np.ndarray:
    runs = jaxid.simulate(loop.with_theta(theta), recs)
    return np.stack([r.tau - run.tau for r, run in zip(recs, runs, strict=True)])


def success(recs: jaxid.Recordings, draws: int) -> list[dict[str, Any]]:
    """Iterations and success of SciPy's least squares with each Jacobian."""
    jacobians, _ = ways(recs, cad())
    batch = prepare(cad(), recs)
    measured = np.asarray(batch.tau)

    @jax.jit
    def torque(theta):
        changed = cad().with_theta(theta)
        return each(
            lambda i, q, v: run(changed, i, initial(changed, i, q, v))[1][:, 0],
            batch.intervals,
            batch.q0,
            batch.v0,
        )

    rng = np.random.default_rng(1)
    start = np.maximum(np.asarray(cad().theta), 1e-3)
    spread = np.array([1.0, 0.2, 0.2, 0.2, 0.1, 0.5, 0.05, 0.2])
    random = start + spread * rng.uniform(-1, 1, (draws, P))
    low = np.array([0.1, 0.01, -np.inf, -np.inf, 0, 0, 0, 0])
    rows = []
    for name, way in jacobians.items():
        slope = jax.jit(way)

        def solve(x0, slope=slope):
            return optimize.least_squares(
                lambda th: np.nan_to_num((np.asarray(torque(th)) - measured).ravel(), nan=1e6),
                np.maximum(x0, low + 1e-6),
                jac=lambda th: np.nan_to_num(np.asarray(slope(th)).reshape(-1, P)),
                x_scale="jac",
                bounds=(low, np.inf),
                max_nfev=60,
            )

        floor = NOISE**2 * measured.size / 2
        runs = [solve(start), *(solve(x0) for x0 in random)]
        reached = [r.cost < 1.05 * floor for r in runs]
        rows.append(
            {
                "task": "least squares",
                "recordings": len(recs),
                "way": name,
                "from_CAD": bool(reached[0]),
                "CAD_iterations": runs[0].njev,
                "random_starts": draws,
                "reached": int(sum(reached[1:])),
                "median_iterations": float(
                    np.median([r.njev for r, ok in zip(runs[1:], reached[1:], strict=True) if ok])
                    if any(reached[1:])
                    else np.nan
                ),
            }
        )
    return rows


def main() -> None:
    """Prints both tables as one."""
    given = options(__doc__)
    seconds, many, draws, budget = (2.0, 2, 2, 2.0) if given.quick else (20.0, 16, 50, 40.0)
    print(machine())
    rows = table(recordings(1, seconds), budget)
    if not given.quick:
        rows += table(recordings(many, seconds), budget)
    rows += success(recordings(1 if given.quick else 2, seconds), draws)
    report(pd.DataFrame(rows).set_index(["task", "recordings", "way"]), given.json, form=".6f")


if __name__ == "__main__":
    main()
