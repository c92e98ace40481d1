"""Recordings shared out: over the cores of this machine, or over the devices of a mesh."""

import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PyTree

Given = TypeVar("Given")
Result = TypeVar("Result")


def cores() -> int:
    """How many cores this process may use; one where an accelerator does the work."""
    if jax.default_backend() != "cpu":
        return 1
    known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1


def of_this_machine(mesh: Mesh) -> bool:
    """Whether a mesh has host devices of this process only: threads by another name."""
    here = jax.process_index()
    return all(d.platform == "cpu" and d.process_index == here for d in mesh.devices.flat)


def shares_of(count: int, parts: int) -> list[Int[np.ndarray, " rows"]]:
    """Which recordings each of `parts` takes: as many each, the last again where they run out."""
    size = -(-count // min(parts, count))
    return [np.minimum(np.arange(k, k + size), count - 1) for k in range(0, count, size)]


def at_once(
    fun: Callable[[Given], Result], parts: Sequence[Given], threads: int | None = None
) -> list[Result]:
    """The function of each part, by some threads; as many as there are cores if not said.

    XLA runs a loop on the core of its caller, and compiles without holding Python's lock.
    """
    if not parts:
        return []
    with ThreadPoolExecutor(min(len(parts), threads or cores())) as pool:
        return list(pool.map(lambda part: jax.block_until_ready(fun(part)), parts))


def taken(each: PyTree, rows: Int[np.ndarray, " rows"]) -> PyTree:
    """These rows of the leading axis of every leaf."""
    return jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[rows], each))


class EndToEnd:
    """Room for the leaves of all parts, which lie end to end along their leading axes.

    Parts are put in place as they come, so that what is large is neither held nor copied twice.
    """

    def __init__(self, parts: int):
        self._parts = parts
        self._room: PyTree = None
        self._lock = threading.Lock()

    def put(self, part: int, result: PyTree) -> None:
        """Takes the result of one part; every part has leaves of the same shapes."""
        with self._lock:
            if self._room is None:
                self._room = jax.tree.map(self._room_for, result)

        def place(room, leaf):
            room[part * len(leaf) : (part + 1) * len(leaf)] = leaf

        jax.tree.map(place, self._room, result)

    def _room_for(self, leaf: Array | np.ndarray) -> np.ndarray:
        # JAX takes over memory as it is where it begins at a multiple of 64 bytes.
        shape = (self._parts * leaf.shape[0], *leaf.shape[1:])
        size = leaf.dtype.itemsize * math.prod(shape)
        held = np.empty(size + 64, np.uint8)
        begin = -held.ctypes.data % 64
        return held[begin : begin + size].view(leaf.dtype).reshape(shape)

    def whole(self, count: int) -> PyTree:
        """The first `count` rows of every leaf: what filled up the last part is left out."""
        return jax.device_put(jax.tree.map(lambda room: room[:count], self._room))


def everywhere(tree: PyTree, mesh: Mesh) -> PyTree:
    """The same tree with its arrays on every device of a mesh, also those of other processes.

    Every process must hold the same values.
    """
    whole = NamedSharding(mesh, PartitionSpec())

    def placed(leaf):
        if not eqx.is_array(leaf):
            return leaf
        host = np.asarray(leaf)
        return jax.make_array_from_callback(host.shape, whole, lambda part: host[part])

    return jax.tree.map(placed, tree)


def shared_out(fun: Callable[..., Result], mesh: Mesh, same: PyTree, each: PyTree) -> Result:
    """`fun(same, each)` with the leading axis of `each` split over a mesh; called inside a jit.

    What does not divide evenly is filled up with copies of the last entry, and their results
    dropped. The result is on every device, so what follows does not depend on the mesh.

    **Arguments:**

    - `fun`: gives arrays with the same leading axis.
    - `same`: what every device needs.
    - `each`: a pytree with `(count,)` before the axes of each leaf.
    """
    count = jax.tree.leaves(each)[0].shape[0]
    missing = -count % mesh.size
    fill = lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)])  # noqa: E731
    split = PartitionSpec(mesh.axis_names)
    arrays, rest = eqx.partition(same, eqx.is_array)
    part = jax.shard_map(
        lambda arrays, each: fun(eqx.combine(arrays, rest), each),
        mesh=mesh,
        in_specs=(PartitionSpec(), split),
        out_specs=split,
        check_vma=False,
    )
    result = part(arrays, jax.tree.map(fill, each))
    whole = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, whole)[:count], result)
