"""Recorded motions with errors, along which a loop with an imposed motion is simulated."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from ..recording import Recording
from .batch import Batch, reference_at
from .loop import ClosedLoop


def with_errors(
    loop: ClosedLoop,
    recordings: Sequence[Recording],
    batch: Batch,
    errors: Sequence[Float[np.ndarray, "_samples joints"]],
) -> Batch:
    """The batch along recorded motions with errors; what is compared stays the same.

    **Arguments:**

    - `loop`: with a virtual law, whose reference is the recorded motion.
    - `recordings`: those of the batch, in its order.
    - `errors`: of the recorded positions, `(samples, joints)` each, rad or m.
    """
    law, reference = loop.controller, np.array(batch.intervals.reference)
    for k, (recording, error) in enumerate(zip(recordings, errors, strict=True)):
        added = reference_at(loop, recording, law.smoothed(recording, error))
        reference[k, : len(added)] += added
        reference[k, len(added) :] += added[-1]
    start = reference[:, 0, :2]
    intervals = dataclasses.replace(batch.intervals, reference=jax.device_put(reference))
    q0, v0 = jax.device_put(start[:, 0]), jax.device_put(start[:, 1])
    return dataclasses.replace(batch, intervals=intervals, q0=q0, v0=v0)
