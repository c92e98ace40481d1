"""Recorded motions with errors, along which a loop with an imposed motion is simulated."""

from collections.abc import Sequence

import equinox as eqx
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
    made = jax.device_put((reference, reference[:, 0, 0], reference[:, 0, 1]))
    return eqx.tree_at(lambda b: (b.intervals.reference, b.q0, b.v0), batch, made)
