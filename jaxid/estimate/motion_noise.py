"""The error of estimates that the noise of the recorded motion causes."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..recording import Recording
from ..signals.encoder import position_noise
from ..simulation.dynamics import imposed
from ..simulation.perturbed import with_errors
from .minimise import Point, Problem, linearisation

# Number of pairs of opposite draws. The terms of first order cancel within a pair, and one pair
# gives the mean to a tenth.
_PAIRS = 1


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
    levels = [position_noise(piece) for piece in pieces]
    if not any(np.any(level > 0) for level in levels):
        return None
    rng, slopes = np.random.default_rng(0), []
    for _ in range(_PAIRS):
        errors = [
            level * rng.standard_normal(piece.q.shape)
            for piece, level in zip(pieces, levels, strict=True)
        ]
        for sign in (1, -1):
            batch = with_errors(problem.loop, pieces, problem.batch, [sign * e for e in errors])
            at = linearisation(dataclasses.replace(problem, batch=batch))(point.theta, point.start)
            slopes.append(_slope(at))
    found = np.mean(slopes, axis=0) - _slope(point)
    return found if np.isfinite(found).all() else None


def _slope(point: Point) -> Float[np.ndarray, " values"]:
    return np.sum(np.asarray(point.sums.slope), axis=0)
