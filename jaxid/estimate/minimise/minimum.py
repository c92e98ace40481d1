"""Minimisation step by step, with progress, deadline and Ctrl-C between steps."""

import math
import time
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float

from ...compiling import compiled
from ...display.progress import silent
from ...simulation.integration import reason
from ..result import Status
from .arrow import Unknowns
from .descent import BoundedDescent
from .filling import Filling
from .linearising import linearisation
from .problem import Point, Problem
from .solver import LevenbergMarquardt
from .stock import Transformed


class Stopping(eqx.Module):
    """Stopping criteria and solver of a minimisation.

    **Arguments:**

    - `tolerance`: stops when a step is shorter than this many standard deviations.
    - `worth`: stops when five steps together lower the loss by less than this share.
    - `max_steps`: largest number of points evaluated, refused ones included.
    - `deadline`: time of `time.perf_counter`, checked before every step.
    - `solver`: solver of optimistix instead of jaxid's, with its own tolerances.
    """

    tolerance: float = 1e-2
    worth: float = 1e-4
    max_steps: int = 100
    deadline: float = math.inf
    solver: Any = None


class Minimum(eqx.Module):
    """Result of a minimisation.

    - `iterations`: number of evaluated points.
    - `notes`: remarks on the result.
    """

    point: Point
    status: Status = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True, default=())


def minimise(
    problem: Problem,
    theta: Float[Any, " parameters"],
    start: Float[Any, "recordings initials"],
    settings: Stopping = Stopping(),
    say: Callable[[str], None] = silent,
    known: Point | None = None,
) -> Minimum:
    """The least squared error within bounds, over parameters and initial states together.

    **Arguments:**

    - `theta`, `start`: start values, `(parameters,)` and `(recordings, 2 · joints)`.
    - `say`: called with a line for every step.
    - `known`: the linearisation at the start, if it exists.
    """
    if settings.solver is not None:
        return _by_stock_solver(problem, theta, start, settings, say)
    around, fill = linearisation(problem), Filling.of(problem)

    def at(y: Unknowns) -> Point:
        ahead, estimated = fill.emptied(y)
        return around(ahead, estimated if problem.free_start else start)

    theta = np.clip(theta, problem.lower, problem.upper)
    point = around(theta, start) if known is None else known
    if not np.isfinite(point.loss):
        return _unsimulated(point)
    y, bounds = fill.unknowns(problem.unknowns(theta, start)), (problem.lower, problem.upper)
    return Minimum(*descend(at, point, y, bounds, fill, problem.rows, settings, say))


def descend(
    at: Callable[[Unknowns], Any],
    point: Any,
    y: Unknowns,
    bounds: tuple[Float[Any, " own"], Float[Any, " own"]],
    fill: Filling,
    rows: float,
    settings: Stopping,
    say: Callable[[str], None] = silent,
) -> tuple[Any, Status, int]:
    """Minimises a function that is evaluated outside the solver; returns the final evaluation.

    **Arguments:**

    - `at`: evaluation at unknowns; the result has `sums` and `loss`.
    - `point`: the evaluation at the first unknowns `y`, which are padded.
    - `bounds`: bounds of the parameters. `rows`: number of residuals.
    """
    lower, upper = bounds
    solver = LevenbergMarquardt(
        descent=BoundedDescent(fill.ends(lower, -np.inf), fill.ends(upper, np.inf)),
        tolerance=np.float64(settings.tolerance),
        worth=np.float64(settings.worth),
    )
    state = _begun(solver, y)
    trial = point
    for k in range(1, settings.max_steps + 1):
        # Sums of a few numbers on the host need no compiled program for each shape.
        sums, loss = jax.device_get((trial.sums, trial.loss))
        with np.errstate(over="ignore", invalid="ignore"):
            options = {"linearised": fill.products(sums, loss), "rows": np.float64(rows)}
        y, state = _stepped(solver, y, options, state)
        point = trial if state.accepted else point
        ended, result = solver.terminate(None, y, None, options, state, frozenset())
        if ended:
            stalled = result != optx.RESULTS.successful
            return point, Status.stalled if stalled else Status.converged, k
        if time.perf_counter() > settings.deadline:
            return point, Status.max_seconds, k
        if k < settings.max_steps:
            trial = at(state.y_eval)
            say(f"iteration {k + 1}, weighted squared error {float(trial.loss):.6g}")
    return point, Status.max_steps, settings.max_steps


def _unsimulated(point: Point) -> Minimum:
    """The result, with the reason, if the loop cannot be simulated at the start values."""
    codes = np.asarray(point.found.result)
    said = reason(int(codes.max(initial=0)))
    if not said:
        return Minimum(point, Status.diverged, 1)
    status = next((s for name, s in _BY_RESULT.items() if said == _words(name)), Status.diverged)
    return Minimum(point, status, 1, (f"diffrax: {said}",))


_BY_RESULT = {
    "max_steps_reached": Status.out_of_solver_steps,
    "dt_min_reached": Status.smallest_solver_step,
    "nonlinear_max_steps_reached": Status.implicit_step_failed,
    "nonlinear_divergence": Status.implicit_step_failed,
}


def _words(name: str) -> str:
    """The message of a diffrax result."""
    return diffrax.RESULTS[getattr(diffrax.RESULTS, name)]


@compiled
def _begun(solver: LevenbergMarquardt, y):
    return solver.init(None, y, None, {}, None, None, frozenset())


@compiled
def _stepped(solver: LevenbergMarquardt, y, options, state):
    y, state, _ = solver.step(None, y, None, options, state, frozenset())
    return y, state


def _by_stock_solver(
    problem: Problem,
    theta: Float[Any, " parameters"],
    start: Float[Any, "recordings initials"],
    settings: Stopping,
    say: Callable[[str], None],
) -> Minimum:
    """The minimum found by another solver of optimistix."""
    around, posed = linearisation(problem), Transformed.of(problem, start)
    point = around(theta, start)
    if not np.isfinite(point.loss):
        return _unsimulated(point)
    solver, tags = settings.solver, frozenset()
    least = isinstance(solver, optx.AbstractLeastSquaresSolver)
    fn = posed.residual if least else posed.loss
    z = posed.outside(jnp.asarray(theta), jnp.asarray(start))
    out, aux = eqx.filter_eval_shape(fn, z, None)
    state = solver.init(fn, z, None, {}, out, aux, tags)
    status, k = Status.max_steps, 0
    ended, result = solver.terminate(fn, z, None, {}, state, tags)
    while not ended and result == optx.RESULTS.successful and k < settings.max_steps:
        if time.perf_counter() > settings.deadline:
            status = Status.max_seconds
            break
        z, state = _stock_step(solver, fn, z, state)
        ended, result = solver.terminate(fn, z, None, {}, state, tags)
        k += 1
        say(f"iteration {k}")
    else:
        if ended:
            status = Status.converged
    notes = ()
    if result != optx.RESULTS.successful:
        status, notes = Status.stalled, (f"{type(solver).__name__}: {optx.RESULTS[result]}",)
    # Some solvers return their best point, which is not the last.
    z, _, _ = solver.postprocess(fn, z, aux, None, {}, state, tags, result)
    point = around(*posed.inside(z))
    return Minimum(point, status, k, notes)


@compiled
def _stock_step(solver: Any, fn: Any, z: Any, state: Any):
    z, state, _ = solver.step(fn, z, None, {}, state, frozenset())
    return z, state
