"""`fit`, the entry point of all methods."""

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..arms import SerialArm, physical_bodies
from ..arms.physical import chance_of
from ..control import Sampled
from ..effects import AbstractEffect, AbstractTransmission, check_declared
from ..errors import FitError, MissingExtraError, ModelError
from ..recording import Recording, Recordings, missing_after
from ..simulation.batch import at_rest, motion_cutoff, prepare
from ..simulation.checks import check_joints, check_law, check_loop
from ..simulation.integrals import has_other_states, integral_states
from ..simulation.loop import ClosedLoop
from ..simulation.sharing import with_one_blas_thread
from .drawn import contradiction
from .mistakes import LARGE_PERCENT, at_limit, doubtful_law, likely_mistake
from .oem import OEM, oem_of
from .prior import drawing_notes
from .result import DOUBTFUL_PERCENT, AbstractMethod, Fit, Status
from .standstill import raised, slow_note

if TYPE_CHECKING:
    import pandas as pd


@with_one_blas_thread
def fit(
    loop: ClosedLoop,
    recordings: Recording | Recordings | Iterable[Recording],
    method: AbstractMethod | None = None,
) -> Fit:
    """Estimates the free parameters of a loop.

    **Arguments:**

    - `loop`: the model, at its start values.
    - `recordings`: one or several of the same robot.
    - `method`: `OEM()` by default.

    **Raises:** `FitError`, `RecordingError` or `ModelError` if the three do not match.
    """
    check_loop(loop)
    recordings = Recordings.of(recordings)
    check_joints(loop, recordings[0])
    check_law(loop)
    law, given = loop.controller, loop.standstill
    loop = dataclasses.replace(loop, controller=law.settled(recordings))
    if law.imposes:
        cutoff = motion_cutoff(loop.controller, recordings)
        still = given.settled(loop.joints, imposed=True).within(recordings, cutoff)
        loop = dataclasses.replace(loop, standstill=still)
    for effect in loop.effects:
        check_declared(effect, loop.joints)
    method = OEM() if method is None else method
    if not isinstance(method, AbstractMethod):
        raise FitError(f"{method!r} is not a method: give an object such as jaxid.OEM()")
    if not loop.names:
        raise FitError(
            f"{loop.name} has no free parameter to estimate: free one with loop.free(name)"
        )
    if method.rigid:
        _check_rigid(loop, method)
    found = method.fit(loop, recordings)
    while given.chosen and found.succeeded and (slower := raised(found)) is not None:
        again = method.fit(dataclasses.replace(loop, standstill=slower), recordings)
        if not again.succeeded:
            break
        found = again
    found = _followed(_doubted(_examined(_without_nan(found), loop)))
    notes = (*found.notes, *_matter(found), *drawing_notes(found), *_band(loop, recordings))
    notes = (*notes, *slow_note(given, found.loop), *_uncompared(found), *_gaps(recordings))
    notes = (*notes, *_begun(loop, recordings))
    return dataclasses.replace(found, notes=notes)


def _check_rigid(loop: ClosedLoop, method: AbstractMethod) -> None:
    """Raises `FitError` for a method that needs the true motion if an effect hides it."""
    for effect in loop.effects:
        sensor = type(effect).read is not AbstractEffect.read
        if sensor or isinstance(effect, AbstractTransmission):
            raise FitError(
                f"{type(method).__name__} assumes that the sensors measure the motion of drive and "
                f"link, which {effect.effect_name()} changes: use OEM, or leave the effect out"
            )


# The note needs a distance to physical bodies that has at most this probability by chance. Even one
# degree of freedom gives a larger one than the second number.
_CHANCE, _FAR = 0.01, 2.6


def _matter(found: Fit) -> list[str]:
    """A note if the base parameters of a serial arm do not belong to physical bodies.

    Needs the extra `sdp`; without it only the mass matrix is checked.
    """
    arm = found.loop.arm
    names = [p.names for p in found.loop.free_parameters if p.place == ("arm", "base")]
    if not isinstance(arm, SerialArm) or not names or not found.succeeded:
        return []
    at = [found.names.index(name) for name in names[0]]
    covariance = found.covariance[np.ix_(at, at)]
    if len(at) < len(arm.base) or not np.isfinite(covariance).all():
        return []
    try:
        nearest = physical_bodies(arm, covariance)
        if nearest.distance < _FAR or chance_of(arm, covariance, nearest) > _CHANCE:
            return []
    except (MissingExtraError, ModelError):
        return []
    moved = np.abs(nearest.base - np.asarray(arm.base)) / np.sqrt(np.diag(covariance))
    worst = names[0][int(np.argmax(moved))]
    return [
        f"no physical bodies have these base parameters: the nearest ones are "
        f"{nearest.distance:.3g} standard deviations away, mostly in {worst}, so the parameters "
        'may have absorbed an effect that the model lacks; bodies="drawn" makes it visible'
    ]


def _band(loop: ClosedLoop, recordings: Recordings) -> list[str]:
    """A note if torque is compared only below a frequency."""
    cutoff = loop.controller.comparable(recordings[0])
    if cutoff is None:
        return []
    return [f"torque is compared below {cutoff:.3g} Hz, up to which the recorded motion is known"]


def _begun(loop: ClosedLoop, recordings: Recordings) -> list[str]:
    """Notes on the states that the law has at the first sample of the recordings."""
    law = loop.controller
    who = type(law.law if isinstance(law, Sampled) else law).__name__
    notes = []
    if integral_states(loop).any():
        held = np.asarray(prepare(loop, recordings).intervals.integrals)[:, 0]
        names = [r.name for r, row in zip(recordings, held, strict=True) if row.any()]
        if names:
            notes.append(
                f"the integral of {who} is not zero at the first sample of {', '.join(names)}: "
                "its value there follows from the recorded torque"
            )
    moving = [r.name for r in recordings if not at_rest(r)]
    if moving and has_other_states(loop):
        notes.append(
            f"{who} has states that are no integrals, which start as `initial_state` gives them, "
            f"although the arm moves at the first sample of {', '.join(moving)}: begin a recording "
            "where it has been at rest"
        )
    return notes


def _uncompared(found: Fit) -> list[str]:
    """Notes on joints that have no compared sample in a recording."""
    if not found.loop.controller.imposes:
        return []
    return [
        f"joint {j + 1} rests in almost all of {r.name}, so its torque is not compared there"
        for r, rows in zip(found.recordings, found.residuals, strict=True)
        for j in np.flatnonzero(~rows.any(axis=0))
    ]


def _gaps(recordings: Recordings) -> list[str]:
    """Notes on recordings with gaps."""
    return [
        f"{r.name} has a gap of {np.diff(r.time).max():.3g} s; its reference is assumed to be "
        "smooth across it, and its noise stationary: cut it there by Recording.slice"
        for r in recordings
        if missing_after(r.time).any()
    ]


def _without_nan(found: Fit) -> Fit:
    """The fit, marked as failed if it contains NaN.

    Infinite deviations are allowed for undetermined parameters.
    """
    numbers = {
        "values": np.where(np.isfinite(found.theta), found.theta, np.nan),
        "deviations": found.std,
        "residuals": np.concatenate([np.ravel(r) for r in found.residuals]),
        "errors": found.error_percent.to_numpy(),
    }
    wrong = [name for name, values in numbers.items() if np.isnan(values).any()]
    if not (wrong and found.succeeded):
        return found
    note = f"some of the {' and '.join(wrong)} are not numbers (NaN)"
    return dataclasses.replace(found, status=Status.overflowed, notes=(*found.notes, note))


def _examined(found: Fit, loop: ClosedLoop) -> Fit:
    """The fit with the likely mistake in its recordings, or a note on its law, if there is one.

    A fit from given values continues another fit of the same recordings, which was examined.

    **Arguments:**

    - `loop`: the model at its start values, because an effect that fits a mistake may hide it.
    """
    if oem_of(found).start == "given":
        return found
    largest = float((found.error_percent * _of_motion(found)).to_numpy().max())
    mistake = "" if largest < LARGE_PERCENT else likely_mistake(loop, found.recordings)
    mistake = mistake or _unrelated(found) or _limited(found) or contradiction(found)
    said = mistake or doubtful_law(found)
    notes = (said, *found.notes) if said else found.notes
    return dataclasses.replace(found, mistake=mistake, notes=notes)


# Relative error, %, above which torque has nothing to do with the motion.
_UNRELATED_PERCENT = 95.0


def _unrelated(found: Fit) -> str:
    """A sentence if the motion explains the torque of no joint, although it is known."""
    least = float(found.error_percent.to_numpy().min())
    if not found.loop.controller.imposes or least < _UNRELATED_PERCENT:
        return ""
    return (
        f"the recorded motion explains nothing of the torque (error {least:.3g} % at least): check "
        "that both are of the same robot and time, and that the torque is not noise"
    )


def _limited(found: Fit) -> str:
    """A sentence if the motion does not explain the torque of a joint that is often at its limit.

    Only if the motion is known, because a simulated motion may differ where a drive is limited.
    """
    if not found.loop.controller.imposes:
        return ""
    errors = found.error_percent.to_numpy().max(axis=0)
    said = at_limit(found.recordings, np.flatnonzero(errors > DOUBTFUL_PERCENT).tolist())
    if not said:
        return ""
    return (
        f"{said}, and the motion leaves more than {DOUBTFUL_PERCENT:.0f} % of it unexplained: cut "
        "out these stretches, or record a slower motion"
    )


def _doubted(found: Fit) -> Fit:
    """The fit, with a note if its relative error is larger than that of a good model.

    The fit is a misfit if it explains no signal, or if a residual is larger than its signal.
    """
    errors = found.error_percent * _of_motion(found)
    left = _left_percent(found, errors)
    settled = found.status in (Status.converged, Status.stalled)
    if settled and (left.min() > 99.0 or left.max() > 105.0):
        found = dataclasses.replace(found, status=Status.misfit)
    worst = doubtful_joints(found)
    if not worst:
        return found
    joints = ", ".join(f"{label} {value:.3g} %" for label, value in worst.items())
    note = f"the model does not describe these recordings (relative error: {joints})"
    if not found.mistake:
        note += (
            ": check units, signs, the control law and its gains, and whether the motion is larger "
            "than the noise"
        )
    return dataclasses.replace(found, notes=(*found.notes, note))


def doubtful_joints(found: Fit) -> dict[str, float]:
    """Joints of which a fit leaves more than a good model does, with the share that is left, %."""
    errors = found.error_percent * _of_motion(found)
    largest = errors.to_numpy().max(axis=0)
    by_joint = {str(c): float(x) for c, x in zip(errors.columns, largest, strict=True)}
    return {label: value for label, value in by_joint.items() if value > DOUBTFUL_PERCENT}


def _followed(found: Fit) -> Fit:
    """The fit, with a note on joints whose position does not follow the reference.

    Simulations start from the reference, so torque may be explained although q is wrong.
    """
    pairs = [(r.q - r.q_ref, r.q_ref) for r in found.recordings if r.q_ref is not None]
    if not pairs:
        return found
    away, moved = (sum(np.var(x, axis=0) for x in both) for both in zip(*pairs, strict=True))
    # A reference at rest varies by rounding only.
    still = moved < 1e-20 * max(float(np.mean(ref**2)) for _, ref in pairs)
    astray = np.flatnonzero(~still & (away > 0.8 * moved))
    if not astray.size:
        return found
    joints = ", ".join(str(j + 1) for j in astray)
    note = f"q does not follow q_ref on joint {joints}: check the units and signs of both"
    return dataclasses.replace(found, notes=(*found.notes, note))


def _of_motion(found: Fit) -> Float[np.ndarray, "recordings joints"]:
    """Norm of the compared signal over the norm of its variation, which the model must explain.

    The mean of a position is subtracted, except for joints that barely move.
    """
    shape = found.error_percent.shape
    if found.optimum is None or found.optimum.problem.signals[0] != "q":
        return np.ones(shape)
    size = np.stack([np.linalg.norm(r.q, axis=0) for r in found.recordings])
    moved = np.stack([np.linalg.norm(r.q - r.q.mean(axis=0), axis=0) for r in found.recordings])
    return np.where(moved > 1e-2 * moved.max(), size / np.where(moved > 0, moved, 1.0), 1.0)


def _left_percent(found: Fit, percent: "pd.DataFrame") -> Float[np.ndarray, " joints"]:
    """Relative error of each joint over all recordings; NaN for a signal that is zero."""
    errors = percent.to_numpy()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        left = np.array([np.linalg.norm(r, axis=0) for r in found.residuals])
        size = np.where(errors > 0, left / errors, 0.0)
        total = np.linalg.norm(left, axis=0) / np.linalg.norm(size, axis=0)
    return np.where(np.isfinite(total), total, 0.0)
