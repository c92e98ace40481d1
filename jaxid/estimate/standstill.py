"""The speed below which a joint's torque is no function of its motion."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ..recording import Recording
from ..signals.smoothing import smooth_samples
from ..signals.standstill import STILL, Standstill
from ..simulation.batch import motion_cutoff
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from .result import Fit, Status

# Factor on the share of the highest speed, the largest share (more would leave out motion), and the
# largest reach in periods of the cutoff.
_FACTOR, _LARGEST, _FARTHEST = 3.0, 0.1, 2.0
# Ratio of mean squares above which samples are left out. A friction curve or presliding, which the
# curves below describe only approximately, leaves up to 2.2; a joint that sticks, 16 and more.
_LARGER = 3.0
# Smallest number of samples that are worth leaving out, and for the coefficients below.
_FEW = 80
# Knots of a friction curve in multiples of the speed of standstill, and of presliding in multiples
# of the distance up to which samples are left out.
_SPEEDS, _DISTANCES = np.geomspace(0.1, 10, 9), np.geomspace(1e-3, 1, 8)


def raised(found: Fit) -> Standstill | None:
    """Settings with a larger `still` or `reach` for joints whose torque is not described.

    Static friction is no function of motion. A joint that creeps or sticks below a speed leaves
    residuals there that bend the whole model, and the low-pass spreads them. The residual of the
    samples that would be left out, minus what functions of speed, of the distance since the last
    reversal, and of direction explain (a friction curve or presliding that the model lacks), is
    compared with that of fast samples.

    **Arguments:**

    - `found`: a fit along the recorded motion.

    **Returns:** None if no joint needs it.
    """
    loop = found.loop
    if not (loop.controller.imposes and imposed(loop) and _has_rows(found)):
        return None
    here = loop.standstill
    still, reach = (np.array(x) for x in (here.still, here.reach))
    slower = np.where(still * _FACTOR <= _LARGEST, still * _FACTOR, still)
    # The reach first: samples beside standstill would count as slow ones that are not described.
    for name, before, after in (
        ("reach", reach, np.full_like(reach, _FARTHEST)),
        ("still", still, slower),
    ):
        needed = _undescribed(found, dataclasses.replace(here, **{name: after})) & (after > before)
        if needed.any():
            return dataclasses.replace(here, **{name: np.where(needed, after, before)})
    return None


def worst_at_standstill(found: Fit) -> Standstill | None:
    """Settings that leave out standstill, if the torque of a joint is described worst there.

    Under a simulated law all samples are compared, because backlash or elasticity that a model
    lacks are visible at reversals. If no model describes them, the friction at standstill is of
    another kind.

    **Arguments:**

    - `found`: a fit under a simulated law.

    **Returns:** None if no joint needs it, if the settings were given, and for a misfit.
    """
    loop = found.loop
    if loop.controller.imposes or not loop.standstill.chosen or not _has_rows(found):
        return None
    if found.status is Status.misfit:
        return None
    cutoff = motion_cutoff(loop.controller, found.recordings)
    usual = Standstill().settled(loop.joints, imposed=True).within(found.recordings, cutoff)
    rest, slow, speed, _ = _slow(found, usual, _motions(found))
    fast = (rest != 0) & ~slow & (np.abs(speed) > _LARGEST)
    counts = [np.sum(there, axis=0) for there in (slow, fast)]
    powers = [
        np.sum(rest**2 * there, axis=0) / np.maximum(count, 1)
        for there, count in zip((slow, fast), counts, strict=True)
    ]
    worse = (np.minimum(*counts) >= _FEW) & (powers[0] > _LARGER * powers[1])
    # A fit through noise filters may hide it on some joints; their friction is of one kind.
    return usual if worse.any() else None


def _has_rows(found: Fit) -> bool:
    """Whether a fit has a residual of torque with the samples of whole recordings."""
    optimum = found.optimum
    if optimum is None or optimum.problem.signals != ("tau",):
        return False
    return len(optimum.problem.batch.mask) == len(found.recordings)


def slow_note(given: Standstill, loop: ClosedLoop) -> list[str]:
    """A note on joints whose torque is not compared at low speed because of a fit.

    **Arguments:**

    - `given`: the settings before the fit. `loop`: the fitted loop.
    """
    if given.still is not None or loop.standstill.still is None:
        return []
    shares = np.zeros(loop.joints) + np.asarray(loop.standstill.still)
    usual = STILL if loop.controller.imposes else 0.0
    said = [f"{100 * x:.2g} % on joint {j + 1}" for j, x in enumerate(shares) if x > usual]
    if not said:
        return []
    return [
        "torque at low speed is no function of the motion (static friction) and is not compared: "
        f"below {', '.join(said)} of the highest speed"
    ]


def _undescribed(found: Fit, proposed: Standstill) -> Bool[np.ndarray, " joints"]:
    """For which joints the samples that the settings leave out are worth leaving out."""
    batch = found.optimum.problem.batch
    motions = _motions(found)
    rest, left_out, speed, away = _slow(found, proposed, motions)
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


def _slow(
    found: Fit, proposed: Standstill, motions: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, ...]:
    """Residual, what the settings leave out, speed over its maximum, and distance since reversal.

    Each is `(samples, joints)`, for the compared samples of all recordings.

    **Arguments:**

    - `motions`: speed and distance along each recording.
    """
    parts, cutoff = [], motion_cutoff(found.loop.controller, found.recordings)
    for recording, at, rest, (speed, away) in zip(
        found.recordings, _compared_samples(found), found.residuals, motions, strict=True
    ):
        gone = (rest != 0) & ~proposed.moving(recording, cutoff)[at]
        parts.append((rest, gone, speed[at], away[at]))
    return tuple(np.concatenate(x) for x in zip(*parts, strict=True))


def _motions(found: Fit) -> list[tuple[np.ndarray, np.ndarray]]:
    """Speed and distance along each recording, as of `_motion`."""
    cutoff = motion_cutoff(found.loop.controller, found.recordings)
    return [_motion(r, cutoff) for r in found.recordings]


def _compared_samples(found: Fit) -> list[Int[np.ndarray, " _"]]:
    """The samples of each recording that a fit compares."""
    band = found.optimum.problem.batch.band
    if band is None:
        return [np.arange(r.samples) for r in found.recordings]
    pairs = zip(band.rows, band.keep, strict=True)
    return [np.asarray(rows)[np.asarray(keep)] for rows, keep in pairs]


def _motion(
    recording: Recording, cutoff: float
) -> tuple[Float[np.ndarray, "samples joints"], Float[np.ndarray, "samples joints"]]:
    """Speed over its maximum, and the distance since the last reversal."""
    q = smooth_samples(recording, cutoff)
    v = np.gradient(q, recording.time, axis=0)
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
