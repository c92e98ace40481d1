"""Constrained descent from random references within the limits."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import LimitsError
from ..signals.fourier import fourier_basis
from ._information import closed_loop_columns, torque_along
from .design import SLACK, Design, feasible_share, margins_and_slopes, score_and_slope, score_of
from .limits import margins_along

# Factor by which the grid on which a result is checked is finer.
_FINER = 10

# Violated points are added to the constraints this many times before the step is shortened.
_EXCHANGES = 4


def random_references(
    design: Design,
    centre: Float[np.ndarray, " numbers"],
    count: int,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "count numbers"], Float[np.ndarray, " count"]]:
    """Random references as large as the limits allow, and their scores.

    **Arguments:**

    - `centre`: free numbers of the pose from which they are scaled.
    """
    rng = np.random.default_rng(seed)
    joints = design.base.shape[1]
    span = (design.limits.high - design.limits.low) / 2
    drawn = rng.normal(size=(count, *design.shape)) * span
    # The amplitude of a joint is proportional to its range of position, times a random factor.
    drawn *= rng.uniform(0.3, 1.5, (count, 1, joints))
    drawn = centre + drawn.reshape(count, -1)
    shares = jax.lax.map(
        lambda z: feasible_share(design, z, jnp.asarray(centre)), jnp.asarray(drawn), batch_size=50
    )
    drawn = centre + np.asarray(shares)[:, None] * (drawn - centre)
    scores = jax.lax.map(lambda z: score_of(design, z), jnp.asarray(drawn), batch_size=50)
    return drawn, np.where(np.isfinite(scores), np.asarray(scores), np.inf)


def _dips(margins: Float[np.ndarray, "points kinds"]) -> np.ndarray:
    """Points nearest to each limit, and their neighbours; bool, (points, kinds)."""
    before, after = np.roll(margins, 1, axis=0), np.roll(margins, -1, axis=0)
    nearest = (margins <= before) & (margins <= after)
    return nearest | np.roll(nearest, 1, axis=0) | np.roll(nearest, -1, axis=0)


def _active(margins: Float[np.ndarray, "points kinds"], reach: float) -> np.ndarray:
    """Points where limits may become active; bool, (points, kinds)."""
    coarse = np.zeros_like(margins, bool)
    coarse[::8] = True
    return (margins < 1.5 * reach) & (_dips(margins) | coarse)


def improved(
    design: Design,
    z: Float[np.ndarray, " numbers"],
    centre: Float[np.ndarray, " numbers"],
    rounds: int,
    say: Callable[[str], None],
) -> Float[np.ndarray, " numbers"]:
    """Constrained descent: SLSQP within a trust region, on the points where limits are near.

    After each round the points are chosen again, and the reference is shrunk until it keeps the
    limits everywhere. The best of these references is the result.
    """
    best, best_score = z, float(score_of(design, jnp.asarray(z)))
    reach = 0.5
    scale = np.tile((design.limits.high - design.limits.low) / 2, design.shape[0])
    for k in range(rounds):
        found = _descend(design, best, reach, reach * scale)
        share = float(feasible_share(design, jnp.asarray(found), jnp.asarray(centre)))
        inside = centre + share * (found - centre)
        score = float(score_of(design, jnp.asarray(inside)))
        gained = best_score - score
        say(f"round {k + 1}: {score:.4f}, {100 * share:.1f} % of the step, reach {reach:.2f}")
        if np.isfinite(score) and gained > 0:
            best, best_score = inside, score
        reach = min(1.0, 1.5 * reach) if share > 0.98 else reach / 2.5
        if (abs(gained) < 1e-3 and share > 0.98) or reach < 0.01:
            break
    return best


def _descend(
    design: Design,
    z: Float[np.ndarray, " numbers"],
    reach: float,
    box: Float[np.ndarray, " numbers"],
) -> Float[np.ndarray, " numbers"]:
    """SLSQP from a reference that keeps all limits, within a box around it.

    If the result violates a limit at a point that was not imposed, that point is imposed too, and
    the descent continues (exchange method, Hettich and Kortanek 1993).
    """
    low, high, found = z - box, z + box, z
    imposed = _active(_margins_at(design, z), reach)
    for _ in range(_EXCHANGES):
        found = _descend_on(design, found, np.stack([low, high], axis=1), imposed)
        margins = _margins_at(design, found)
        passed = (margins < SLACK) & _dips(margins) & ~imposed
        if not passed.any():
            break
        imposed |= passed
    return found


def _margins_at(
    design: Design, z: Float[np.ndarray, " numbers"]
) -> Float[np.ndarray, "points kinds"]:
    return np.asarray(margins_and_slopes(design, jnp.asarray(z))[0])


def _descend_on(
    design: Design,
    z: Float[np.ndarray, " numbers"],
    bounds: Float[np.ndarray, "numbers 2"],
    imposed: np.ndarray,
) -> Float[np.ndarray, " numbers"]:
    """SLSQP with limits imposed at points, bool (points, kinds)."""
    import scipy

    points, kinds = np.nonzero(imposed)

    def limits(x):
        return _margins_at(design, x)[points, kinds] - 2 * SLACK

    def slopes(x):
        return np.asarray(margins_and_slopes(design, jnp.asarray(x))[1])[points, kinds]

    def score(x):
        value, slope = score_and_slope(design, jnp.asarray(x))
        return float(value), np.asarray(slope)

    found = scipy.optimize.minimize(
        score,
        z,
        jac=True,
        method="SLSQP",
        bounds=bounds,
        constraints={"type": "ineq", "fun": limits, "jac": slopes},
        options={"maxiter": 30, "ftol": 1e-4},
    )
    return found.x if np.isfinite(found.x).all() else z


def shrunk(
    design: Design, z: Float[np.ndarray, " numbers"], centre: Float[np.ndarray, " numbers"]
) -> Float[np.ndarray, " numbers"]:
    """The reference, shrunk towards a pose until limits also hold between grid points."""
    share = 1.0
    for _ in range(60):
        at = centre + share * (z - centre)
        if float(all_margins(design, at)[0].min()) >= 0:
            return at
        share *= 0.995 if share > 0.9 else 0.95
    raise LimitsError("no reference was found within all limits: widen them")


def all_margins(
    design: Design, z: Float[np.ndarray, " numbers"]
) -> tuple[Float[np.ndarray, "kinds"], Float[np.ndarray, "kinds"]]:
    """The smallest margin to each limit on the fine grid, for the reference and the tracking."""
    count = _FINER * max(len(design.time), round(design.period * 1.0) * 100)
    time = np.arange(count) * design.period / count
    coefficients = np.asarray(design.coefficients(z))
    harmonics = (len(coefficients) - 1) // 2
    signals = jnp.asarray(fourier_basis(time, design.period, harmonics) @ coefficients)
    tau = torque_along(design.loop, jnp.asarray(time), signals)
    rows, inside = margins_along(design.limits, signals, tau)
    smallest = np.concatenate([np.asarray(rows).min(axis=0).ravel(), np.asarray(inside).min(0)])
    # Upper bound of a series of this many harmonics between points of the fine grid, relative to
    # its largest value on them (Ehlich and Zeller 1964).
    smallest = smallest - (1 / np.cos(np.pi * harmonics / count) - 1)
    if design.settings.kind != "closed-loop":
        return smallest, smallest
    at = jnp.asarray(design.sampled @ coefficients)
    seen, _ = closed_loop_columns(design.loop, design.samples, at)
    moved = jnp.stack([seen[:, 1], seen[:, 2], jnp.zeros_like(seen[:, 1])])
    rows, inside = margins_along(design.limits, moved, seen[:, 0])
    tracked = np.concatenate([np.asarray(rows).min(axis=0).ravel(), np.asarray(inside).min(0)])
    return np.minimum(smallest, tracked), smallest
