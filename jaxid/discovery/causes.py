"""Possible mistakes in the data behind a fit that explains little, each tested in turn."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ..errors import JaxidError
from ..estimate import Filtering
from ..estimate.idim import stack
from ..estimate.regression import linear_parameters
from ..estimate.result import DOUBTFUL_PERCENT
from ..parameters import Bounds
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop

# A mistake is named if its correction reduces the squared error to less than this share, and leaves
# an error that is not doubtful.
_SHARE = 0.25
# Range of a long recording of white noise, in standard deviations.
_STILL = 12.0
# Factors between units that are often confused.
_FACTORS = {
    "in degrees, not in rad": np.pi / 180,
    "in rad, not in degrees": 180 / np.pi,
    "in mm or mrad, not in m or rad": 1e-3,
    "in m or rad, not in mm or mrad": 1e3,
}


def likely_cause(loop: ClosedLoop, recordings: Recordings) -> str:
    """The mistake in the data whose correction improves a regression enough; empty if none.

    Signs, units and the order of joints are tested one at a time. Each is tested by a regression
    of the inverse dynamics along the filtered motion, with the parameters inside their bounds.
    """
    for label, span in _still(recordings):
        return f"{label} moves by {span:.2g} only: record motions of all joints"
    before = _left(loop, recordings)
    if before is None:
        return ""
    found = []
    for said, mended in _mistakes(recordings):
        after = _left(loop, mended)
        if after is not None and np.sqrt(np.mean(after**2)) < DOUBTFUL_PERCENT:
            found.append((float(np.mean(after**2)), said))
    size, said = min(found, default=(np.inf, ""))
    if not size < _SHARE * np.mean(before**2):
        return ""
    return (
        f"{said}: with this corrected, the error of a regression is {np.sqrt(size):.2g} % instead "
        f"of {np.sqrt(np.mean(before**2)):.3g} %"
    )


def _still(recordings: Recordings) -> Iterator[tuple[str, float]]:
    """Joints that show only sensor noise in every recording, and their range, rad or m."""
    span = np.max([np.ptp(r.q, axis=0) for r in recordings], axis=0)
    # Third differences of white noise are √20 times as large; those of a motion are almost zero.
    noise = [np.std(np.diff(r.q, 3, axis=0), axis=0) / np.sqrt(20) for r in recordings]
    for j in np.flatnonzero(span <= _STILL * np.max(noise, axis=0)):
        yield f"joint {j + 1}", float(span[j])


def _left(loop: ClosedLoop, recordings: Recordings) -> Float[np.ndarray, " joints"] | None:
    """Relative error of each joint's torque in a bounded regression, %; None if it fails."""
    import scipy

    try:
        stacked = stack(loop, recordings, Filtering())
        bounds = Bounds.of(linear_parameters(loop))
    except JaxidError:
        return None
    size = np.maximum(np.linalg.norm(stacked.right, axis=0), 1e-300)
    columns = (stacked.columns / size[:, None]).reshape(-1, stacked.columns.shape[-1])
    right = (stacked.right / size).ravel()
    length = np.linalg.norm(columns, axis=0)
    length[length == 0] = 1.0
    if not np.isfinite(columns).all():
        return None
    limits = np.asarray(bounds.lower) * length, np.asarray(bounds.upper) * length
    found = scipy.optimize.lsq_linear(columns / length, right, limits)
    rest = right - columns / length @ found.x
    return 100 * np.linalg.norm(rest.reshape(-1, len(size)), axis=0)


def _mistakes(recordings: Recordings) -> Iterator[tuple[str, Recordings]]:
    """Possible mistakes in recordings, each with the recordings corrected for it."""
    n = recordings[0].joints
    several = [("all joints", np.ones(n))] if n > 1 else []
    chosen = [(f"joint {j + 1}", np.eye(n)[j]) for j in range(n)] + several
    for label, which in chosen:
        yield (
            f"the torque of {label} seems to have the wrong sign",
            _changed(recordings, tau=1 - 2 * which),
        )
    for label, which in chosen:
        for unit, factor in _FACTORS.items():
            scale = 1 + (factor - 1) * which
            yield (
                f"the position of {label} seems to be {unit}",
                _changed(recordings, q=scale),
            )
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        swapped = [dataclasses.replace(r, tau=r.tau[:, order]) for r in recordings]
        yield (
            f"the torques of joints {i + 1} and {j + 1} seem to be swapped",
            Recordings.of(swapped),
        )


def _changed(recordings: Recordings, q: np.ndarray | float = 1.0, tau: np.ndarray | float = 1.0):
    """Recordings with positions and torques multiplied by factors."""

    def one(r: Recording) -> Recording:
        ref = None if r.q_ref is None else r.q_ref * q
        v = None if r.v is None else r.v * q
        return dataclasses.replace(r, q=r.q * q, q_ref=ref, v=v, tau=r.tau * tau)

    return Recordings.of([one(r) for r in recordings])
