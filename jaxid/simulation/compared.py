"""The part of signals that is compared: a frequency band, without joints that stand still."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..compiling import compiled
from ..signals.smoothing import Band

Moving = Bool[Any, "recordings rows joints"] | None
# Columns that are filtered at once: few enough for their transforms to fit into the caches.
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
    count = x.shape[-1]
    width = next((w for w in _WIDTHS if count <= w), _WIDTHS[-1])
    found = []
    for first in range(0, count, width):
        some = x[..., first : first + width]
        some = np.pad(some, [(0, 0)] * 3 + [(0, width - some.shape[-1])])
        found.append(np.asarray(_columns(band, moving, mask, jnp.asarray(some))))
    if not found:
        rows = np.shape(mask if band is None else band.keep)
        return np.zeros((*rows, *x.shape[2:]), x.dtype)
    return np.concatenate(found, axis=-1)[..., :count]


@compiled
def _columns(
    band: Band | None,
    moving: Moving,
    mask: Bool[Any, "recordings samples"],
    x: Float[Array, "recordings samples outputs columns"],
) -> Float[Array, "recordings rows outputs columns"]:
    return compared_part(band, moving, jnp.where(mask[..., None, None], x, 0.0))
