"""The `Fit` of a minimisation."""

import dataclasses

import numpy as np

from ..noise import Noise, VectorAR
from ..recording import Recordings
from ..simulation.batch import compared
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from .converge import Converged
from .covariance import SAID, Deviations, covariance_of
from .minimise import with_derivatives
from .motion_noise import slope_by_motion_noise
from .pieces import rejoined
from .result import AbstractMethod, Fit, relative_errors, unphysical


def report(
    kind: Deviations,
    done: Converged,
    recordings: Recordings,
    seconds: float,
    method: AbstractMethod,
    noise: Noise = None,
    rounds: int = 0,
) -> Fit:
    """The `Fit` of a minimisation.

    **Arguments:**

    - `method`: as shown by results. `kind`: kind of deviations.
    - `seconds`: duration. `noise`: the estimated filters. `rounds`: number of alternations.
    """
    found, mask = done.minimum.point.found, np.asarray(done.batch.kept)
    p = len(done.loop.names)
    covariance, lost, said = np.full((p, p), np.inf), (), ""
    optimum = done.optimum
    if done.minimum.status.simulated:
        whole = with_derivatives(done.problem, done.minimum.point)
        by_motion = slope_by_motion_noise(done.problem, done.minimum.point, done.pieces)
        optimum = dataclasses.replace(optimum, by_motion=by_motion)
        covariance, lost = covariance_of(optimum, kind, noise, whole)
        said = SAID[kind]
    raw, weights = np.asarray(found.raw), np.asarray(done.weights)
    unweighted = [raw[k][mask[k]] / weights for k in range(len(done.pieces))]
    n = done.loop.joints
    measured = [getattr(piece, done.signals[0]) for piece in done.pieces]
    measured = compared(done.loop, done.pieces, measured)
    errors = [r[:, :n] for r in unweighted]
    measured, errors = rejoined(recordings, done.pieces, measured, errors)
    # For a simulated motion the minimisation has checked it at every step.
    wrong = unphysical(done.loop) if imposed(done.loop) else []
    notes = (*_at_bounds(done.loop), *wrong, *done.minimum.notes)
    return Fit(
        loop=done.loop,
        recordings=recordings,
        method=method,
        status=done.minimum.status,
        covariance=covariance,
        residuals=tuple(errors),
        error_percent=relative_errors(recordings, measured, errors),
        iterations=done.iterations,
        seconds=seconds,
        deviations=said,
        undetermined=lost,
        notes=notes,
        noise=noise if noise is None or isinstance(noise, VectorAR) else tuple(noise),
        rounds=rounds,
        optimum=optimum,
    )


def _at_bounds(loop: ClosedLoop) -> list[str]:
    notes = []
    for p in loop.free_parameters:
        value = np.ravel(np.asarray(p.where(loop)))
        for bound, word in ((p.declaration.lower, "lower"), (p.declaration.upper, "upper")):
            if np.isfinite(bound) and np.any(np.abs(value - bound) < 1e-9 * p.declaration.scale):
                unit = " or ".join(dict.fromkeys(loop.units(p)))
                notes.append(f"{p.name} is at its {word} bound, {bound:g} {unit}")
    return notes
