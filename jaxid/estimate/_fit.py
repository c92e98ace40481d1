"""The one door to every method."""

import dataclasses
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from ..effects import check_declared
from ..errors import FitError
from ..loop import ClosedLoop
from ..recording import Recording, Recordings
from ..simulate import check_joints
from ._base import AbstractMethod, Fit, Status
from .oem import OEM


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

    **Raises:** `FitError`, `RecordingError` or `ModelError` where the three do not fit together.
    """
    recordings = Recordings.of(recordings)
    check_joints(loop, recordings[0])
    for effect in loop.effects:
        check_declared(effect, loop.joints)
    method = OEM() if method is None else method
    if not isinstance(method, AbstractMethod):
        raise FitError(f"{method!r} is not a method: give an object such as jaxid.OEM()")
    return _followed(_doubted(_honest(method.fit(loop, recordings))))


def _honest(found: Fit) -> Fit:
    """The fit, which does not call itself successful where a number is none.

    Infinite deviations are meant: those of what the recordings do not determine.
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
    note = f"not a number: some of the {' and '.join(wrong)}"
    return dataclasses.replace(found, status=Status.overflowed, notes=(*found.notes, note))


# Models that describe a robot leave a few per cent, and noise seldom ten.
_DOUBTFUL_PERCENT = 30.0


def _doubted(found: Fit) -> Fit:
    """The fit, with what to look at where it leaves more of a signal than a model should.

    It is no success where no signal is explained at all, or one is left larger than it was.
    """
    left = _left_percent(found)
    settled = found.status in (Status.converged, Status.stalled)
    if settled and (left.min() > 99.0 or left.max() > 105.0):
        found = dataclasses.replace(found, status=Status.misfit)
    largest = found.error_percent.to_numpy().max(axis=0)
    errors = {str(c): float(x) for c, x in zip(found.error_percent.columns, largest, strict=True)}
    worst = {label: value for label, value in errors.items() if value > _DOUBTFUL_PERCENT}
    if not worst:
        return found
    joints = ", ".join(f"{label} {value:.3g} %" for label, value in worst.items())
    note = (
        f"the model does not describe these recordings ({joints} of the signal is left): check "
        "units, signs, the control law and its gains, and whether there is more motion than noise"
    )
    return dataclasses.replace(found, notes=(*found.notes, note))


def _followed(found: Fit) -> Fit:
    """The fit, with the joints whose recorded position has little to do with its reference.

    Simulations start from the reference, so that a torque may be explained whatever q says.
    """
    pairs = [(r.q - r.q_ref, r.q_ref) for r in found.recordings if r.q_ref is not None]
    if not pairs:
        return found
    away, moved = (sum(np.var(x, axis=0) for x in both) for both in zip(*pairs, strict=True))
    # A reference at rest has the spread of its rounding, and is not followed anywhere.
    still = moved < 1e-20 * max(float(np.mean(ref**2)) for _, ref in pairs)
    astray = np.flatnonzero(~still & (away > 0.8 * moved))
    if not astray.size:
        return found
    joints = ", ".join(str(j + 1) for j in astray)
    note = f"q does not follow q_ref on joint {joints}: check the units and signs of both"
    return dataclasses.replace(found, notes=(*found.notes, note))


def _left_percent(found: Fit) -> Float[np.ndarray, " joints"]:
    """Relative error of each joint over all recordings; of a signal that is nil there is none."""
    errors = found.error_percent.to_numpy()
    left = np.array([np.linalg.norm(r, axis=0) for r in found.residuals])
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.where(errors > 0, left / errors, 0.0)
        total = np.linalg.norm(left, axis=0) / np.linalg.norm(size, axis=0)
    return np.where(np.isfinite(total), total, 0.0)
