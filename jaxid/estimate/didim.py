"""DIDIM and IDIM-IV: regressions on the motion of the simulated loop."""

import dataclasses
import time

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..errors import FitError
from ..parameters import Bounds, write_values
from ..recording import Recordings
from ..simulation.batch import compared_torques
from ..simulation.loop import ClosedLoop
from ..simulation.runs import Simulated, simulate
from .idim import Solved, Stacked, Weights, regression_fit, solve, stack
from .regression import Filtering, linear_parameters
from .result import AbstractMethod, Fit, Status


def physical(loop: ClosedLoop, theta: Float[np.ndarray, " parameters"]) -> ClosedLoop:
    """The loop at values moved inside their bounds; the unchanged loop if that is not enough.

    **Arguments:**

    - `theta`: values of the parameters in which torque is linear, `(parameters,)`.
    """
    moved, inertia = _moved(loop, jax.device_put(theta))
    return moved if float(inertia) > 0 else loop


@compiled
def _moved(
    loop: ClosedLoop, theta: Float[Array, " parameters"]
) -> tuple[ClosedLoop, Float[Array, ""]]:
    chosen = linear_parameters(loop)
    moved = write_values(loop, chosen, Bounds.of(chosen).moved_inside(theta))
    return moved, moved.arm.smallest_inertia()


def _explaining(recordings: Recordings, runs: tuple[Simulated, ...]) -> list[Simulated]:
    """The simulated motion, with the measured torque to explain."""
    return [
        eqx.tree_at(lambda s: s.tau, run, recording.tau)
        for run, recording in zip(runs, recordings, strict=True)
    ]


def _explained(loop: ClosedLoop, recordings: Recordings, runs: tuple[Simulated, ...]) -> bool:
    """Whether the residual of every joint is smaller than its measured torque."""
    torques = compared_torques(loop, recordings, [np.asarray(run.tau) for run in runs])
    pairs = list(zip(*torques, strict=True))
    left = sum(np.sum((m - s) ** 2, axis=0) for m, s in pairs)
    return bool(np.all(left <= 1.05**2 * sum(np.sum(m**2, axis=0) for m, _ in pairs)))


class _Iterated(AbstractMethod):
    filtering: eqx.AbstractVar[Filtering]
    weights: eqx.AbstractVar[Weights]
    tolerance: eqx.AbstractVar[float]
    max_steps: eqx.AbstractVar[int]
    rigid = True

    def solve_once(
        self, loop: ClosedLoop, recordings: Recordings, motions: list[Simulated]
    ) -> tuple[Stacked, Solved]:
        """One regression on the simulated motion."""
        raise NotImplementedError

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Alternates simulation and regression; called by `jaxid.fit`."""
        started = time.perf_counter()
        status, stacked, solved, before = Status.max_steps, None, None, None
        count = 0
        while count < self.max_steps:
            count += 1
            runs = simulate(loop, recordings)
            if not all(np.isfinite(run.q).all() and np.isfinite(run.a).all() for run in runs):
                status = Status.diverged
                break
            stacked, solved = self.solve_once(loop, recordings, _explaining(recordings, runs))
            moved = physical(loop, solved.theta)
            if moved is loop:
                # Another regression on the same motion would give the same and seem converged.
                status = Status.unphysical
                break
            loop = moved
            change = np.inf if before is None else np.abs(solved.theta - before)
            if np.all(change <= self.tolerance * np.abs(solved.theta)):
                settled = _explained(loop, recordings, runs)
                status = Status.converged if settled else Status.misfit
                break
            before = solved.theta
        if stacked is None or solved is None:
            raise FitError(
                f"{type(self).__name__} cannot start: the loop diverges in simulation at its "
                "initial values; start from the result of IDIM"
            )
        found = regression_fit(loop, recordings, self, stacked, solved, started, status, count)
        if found.status is not Status.misfit:
            return found
        note = "at these values a joint's residual is larger than its measured torque"
        return dataclasses.replace(found, notes=(*found.notes, note))


class DIDIM(_Iterated):
    """Pseudo-linear regression, equation (10): regressors of the simulated closed loop.

    (Gautier, Janot, Vandanjon 2013.)

    **Arguments:**

    - `filtering`: parallel filter and decimation of torque and columns.
    - `weights`: as for `IDIM`.
    - `tolerance`: relative change of every parameter at which it stops.
    - `max_steps`: largest number of simulations.
    """

    filtering: Filtering = Filtering()
    weights: Weights = eqx.field(static=True, default="joint")
    tolerance: float = 0.025
    max_steps: int = eqx.field(static=True, default=20)

    def solve_once(
        self, loop: ClosedLoop, recordings: Recordings, motions: list[Simulated]
    ) -> tuple[Stacked, Solved]:
        """Least squares on the simulated motion."""
        stacked = stack(loop, recordings, self.filtering, motions)
        names = tuple(name for p in linear_parameters(loop) for name in p.names)
        return stacked, solve(stacked, names, self.weights)


class IDIMIV(_Iterated):
    """Instrumental variables: regressors of the measured motion, instruments of the simulated.

    (Janot, Vandanjon, Gautier 2014.)

    **Arguments:**

    - `filtering`: filter of the measured motion; parallel filter and decimation of all signals.
    - `weights`: as for `IDIM`.
    - `tolerance`: relative change of every parameter at which it stops.
    - `max_steps`: largest number of simulations.
    """

    filtering: Filtering = Filtering()
    weights: Weights = eqx.field(static=True, default="joint")
    tolerance: float = 0.025
    max_steps: int = eqx.field(static=True, default=20)

    def solve_once(
        self, loop: ClosedLoop, recordings: Recordings, motions: list[Simulated]
    ) -> tuple[Stacked, Solved]:
        """Instrumental variables with the simulated motion's columns."""
        measured = stack(loop, recordings, self.filtering)
        instruments = stack(loop, recordings, self.filtering, motions)
        names = tuple(name for p in linear_parameters(loop) for name in p.names)
        return measured, solve(measured, names, self.weights, instruments.columns)
