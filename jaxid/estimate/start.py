"""Start values of output error, from inverse dynamics if they are better."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ..control import OpenLoop
from ..errors import JaxidError, ModelError
from ..recording import Recordings
from ..simulation.batch import Batch, prepare
from ..simulation.loop import ClosedLoop
from ..simulation.runs import simulate_batch
from ..simulation.steps import MANY, needed_substeps, with_substeps
from .didim import DIDIM, physical
from .idim import IDIM


def start_values(
    loop: ClosedLoop,
    recordings: Recordings,
    start: str,
    say: Callable[[str], None],
    batch: Batch | None = None,
) -> ClosedLoop:
    """The loop at the best start values: its own, those of IDIM or those of DIDIM.

    The best ones have the smallest simulated torque error. DIDIM is used only if the others leave
    much of the torque. Parameters in which torque is not linear keep their values.

    **Arguments:**

    - `start`: `"given"` for the unchanged loop, else `"auto"`.
    - `batch`: the prepared recordings, if they exist.
    """
    if start == "given":
        return loop
    say("start values by inverse dynamics")
    batch = prepare(loop, recordings) if batch is None else batch
    candidates, errors = [loop], [_simulated_error(loop, recordings, batch)]
    for values in (_by_idim, _by_didim):
        try:
            theta = values(candidates[-1], recordings)
        except (JaxidError, np.linalg.LinAlgError):
            continue
        if np.isfinite(theta).all():
            candidates.append(physical(loop, theta))
            most = max(_STIFFER * needed_substeps(loop, recordings), MANY)
            errors.append(_simulated_error(candidates[-1], recordings, batch, most))
        if min(errors) < _NEAR:
            break
    if isinstance(loop.controller, OpenLoop):
        return candidates[-1]
    return candidates[int(np.argmin(errors))]


def _by_idim(loop: ClosedLoop, recordings: Recordings) -> Float[np.ndarray, " linear"]:
    return IDIM().solved(loop, recordings)[1].theta


def _by_didim(loop: ClosedLoop, recordings: Recordings) -> Float[np.ndarray, " linear"]:
    return np.asarray(DIDIM(max_steps=4).fit(loop, recordings).theta)


# Share of the squared torque, mean over joints, below which no better start is needed.
_NEAR = 0.2**2
# Steps of a start over those of the loop as it is, above which an inertia is almost zero: of
# recordings with a mistake in them, whose fit would take an hour for each of its steps. A loop
# without friction needs few steps, so `MANY` are always allowed.
_STIFFER = 10


def _simulated_error(
    loop: ClosedLoop, recordings: Recordings, batch: Batch, most: float = np.inf
) -> float:
    """Mean over joints of the squared relative torque error of a simulation; infinite if it fails.

    An open loop has no torque to compare.

    **Arguments:**

    - `most`: steps between two samples; a loop that needs more counts as one that fails.
    """
    if isinstance(loop.controller, OpenLoop) or needed_substeps(loop, recordings) > most:
        return np.inf
    try:
        tau = simulate_batch(with_substeps(loop, recordings), batch).tau
    except ModelError:
        return np.inf
    there = np.asarray(batch.mask)[..., None]
    measured, simulated = (np.where(there, x, 0.0) for x in (batch.tau, tau))
    measured = batch.compared(measured)
    left = measured - batch.compared(simulated, loop.controller.late)
    error, size = (np.sum(np.asarray(x) ** 2, axis=(0, 1)) for x in (left, measured))
    total = float(np.mean(error / size))
    return total if np.isfinite(total) else np.inf
