"""The error of estimates that the noise of the recorded motion causes."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..recording import Recording
from ..signals.encoder import position_errors
from ..simulation.dynamics import imposed
from ..simulation.perturbed import with_errors
from .minimise import Point, Problem, linearisation


def slope_by_motion_noise(
    problem: Problem, point: Point, pieces: Sequence[Recording]
) -> Float[np.ndarray, " values"] | None:
    """Mean of J'r at the true values, because residual and derivatives contain the same noise.

    Along a recorded motion the noise of the encoders makes inertias too small (errors in
    variables). Noise of the same strength is added to the positions, with both signs, and the mean
    change of J'r is that by the noise of the recording (Cook and Stefanski 1994).

    **Arguments:**

    - `problem`: whose batch was prepared from `pieces`. `point`: its optimum.

    **Returns:** a value for each parameter and coefficient of the problem; None if the motion is
    simulated or has no noise.
    """
    if not imposed(problem.loop):
        return None
    drawn = position_errors(pieces, 1)
    if not drawn:
        return None
    # The terms of first order cancel in a pair of opposite errors, and one pair gives the mean to a
    # tenth.
    slopes = []
    for sign in (1, -1):
        errors = [sign * error for error in drawn[0]]
        batch = with_errors(problem.loop, pieces, problem.batch, errors)
        at = linearisation(dataclasses.replace(problem, batch=batch))(point.theta, point.start)
        slopes.append(_slope(at))
    found = np.mean(slopes, axis=0) - _slope(point)
    return found if np.isfinite(found).all() else None


def _slope(point: Point) -> Float[np.ndarray, " values"]:
    return np.sum(np.asarray(point.sums.slope), axis=0)
