"""The one door to every method."""

import dataclasses
from collections.abc import Iterable

import numpy as np

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
    method = OEM() if method is None else method
    if not isinstance(method, AbstractMethod):
        raise FitError(f"{method!r} is not a method: give an object such as jaxid.OEM()")
    return _honest(method.fit(loop, recordings))


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
