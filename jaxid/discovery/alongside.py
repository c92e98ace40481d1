"""Searches along the recorded motion although the law is known, because simulations are slow."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..control import Tracking
from ..errors import FitError, ModelError
from ..recording import Recordings
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from ..simulation.steps import UNROLLED, needed_substeps
from .comparison import compare


def along_recorded(loop: ClosedLoop) -> ClosedLoop:
    """The loop in which sets of effects are compared: along the recorded motion if fits are slow.

    One fit of six joints in the simulated loop takes minutes, and a search needs dozens. So does a
    fit of an arm that sticks: a sharp sign of velocity needs up to a hundred steps between two
    samples or ticks. A sampled law is slow from the start; under a continuous law, the fit of the
    starting model shows whether its loop needs that many. Below the bandwidth of the law, recorded
    motion and torque have the same information. The loop is unchanged if positions are compared, or
    if its effects have a motion of their own, which only a simulation gives.
    """
    law = loop.controller
    short = (loop.stepping.substeps or 1) > _STEPS
    slow = loop.joints > UNROLLED or law.period is not None or short
    if not slow or law.imposes or law.judged != "torque":
        return loop
    along = dataclasses.replace(loop, controller=Tracking(delay=law.lag))
    return along if imposed(along) else loop


def in_the_loop(loop: ClosedLoop, models: Sequence[ClosedLoop], recordings: Recordings) -> str:
    """A note with the error of the first and of the last model in the simulated loop.

    **Arguments:**

    - `loop`: the given loop, with its law. `models`: loops along the recorded motion, the starting
      model first. `recordings`: held-out recordings, if there are any.
    """
    if loop.joints > UNROLLED:
        why = f"{loop.name} has {loop.joints} joints"
    elif loop.controller.period is not None:
        why = "the law is sampled"
    else:
        why = f"the starting model needs more than {_STEPS} steps between two samples"
    said = (
        f"{why}, so sets of effects were compared along the recorded motion, without the law; in "
        "the simulated loop the error of the torque on "
        f"{', '.join(recordings.names)}, mean over the joints, is"
    )
    try:
        last = _error(loop, models[-1], recordings)
        before = ""
        if len(models) > 1:
            before = f", and {_error(loop, models[0], recordings):.3g} % of the starting model"
    except (FitError, ModelError) as error:
        return f"{said} not known: {error}"
    except KeyboardInterrupt:
        # The search has ended, and its result is kept.
        return f"{said} not known: the simulation was interrupted"
    return f"{said} {last:.3g} %{before}"


def _error(given: ClosedLoop, found: ClosedLoop, recordings: Recordings) -> float:
    """Relative error of a torque under the given law, mean over recordings and joints, %."""
    loop = dataclasses.replace(
        found,
        controller=given.controller,
        stepping=given.stepping,
        standstill=given.standstill,
    )
    loop = _softened(loop, recordings)
    return float(compare(loop, recordings).error_percent.to_numpy().mean())


# Steps between two grid points up to which a simulation is fast enough, and shares of a joint's
# highest speed to which the smoothing of its signs is raised for that.
_STEPS, _SHARES = 16, np.geomspace(1e-6, 1e-1, 11)


def _softened(loop: ClosedLoop, recordings: Recordings) -> ClosedLoop:
    """The loop with signs of velocity that are smooth enough for fixed steps.

    Along a recorded motion they may be estimated as sharp as the samples can tell, which is zero.
    """
    speeds = [np.abs(np.diff(r.q, axis=0)).max(axis=0) / r.period for r in recordings]
    highest = np.max(speeds, axis=0)
    signs = [
        (p, highest[p.joint - 1])
        for p in loop.parameters
        if p.place[-1] == "smoothing" and p.joint is not None
    ]
    for share in _SHARES:
        if needed_substeps(loop, recordings) <= _STEPS:
            break
        values = {p.name: max(float(p.where(loop)), share * speed) for p, speed in signs}
        loop = loop.with_values(**values)
    return loop
