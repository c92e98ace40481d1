"""The output-error method: simulation of the closed loop, with exact derivatives."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jax.sharding import Mesh

from ..display.progress import working
from ..recording import Recordings
from ..simulation.batch import Batch, prepare
from ..simulation.integrals import has_other_states
from ..simulation.loop import ClosedLoop
from ..simulation.runs import simulate
from ..simulation.steps import set_substeps, with_substeps
from .converge import Converged, converge, fewer_substeps, finer_substeps
from .covariance import Deviations
from .minimise import check_solver
from .pieces import Output, compared_signals, pieces_of
from .reporting import report
from .result import AbstractMethod, Fit
from .start import start_values


class OEM(AbstractMethod):
    """Output error, equations (7) and (9) of Brunot et al. 2016, by Levenberg–Marquardt.

    It fits all recordings at once, weights each output by the inverse of its deviation, and keeps
    values physical.

    **Arguments:**

    - `output`: the compared signal: `"torque"`, `"position"` or `"both"`; by default torque, but
      position if the recorded torque drives the arm.
    - `start`: `"auto"` starts from the best of the loop's own values, those of IDIM and, if both
      leave more than a fifth of the torque, those of DIDIM; `"given"` from the loop's values.
    - `initial`: `"rest"` uses the first sample, `"free"` estimates every initial state, `"auto"`
      estimates those of recordings that do not start at rest.
    - `window`: length in s of pieces that are simulated separately, each from its own estimated
      state (multiple shooting); None for whole recordings.
    - `deviations`: `"sandwich"` for coloured residuals, `"newey_west"` for errors whose size
      depends on the motion, `"white"` for (A.1), `"paper"` for (A.1) as printed in the paper.
    - `tolerance`: it stops when a step is shorter than this many standard deviations.
    - `max_steps`: largest number of iterations, those for better weights included.
    - `max_seconds`: time limit, checked between iterations; the values so far are returned.
    - `progress`: whether to show progress on a terminal.
    - `solver`: an optimistix least-squares solver or minimiser instead of jaxid's own
      Levenberg–Marquardt. It stops by its own tolerances and treats initial states as additional
      parameters. Bounds are enforced by a change of variables, so an estimate can approach a bound
      but not reach it.
    - `mesh`: a `jax.sharding.Mesh` whose devices share the recordings; results stay the same.
    """

    output: Output | None = eqx.field(static=True, default=None)
    start: Literal["auto", "given"] = eqx.field(static=True, default="auto")
    initial: Literal["auto", "rest", "free"] = eqx.field(static=True, default="auto")
    window: float | None = eqx.field(static=True, default=None)
    deviations: Deviations = eqx.field(static=True, default="sandwich")
    tolerance: float = 1e-2
    max_steps: int = eqx.field(static=True, default=100)
    max_seconds: float = eqx.field(static=True, default=math.inf)
    progress: bool = eqx.field(static=True, default=True)
    solver: Any = None
    mesh: Mesh | None = eqx.field(static=True, default=None)

    def __repr__(self) -> str:
        changed = [
            f"{field.name}={value!r}"
            for field in dataclasses.fields(self)
            if field.name not in ("progress", "mesh", "solver")
            and (value := getattr(self, field.name)) != field.default
        ]
        if self.solver is not None:
            changed.append(f"solver={type(self.solver).__name__}")
        return f"OEM({', '.join(changed)})"

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the loop's free parameters; called by `jaxid.fit`."""
        started = time.perf_counter()
        # Inconsistent inputs are refused before the computation.
        compared_signals(self, loop)
        check_solver(self.solver, self.mesh)
        batch = prepare(loop, pieces_of(recordings, self.window))
        deadline = started + self.max_seconds
        with working(f"OEM of {loop.name}", self.progress) as say:
            done = self._from_start(loop, recordings, say, deadline, batch)
            kept = recordings
            if not done.minimum.status.simulated:
                kept = _without_diverging(done.loop, recordings)
            if len(kept) < len(recordings):
                done = self._from_start(loop, kept, say, deadline)
            error = math.inf
            for _ in range(_REFINED):
                finer, error = finer_substeps(done, error)
                if finer is None or time.perf_counter() > deadline:
                    break
                say(f"again with {finer} steps between samples")
                finer_loop = set_substeps(done.loop, finer, settled=True)
                again = converge(
                    self, finer_loop, kept, say, deadline=deadline, weights=done.weights
                )
                if not again.minimum.status.simulated:
                    break
                done = again
            fewer = fewer_substeps(done, kept, error)
            if fewer is not None:
                coarser = set_substeps(done.loop, fewer, settled=True)
                done = dataclasses.replace(done, loop=coarser)
        seconds = time.perf_counter() - started
        found = report(self.deviations, done, kept, seconds, self)
        more = (*_left_out(recordings, kept), *self._forgotten(loop))
        return dataclasses.replace(found, notes=(*found.notes, *more))

    def _forgotten(self, loop: ClosedLoop) -> list[str]:
        """A note on states that are reset in every window."""
        if self.window is None:
            return []
        own = [e.effect_name() for e in loop.effects if e.initial_state().size]
        own += [type(loop.controller).__name__] if has_other_states(loop) else []
        if not own:
            return []
        said = "in every window the states of {} start at rest, which may bias the estimates"
        return [f"{said.format(', '.join(own))}: compare with a fit without window"]

    def _from_start(
        self,
        loop: ClosedLoop,
        recordings: Recordings,
        say: Callable[[str], None],
        deadline: float,
        batch: Batch | None = None,
    ) -> Converged:
        whole = batch if self.window is None else None
        loop = start_values(loop, recordings, self.start, say, whole)
        loop = with_substeps(loop, recordings)
        return converge(self, loop, recordings, say, deadline=deadline, batch=batch)


# How often the number of steps is raised after a fit.
_REFINED = 3


def _without_diverging(loop: ClosedLoop, recordings: Recordings) -> Recordings:
    """The recordings along which the loop can be simulated; all recordings if there are none."""
    runs = simulate(loop, recordings)
    sound = [np.isfinite(run.states).all() and np.isfinite(run.tau).all() for run in runs]
    kept = [r for r, good in zip(recordings, sound, strict=True) if good]
    return Recordings.of(kept) if kept else recordings


def _left_out(recordings: Recordings, kept: Recordings) -> list[str]:
    gone = [name for name in recordings.names if name not in kept.names]
    if not gone:
        return []
    return [
        f"{len(gone)} of {len(recordings)} recordings left out, because the simulation along them "
        f"diverges: {', '.join(gone)}"
    ]


def oem_of(fit: object) -> OEM:
    """The `OEM` that a fit's method is or contains; the default one if it has none."""
    method = getattr(fit, "method", None)
    method = getattr(method, "oem", method)
    return method if isinstance(method, OEM) else OEM()
