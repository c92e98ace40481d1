"""A loop with more free parameters, whose program serves loops with some of them free."""

import dataclasses

import numpy as np
from jaxtyping import Int

from .dynamics import imposed
from .loop import ClosedLoop

# Fields of a smoothed sign, which a search holds at first and may estimate later.
SIGN = "smoothing", "form"
# The lead of Coulomb friction, of which the same is true; it acts only along an imposed motion.
LEAD = "lead"


def widened(loop: ClosedLoop) -> tuple[ClosedLoop, Int[np.ndarray, " own"]]:
    """The loop with the shape of every sign free, and where its own parameters are among them.

    A compiled program depends on which parameters are free. Programs for the widened loop need not
    be compiled again when a search estimates a smoothing.

    **Returns:** the widened loop, and the indices of the values of `loop.theta` in its `theta`.
    """
    fields = (*SIGN, LEAD) if imposed(loop) else SIGN
    signs = {p.place for p in loop.parameters if p.place[-1] in fields}
    wide = dataclasses.replace(loop, held=loop.held - signs, freed=loop.freed | signs)
    own = {p.place for p in loop.free_parameters}
    return wide, np.flatnonzero(
        [p.place in own for p in wide.free_parameters for _ in range(p.size)]
    )
