"""The one door to every method."""

from collections.abc import Iterable

from ..errors import FitError
from ..loop import ClosedLoop
from ..recording import Recording, Recordings
from ..simulate import check_joints
from ._base import AbstractMethod, Fit
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
    return method.fit(loop, recordings)
