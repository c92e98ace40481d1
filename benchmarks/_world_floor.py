"""What who knows a world's physics leaves of a held-out recording: the floor of an honest error."""

import numpy as np

import jaxid
from jaxid.simulation.batch import compared

from ._world_cases import Case


def floor_percent(case: Case, held_out: jaxid.Recordings, loop: jaxid.ClosedLoop) -> np.ndarray:
    """Relative error by joint that the recorded noise leaves where the loop compares torque, %."""
    tau = np.asarray(held_out[0].tau)
    errors = case.recordings["held_out"]["noise"]
    left, torque = (compared(loop, held_out, [x])[0] for x in (errors, tau))
    return 100 * np.linalg.norm(left, axis=0) / np.linalg.norm(torque, axis=0)
