"""The part of signals that is compared: a frequency band, without joints that stand still."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiling import compiled
from ..signals.smoothing import Band

Moving = Bool[Any, "recordings rows joints"] | None
# Series that are filtered at once: few enough for their transforms to fit into the caches.
_WIDTHS = 8, 32


@compiled
def compared_part(
    band: Band | None,
    moving: Moving,
    x: Float[Any, "recordings samples *axes"],
    ahead: Float[Array, ""] | None = None,
) -> Float[Array, "recordings rows *axes"]:
    """Signals in the band; zero where a joint stands still.

    **Arguments:**

    - `moving`: the rows in which each joint moves; None for all.
    - `ahead`: time by which signals in a band are advanced, s.
    """
    passed = x if band is None else band(x, ahead)
    if moving is None:
        return passed
    # The outputs may be several signals of each joint.
    there = jnp.tile(moving, passed.shape[2] // moving.shape[2]).astype(passed.dtype)
    return passed * there.reshape(*there.shape, *(1,) * (passed.ndim - 3))


def compared_table(
    band: Band | None,
    moving: Moving,
    mask: Bool[Any, "recordings samples"],
    x: Float[np.ndarray, "recordings samples outputs columns"],
) -> Float[np.ndarray, "recordings rows outputs columns"]:
    """The compared part of many signals, in their precision; zero for padding.

    **Arguments:**

    - `mask`: false for padding.
    """
    if band is None and moving is None:
        return np.where(np.asarray(mask)[..., None, None], x, x.dtype.type(0))
    joints = x.shape[2] if moving is None else moving.shape[2]
    series = x.reshape(*x.shape[:2], x.shape[2] * x.shape[3])
    # Most effects act on one joint, so most series are zero.
    filled = np.flatnonzero(series.any(axis=(0, 1)))
    rows = np.shape(mask if band is None else band.keep)
    found = np.zeros((*rows, series.shape[2]), x.dtype)
    width = next((w for w in _WIDTHS if len(filled) <= w), _WIDTHS[-1])
    for first in range(0, len(filled), width):
        own = filled[first : first + width]
        some = np.pad(series[..., own], [(0, 0)] * 2 + [(0, width - len(own))])
        joint = np.resize(own // x.shape[3] % joints, width)
        passed = _series(band, moving, mask, jnp.asarray(joint), jnp.asarray(some))
        found[..., own] = np.asarray(passed)[..., : len(own)]
    return found.reshape(*rows, *x.shape[2:])


@compiled
def _series(
    band: Band | None,
    moving: Moving,
    mask: Bool[Any, "recordings samples"],
    joint: Int[Array, " series"],
    x: Float[Array, "recordings samples series"],
) -> Float[Array, "recordings rows series"]:
    """The compared part of series of any joints."""
    there = None if moving is None else moving[:, :, joint]
    return compared_part(band, there, jnp.where(mask[..., None], x, 0.0))
