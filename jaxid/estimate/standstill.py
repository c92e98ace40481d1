"""The speed below which a joint's torque is no function of its motion."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ..control import AbstractController, Tracking
from ..control.tracking import STILL
from ..recording import Recording
from ..signals.smoothing import even_times, smooth_motion
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from .result import Fit

# Factor on the share of the highest speed, the largest share (more would leave out motion), and the
# largest reach in periods of the cutoff.
_FACTOR, _LARGEST, _FARTHEST = 3.0, 0.1, 2.0
# Ratio of mean squares above which samples are left out.
_LARGER = 2.0
# Smallest number of samples that are worth leaving out, and for the coefficients below.
_FEW = 80
# Knots of a friction curve in multiples of the speed of standstill, and of presliding in multiples
# of the distance up to which samples are left out.
_SPEEDS, _DISTANCES = np.geomspace(0.1, 10, 9), np.geomspace(1e-3, 1, 8)


def raised(found: Fit) -> Tracking | None:
    """The controller with a larger `still` or `reach` for joints whose torque is not described.

    Static friction is no function of motion. A joint that creeps or sticks below a speed leaves
    residuals there that bend the whole model, and the low-pass spreads them. The residual of the
    samples that would be left out, minus what functions of speed, of the distance since the last
    reversal, and of direction explain (a friction curve or presliding that the model lacks), is
    compared with that of fast samples.

    **Arguments:**

    - `found`: a fit along the recorded motion.

    **Returns:** None if no joint needs it.
    """
    law, optimum = found.loop.controller, found.optimum
    if not isinstance(law, Tracking) or law.cutoff is None or optimum is None:
        return None
    band = optimum.problem.batch.band
    if not imposed(found.loop) or band is None or len(band.rows) != len(found.recordings):
        return None
    keep = np.asarray(band.keep)
    rows = [np.asarray(row)[there] for row, there in zip(band.rows, keep, strict=True)]
    still, reach = (np.array(x) for x in (law.still, law.reach))
    slower = np.where(still * _FACTOR <= _LARGEST, still * _FACTOR, still)
    # The reach first: samples beside standstill would count as slow ones that are not described.
    for name, before, after in (
        ("reach", reach, np.full_like(reach, _FARTHEST)),
        ("still", still, slower),
    ):
        proposed = dataclasses.replace(law, **{name: after})
        needed = _undescribed(found, proposed, rows) & (after > before)
        if needed.any():
            return dataclasses.replace(law, **{name: np.where(needed, after, before)})
    return None


def slow_note(given: AbstractController, loop: ClosedLoop) -> list[str]:
    """A note on joints whose torque is not compared at low speed because of a fit.

    **Arguments:**

    - `given`: the controller before the fit. `loop`: the fitted loop.
    """
    law = loop.controller
    if not isinstance(law, Tracking) or law.still is None:
        return []
    if isinstance(given, Tracking) and given.still is not None:
        return []
    shares = np.zeros(loop.joints) + np.asarray(law.still)
    said = [f"{100 * x:.2g} % on joint {j + 1}" for j, x in enumerate(shares) if x > STILL]
    if not said:
        return []
    return [
        "torque at low speed is no function of the motion (static friction) and is not compared: "
        f"below {', '.join(said)} of the highest speed"
    ]


def _undescribed(
    found: Fit, proposed: Tracking, rows: Sequence[Int[np.ndarray, " _"]]
) -> Bool[np.ndarray, " joints"]:
    """For which joints the samples that a controller leaves out are worth leaving out.

    **Arguments:**

    - `rows`: the samples of each recording that the fit compares.
    """
    cutoff, batch = proposed.cutoff, found.optimum.problem.batch
    assert cutoff is not None
    motions = [_motion(r, cutoff) for r in found.recordings]
    gone = []
    for recording, at, rest in zip(found.recordings, rows, found.residuals, strict=True):
        kept = proposed.moving(recording, cutoff)
        assert kept is not None
        gone.append((rest != 0) & ~kept[at])
    speed = np.concatenate([v[at] for (v, _), at in zip(motions, rows, strict=True)])
    away = np.concatenate([x[at] for (_, x), at in zip(motions, rows, strict=True)])
    rest, left_out = np.concatenate(found.residuals), np.concatenate(gone)
    fast = (rest != 0) & ~left_out & (np.abs(speed) > _LARGEST)
    enough = (left_out.sum(axis=0) >= _FEW) & (fast.sum(axis=0) >= _FEW)
    larger = np.zeros(rest.shape[1], bool)
    for j in np.flatnonzero(enough):
        far = float(np.quantile(away[left_out[:, j], j], 0.9))
        curves = [_curves(v[:, j], x[:, j], far) for v, x in motions]
        size = batch.mask.shape[1]
        padded = np.stack([np.pad(c, ((0, size - len(c)), (0, 0))) for c in curves])
        passed = np.asarray(batch.compared(np.repeat(padded[:, :, None], len(enough), axis=2)))
        basis = np.concatenate(
            [x[keep] for x, keep in zip(passed[:, :, j], batch.kept, strict=True)]
        )
        own, r = basis[left_out[:, j]], rest[left_out[:, j], j]
        left = r - own @ np.linalg.lstsq(own, r, rcond=1e-6)[0]
        power = left @ left / (len(r) - own.shape[1])
        larger[j] = power > _LARGER * np.mean(rest[fast[:, j], j] ** 2)
    return larger


def _motion(
    recording: Recording, cutoff: float
) -> tuple[Float[np.ndarray, "samples joints"], Float[np.ndarray, "samples joints"]]:
    """Speed over its maximum, and the distance since the last reversal."""
    q = smooth_motion(recording, cutoff)
    v = np.gradient(q, even_times(recording), axis=0)
    turned = np.zeros(q.shape, int)
    turned[1:] = np.where(v[1:] * v[:-1] < 0, np.arange(1, len(q))[:, None], 0)
    last = np.maximum.accumulate(turned, axis=0)
    away = np.abs(q - np.take_along_axis(q, last, axis=0))
    return v / np.maximum(np.abs(v).max(axis=0), 1e-300), away


def _curves(
    speed: Float[np.ndarray, " samples"], away: Float[np.ndarray, " samples"], far: float
) -> Float[np.ndarray, "samples curves"]:
    """Functions of speed and of the distance since a reversal, for each direction.

    They are piecewise linear in the logarithm.
    """
    hats = [
        np.interp(np.log(np.maximum(x, 1e-300)), np.log(scale * knots), row)
        for x, scale, knots in ((np.abs(speed), STILL, _SPEEDS), (away, far, _DISTANCES))
        for row in np.eye(len(knots))
    ]
    hats = np.stack(hats, axis=1)
    return np.hstack([hats, hats * np.sign(speed)[:, None]])
