"""Minimisers and gradients: one fit by every minimiser, and its gradient by every method.

The problem is output error of the SCARA along one recording with white noise. The first table is
that of `benchmarks.minimisers`. The second is about the gradient of the squared error at values
five per cent from the truth. It has the error relative to extrapolated differences of the same
discrete simulation (which excludes the integration error), seconds of the first call, milliseconds
of later ones, and the peak of resident memory above that of the simulation alone. Every row is a
separate process, in which nothing is compiled yet.

python -m benchmarks.gradients [--quick] [--json FILE]
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

import jaxid
from jaxid.estimate.minimise import point_around
from jaxid.simulation.batch import Interval, prepare
from jaxid.simulation.integration import initial, instant_at
from jaxid.simulation.runs import each, run
from jaxid.simulation.state import unflatten
from jaxid.simulation.stepping import RK4
from jaxid.simulation.unrolling import unrolled

from . import minimisers
from ._fresh import cold_and_warm, each_afresh, peak_memory
from ._output import options, records, show, write
from ._problem import NOISE, PERIOD, SUBSTEPS, TRUTH, cad, machine, recordings

Theta = Float[Array, " parameters"]
Way = Callable[[Theta], Array]

ALONE = "simulation alone"
OURS = "forward mode, jaxid"
TWO_POINT, THREE_POINT = "two-point differences", "three-point differences"
ADJOINTS: dict[str, diffrax.AbstractAdjoint] = {
    "forward mode, ForwardMode": diffrax.ForwardMode(),
    "reverse mode, RecursiveCheckpointAdjoint": diffrax.RecursiveCheckpointAdjoint(),
    "reverse mode, DirectAdjoint": diffrax.DirectAdjoint(),
    "reverse mode, BacksolveAdjoint": diffrax.BacksolveAdjoint(),
}
WAYS = (ALONE, OURS, *ADJOINTS, TWO_POINT, THREE_POINT)
# Compilation dominates a short run, so it has only one reverse mode.
FEW = tuple(way for way in WAYS if not way.endswith(("CheckpointAdjoint", "BacksolveAdjoint")))


def simulation(recs: jaxid.Recordings, adjoint: diffrax.AbstractAdjoint | None) -> Way:
    """Torque as a function of the parameters, `(recordings, samples, joints)`.

    Only this function depends on the integration of loops.

    **Arguments:**

    - `adjoint`: adjoint of one `diffrax.diffeqsolve` for each recording, with the steps of jaxid;
      None for jaxid's own run.
    """
    loop = cad()
    batch = prepare(loop, recs)
    # NumPy arrays, because the backsolve adjoint gives no derivative by closed-over values.
    intervals = jax.tree.map(lambda x: np.asarray(x)[:, : recs[0].samples], batch.intervals)
    drives = intervals, np.asarray(batch.q0), np.asarray(batch.v0)

    def own(theta: Theta) -> Array:
        changed = loop.with_theta(theta)
        return each(lambda i, q, v: run(changed, i, initial(changed, i, q, v))[1][:, 0], *drives)

    def by_diffrax(theta: Theta) -> Array:
        one = [jax.tree.map(lambda leaf, k=k: leaf[k], drives) for k in range(len(recs))]
        return jnp.stack([_solved(loop, theta, *drive, adjoint) for drive in one])

    return own if adjoint is None else by_diffrax


def _solved(loop: jaxid.ClosedLoop, theta: Theta, intervals: Interval, q, v, adjoint) -> Array:
    times = intervals.t0

    def now(interval: Interval, t, x, theta: Theta):
        changed = loop.with_theta(theta)
        found = instant_at(changed, interval, t, unflatten(changed)(x))
        return jnp.concatenate([found.derivative.q, found.derivative.v]), found.command

    def field(t, x, theta: Theta):
        k = jnp.clip(((t - times[0]) / PERIOD).astype(int), 0, len(times) - 1)
        interval = jax.tree.map(lambda leaf: jnp.asarray(leaf)[k], intervals)
        return unrolled(now, interval, t, x, theta)(interval, t, x, theta)[0]

    # Backwards in time diffrax changes the sign of a step, which jaxid's RK4 does not support.
    backwards = isinstance(adjoint, diffrax.BacksolveAdjoint)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Tsit5() if backwards else RK4(),
        times[0],
        times[-1],
        PERIOD / SUBSTEPS,
        jnp.concatenate([q, v]),
        theta,
        saveat=diffrax.SaveAt(ts=times),
        adjoint=adjoint,
        # Times are sums of steps; rounding may require one more step.
        max_steps=SUBSTEPS * len(times),
    )
    return jax.vmap(lambda i, x: now(i, i.t0, x, theta)[1])(intervals, solution.ys)


def squared_error(recs: jaxid.Recordings, adjoint: diffrax.AbstractAdjoint | None = None) -> Way:
    """The sum of squared residuals in units of the noise, as a function of the parameters."""
    simulated = simulation(recs, adjoint)
    tau = np.stack([r.tau for r in recs])
    return lambda theta: jnp.sum(((tau - simulated(theta)) / NOISE) ** 2)


def gradient(way: str, recs: jaxid.Recordings) -> Way:
    """The gradient of the squared error as a function of the parameters.

    For the simulation alone it is the squared error itself.
    """
    if way in ADJOINTS:
        forward = isinstance(ADJOINTS[way], diffrax.ForwardMode)
        return (jax.jacfwd if forward else jax.grad)(squared_error(recs, ADJOINTS[way]))
    if way == OURS:
        asked = minimisers.posed(recs)
        _, start = minimisers.starts(asked)
        return lambda th: 2 * point_around(asked, th, jnp.asarray(start)).sums.slope.sum(axis=0)
    loss = squared_error(recs)
    if way == ALONE:
        return loss
    return _two_point(loss) if way == TWO_POINT else _three_point(loss)


def _two_point(loss: Way) -> Way:
    def found(theta: Theta) -> Array:
        h = 1e-6 * jnp.maximum(jnp.abs(theta), 0.1)
        # One program for all points; otherwise the compiler would treat each as another simulation.
        values = jax.lax.map(loss, jnp.concatenate([theta[None], theta + jnp.diag(h)]))
        return (values[1:] - values[0]) / h

    return found


def _three_point(loss: Way) -> Way:
    def found(theta: Theta) -> Array:
        h = 1e-5 * jnp.maximum(jnp.abs(theta), 0.1)
        values = jax.lax.map(loss, jnp.concatenate([theta + jnp.diag(h), theta - jnp.diag(h)]))
        return (values[: len(h)] - values[len(h) :]) / (2 * h)

    return found


def place() -> np.ndarray:
    """Parameter values of the gradients, `(parameters,)`."""
    return 1.05 * np.array(list(TRUTH.values()))


def extrapolated(recs: jaxid.Recordings, levels: int = 6) -> tuple[np.ndarray, float]:
    """The gradient by central differences, with steps that decrease by four (Ridders 1982).

    Differences are of the torque, which has more digits than its squared error. Of each column's
    extrapolations the one that differs least from its neighbours is used.

    **Returns:** the gradient, `(parameters,)`, and the relative distance of those neighbours.
    """
    theta, simulated = place(), simulation(recs, None)
    steps = 0.01 * theta * 4.0 ** -np.arange(levels)[:, None]
    shifts = steps[..., None] * np.eye(len(theta))
    points = np.stack([theta + shifts, theta - shifts]).reshape(-1, len(theta))
    points = jnp.asarray(np.concatenate([theta[None], points]))
    torque = np.asarray(jax.jit(lambda all_: jax.lax.map(simulated, all_))(points))
    measured = np.stack([r.tau for r in recs])
    plus, minus = torque[1:].reshape(2, levels, len(theta), *measured.shape)
    residual = (measured - torque[0]) / NOISE**2
    # All later steps are linear in the torque, so its inner product with the residual suffices.
    slopes = np.einsum("lprkj,rkj->lp", plus - minus, -2 * residual) / (2 * steps)
    found = [_ridders(column) for column in slopes.T]
    best, gap = np.transpose(found)
    return best, float(np.linalg.norm(gap) / np.linalg.norm(best))


def _ridders(slopes: Float[np.ndarray, " levels"]) -> tuple[float, float]:
    rows, best, error = [[slopes[0]]], slopes[0], np.inf
    for slope in slopes[1:]:
        row, before = [slope], rows[-1]
        for j, former in enumerate(before, start=1):
            row.append(row[-1] + (row[-1] - former) / (16.0**j - 1))
            gap = max(abs(row[-1] - row[-2]), abs(row[-1] - former))
            if gap < error:
                best, error = row[-1], gap
        rows.append(row)
    return best, error


@dataclasses.dataclass(frozen=True)
class Job:
    """A measurement of one method: its name, recordings, and number of warm runs."""

    way: str
    recordings: jaxid.Recordings
    repeats: int


def measured(job: Job) -> dict[str, Any]:
    """One row, without the values that need a reference."""
    theta, found = jnp.asarray(place()), jax.jit(gradient(job.way, job.recordings))
    compiled = functools.cache(lambda: found.lower(theta).compile())
    value, cold, warm = cold_and_warm(lambda: compiled()(theta), job.repeats)
    memory = compiled().memory_analysis()
    return {
        "way": job.way,
        "gradient": np.asarray(value),
        "cold_s": cold,
        "warm_ms": 1e3 * warm,
        "memory_MiB": peak_memory(),
        "buffers_MiB": memory.temp_size_in_bytes / 2**20 if memory else np.nan,
    }


def table(
    recs: jaxid.Recordings, ways: tuple[str, ...], repeats: int, at_once: int = 1
) -> pd.DataFrame:
    """A row for each method of computing the gradient, and one for the simulation alone."""
    rows = each_afresh(measured, [Job(way, recs, repeats) for way in ways], at_once)
    exact, uncertain = extrapolated(recs)
    print(f"the reference gradient is known to {uncertain:.0e} of itself")
    found = pd.DataFrame(rows).set_index("way")
    gradients = found.pop("gradient").drop(ALONE)
    gaps = gradients.map(lambda g: np.linalg.norm(g - exact) / np.linalg.norm(exact))
    found.insert(0, "error", gaps)
    found["memory_MiB"] -= found.loc[ALONE, "memory_MiB"]
    return found


def main() -> None:
    """Prints both tables, and writes them as one."""
    given = options(__doc__)
    seconds, repeats, at_once = (2.0, 1, 2) if given.quick else (20.0, 20, 1)
    recs = recordings(1, seconds)
    print(machine())
    who, ways = (minimisers.FEW, FEW) if given.quick else (minimisers.MINIMISERS, WAYS)
    fits = minimisers.table(recs, who, max(1, repeats // 4), at_once)
    show(fits, form=".3g")
    gradients = table(recs, ways, repeats, at_once)
    show(gradients, form=".3g")
    write([*records(fits, task="fit"), *records(gradients, task="gradient")], given.json)


if __name__ == "__main__":
    main()
