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
    series = x.reshape(*x.shape[:2], x.shape[2] * x.shape[3])
    # Most effects act on one joint, so most series are zero.
    filled = np.flatnonzero(series.any(axis=(0, 1)))
    found = np.zeros((*np.shape(mask if band is None else band.keep), series.shape[2]), x.dtype)
    output = filled // x.shape[3]
    found[..., filled] = compared_series(band, moving, mask, output, series[..., filled])
    return found.reshape(*found.shape[:2], *x.shape[2:])


def compared_series(
    band: Band | None,
    moving: Moving,
    mask: Bool[Any, "recordings samples"],
    output: Int[np.ndarray, " series"],
    x: Float[np.ndarray, "recordings samples series"],
) -> Float[np.ndarray, "recordings rows series"]:
    """The compared part of many series, in their precision; zero for padding.

    **Arguments:**

    - `mask`: false for padding. `output`: index of the output that each series belongs to.
    """
    if band is None and moving is None:
        return np.where(np.asarray(mask)[..., None], x, x.dtype.type(0))
    # The outputs may be several signals of each joint.
    joint = output if moving is None else output % moving.shape[2]
    found = np.zeros((*np.shape(mask if band is None else band.keep), len(output)), x.dtype)
    width = next((w for w in _WIDTHS if len(output) <= w), _WIDTHS[-1])
    for first in range(0, len(output), width):
        own = slice(first, first + width)
        some = x[..., own]
        spare = width - some.shape[-1]
        some = np.pad(some, [(0, 0)] * 2 + [(0, spare)])
        joints = jnp.asarray(np.pad(joint[own], (0, spare)))
        passed = _series(band, moving, mask, joints, jnp.asarray(some))
        found[..., own] = np.asarray(passed)[..., : width - spare]
    return found


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
