"""One fit by every minimiser: evaluations, time, and the result from the CAD start.

All minimise the same squared error of the same recording, with the same weights. jaxid's own
minimiser and those of optimistix run by `jaxid.estimate.minimise.minimise`, like
`OEM(solver=...)`. SciPy's `least_squares` calls the same two compiled programs, simulation and
linearisation.
"""

import collections
import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pandas as pd
from jaxtyping import Array, Float
from scipy import optimize

import jaxid
from jaxid.estimate import Status
from jaxid.estimate.minimise import (
    Problem,
    Sensitivity,
    Stopping,
    linearisation,
    minimise,
    residual_at,
)
from jaxid.simulation.batch import prepare

from ._fresh import cold_and_warm, each_afresh
from ._problem import NOISE, cad, problem

# Tolerance of optimistix' solvers; jaxid's is in standard deviations, SciPy's default is 1e-8.
TOLERANCE = 1e-8
MAX_STEPS = 100

OURS = "jaxid"
STOCK = {
    f"optimistix.{kind.__name__}": kind
    for kind in (optx.LevenbergMarquardt, optx.Dogleg, optx.GaussNewton, optx.BFGS)
}
BY_DIFFERENCES, BY_JACOBIAN = "SciPy, differences", "SciPy, jaxid's Jacobian"
MINIMISERS = (OURS, *STOCK, BY_DIFFERENCES, BY_JACOBIAN)
# Every kind once, because compilation dominates a short run.
FEW = tuple(who for who in MINIMISERS if not who.endswith(("Dogleg", "GaussNewton")))

# Kinds of evaluation; a linearisation includes its simulation.
SIMULATION, JACOBIAN = "simulations", "Jacobians"
_COUNTED: collections.Counter[str] = collections.Counter()


def _count(kind: str) -> None:
    _COUNTED[kind] += 1


class Counted(Problem):
    """A problem that counts its evaluations at run time, not at tracing."""

    def whitened(self, plain: Sensitivity, extra: Float[Array, " _"], known=None) -> Sensitivity:
        """As for any problem; simulations have no columns of derivatives."""
        kind = JACOBIAN if plain.jacobian.shape[-1] else SIMULATION
        jax.debug.callback(functools.partial(_count, kind))
        return super().whitened(plain, extra, known)


@dataclasses.dataclass(frozen=True)
class Job:
    """A measurement of one minimiser: its name, recordings, and number of warm runs."""

    who: str
    recordings: jaxid.Recordings
    repeats: int


def posed(recs: jaxid.Recordings) -> Problem:
    """The fit, with its residual in units of the noise."""
    loop = cad()
    return dataclasses.replace(problem(loop, prepare(loop, recs)), weights=jnp.full(2, 1 / NOISE))


def starts(asked: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The CAD values, and the measured initial states."""
    batch = asked.batch
    return np.asarray(asked.loop.theta), np.concatenate([batch.q0, batch.v0], axis=1)


def ended(who: str, asked: Problem) -> tuple[np.ndarray, Status, int]:
    """Values and status of a minimiser from the CAD start, and its number of trial points."""
    theta, start = starts(asked)
    if who in (BY_DIFFERENCES, BY_JACOBIAN):
        return _by_scipy(asked, theta, start, who == BY_JACOBIAN)
    solver = STOCK[who](rtol=TOLERANCE, atol=TOLERANCE) if who in STOCK else None
    found = minimise(asked, theta, start, Stopping(max_steps=MAX_STEPS, solver=solver))
    return np.asarray(found.point.theta), found.status, found.iterations


def _by_scipy(
    asked: Problem, theta: np.ndarray, start: np.ndarray, exact: bool
) -> tuple[np.ndarray, Status, int]:
    around = linearisation(asked)

    def residual(x: np.ndarray) -> np.ndarray:
        # SciPy raises for values that are not finite; for a large error it refuses the step.
        return np.nan_to_num(np.asarray(_simulated(asked, jnp.asarray(x))), nan=1e6)

    def jacobian(x: np.ndarray) -> np.ndarray:
        columns: Any = around(x, start).found.jacobian
        return np.nan_to_num(np.asarray(columns).reshape(-1, len(x)))

    found = optimize.least_squares(
        residual,
        theta,
        jac=jacobian if exact else "2-point",
        x_scale="jac",
        bounds=(np.asarray(asked.lower), np.asarray(asked.upper)),
        max_nfev=MAX_STEPS,
    )
    status = Status.converged if found.status > 0 else Status.max_steps
    return found.x, status, found.nfev


@eqx.filter_jit
def _simulated(asked: Problem, theta: Float[Array, " parameters"]) -> Float[Array, " rows"]:
    start = jnp.concatenate([asked.batch.q0, asked.batch.v0], axis=1)
    return residual_at(asked, theta, start).ravel()


def measured(job: Job) -> dict[str, Any]:
    """One row, without the values that need the results of all minimisers."""
    asked = posed(job.recordings)
    found, cold, warm = cold_and_warm(lambda: ended(job.who, asked), job.repeats)
    theta, status, steps = found
    # Separate from the timing, because a program that counts is another program.
    ended(job.who, Counted(**{f.name: getattr(asked, f.name) for f in dataclasses.fields(asked)}))
    jax.effects_barrier()
    return {
        "minimiser": job.who,
        "steps": steps,
        SIMULATION: _COUNTED[SIMULATION],
        JACOBIAN: _COUNTED[JACOBIAN],
        "cold_s": cold,
        "warm_ms": 1e3 * warm,
        "theta": theta,
        "status": status.name,
    }


def table(
    recs: jaxid.Recordings, who: tuple[str, ...], repeats: int, at_once: int = 1
) -> pd.DataFrame:
    """A row for each of some minimisers.

    Losses are relative to the lowest one. Parameters are compared with those of the lowest loss, in
    their standard deviations due to the noise.
    """
    rows = each_afresh(measured, [Job(one, recs, repeats) for one in who], at_once)
    asked = posed(recs)
    around, (_, start) = linearisation(asked), starts(asked)
    ends = np.stack([row.pop("theta") for row in rows])
    points = [around(theta, start) for theta in ends]
    loss = np.array([float(point.loss) for point in points])
    best = int(np.argmin(loss))
    gram = np.asarray(points[best].sums.gram).sum(axis=0)
    deviations = np.sqrt(np.diag(np.linalg.inv(gram)))
    found = pd.DataFrame(rows).set_index("minimiser")
    found.insert(5, "loss_above", loss / loss[best] - 1)
    found.insert(6, "deviations_off", np.abs((ends - ends[best]) / deviations).max(axis=1))
    return found
