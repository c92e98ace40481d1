"""Operations that only move elements, applied to arrays of scalars while a program is traced.

Each takes the parameters of JAX's primitive and object arrays.
"""

from collections.abc import Callable
from typing import Any

import numpy as np


def _broadcast(p, x):
    shape, where = p["shape"], p["broadcast_dimensions"]
    spread = [1] * len(shape)
    for d, n in zip(where, x.shape, strict=True):
        spread[d] = n
    return np.broadcast_to(x.reshape(spread), shape)


def _reshape(p, x):
    order = p["dimensions"]
    return (x if order is None else x.transpose(order)).reshape(p["new_sizes"])


def _slice(p, x):
    strides = p["strides"] or (1,) * x.ndim
    return x[
        tuple(
            slice(a, b, s)
            for a, b, s in zip(p["start_indices"], p["limit_indices"], strides, strict=True)
        )
    ]


def _split(p, x):
    return np.split(x, np.cumsum(p["sizes"])[:-1], axis=p["axis"])


def _unstack(p, x):
    moved = np.moveaxis(x, p["axis"], 0)
    # The items of a vector of objects are the objects themselves, not arrays.
    return [moved[k : k + 1].reshape(moved.shape[1:]) for k in range(len(moved))]


MOVES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": lambda p, x: np.squeeze(x, p["dimensions"]),
    "expand_dims": lambda p, x: np.expand_dims(x, p["dimensions"]),
    "transpose": lambda p, x: np.transpose(x, p["permutation"]),
    "rev": lambda p, x: np.flip(x, p["dimensions"]),
    "slice": _slice,
    "split": _split,
    "concatenate": lambda p, *xs: np.concatenate(xs, axis=p["dimension"]),
    "stack": lambda p, *xs: np.stack(xs, axis=p["axis"]),
    "unstack": _unstack,
}
