"""Distribution of recordings over the cores of this machine or the devices of a mesh."""

import functools
import importlib
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PyTree
from threadpoolctl import threadpool_limits

_Arguments = ParamSpec("_Arguments")
Given = TypeVar("Given")
Result = TypeVar("Result")


def cores() -> int:
    """Number of cores that this process may use; one if an accelerator does the work."""
    if jax.default_backend() != "cpu":
        return 1
    known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1


def with_one_blas_thread(
    fun: Callable[_Arguments, Result],
) -> Callable[_Arguments, Result]:
    """The function with NumPy's and SciPy's linear algebra on one thread while it runs.

    Threads of BLAS add in another order on each number of cores, and a search would then depend on
    it. For matrices of the size of ours they also wait for each other, and for XLA's threads, for
    longer than they compute: beside one other process a decomposition takes four times as long.
    """

    @functools.wraps(fun)
    def limited(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Result:
        # SciPy brings a BLAS of its own, which can be limited once it is loaded.
        importlib.import_module("scipy.linalg")
        with threadpool_limits(1, user_api="blas"):
            return fun(*args, **kwargs)

    return limited


def of_this_machine(mesh: Mesh) -> bool:
    """Whether a mesh has only host devices of this process, which are mere threads."""
    here = jax.process_index()
    return all(d.platform == "cpu" and d.process_index == here for d in mesh.devices.flat)


def shares_of(count: int, parts: int) -> list[Int[np.ndarray, " rows"]]:
    """Recordings of each of `parts`, equally many; the last recording is repeated as padding."""
    size = -(-count // min(parts, count))
    return [np.minimum(np.arange(k, k + size), count - 1) for k in range(0, count, size)]


def at_once(
    fun: Callable[[Given], Result], parts: Sequence[Given], threads: int | None = None
) -> list[Result]:
    """Applies the function to each part, on several threads; by default one per core.

    XLA runs a loop on the core of its caller, and compiles without holding Python's lock.
    """
    if not parts:
        return []
    with ThreadPoolExecutor(min(len(parts), threads or cores())) as pool:
        return list(pool.map(lambda part: jax.block_until_ready(fun(part)), parts))


def taken(each: PyTree, rows: Int[np.ndarray, " rows"]) -> PyTree:
    """The given rows of the leading axis of every leaf."""
    return jax.device_put(jax.tree.map(lambda leaf: np.asarray(leaf)[rows], each))


def one_by_one(fun: Callable[[Any], Any], each: PyTree) -> Any:
    """`fun` of every recording alone, on several threads; an accelerator takes all at once.

    A program for one recording serves any number of them.

    **Arguments:**

    - `fun`: from recordings to arrays, both with `(recordings,)` before the axes of each leaf.
    - `each`: the recordings.
    """
    count = jax.tree.leaves(each)[0].shape[0]
    if count == 1 or jax.default_backend() != "cpu":
        return fun(each)
    parts = at_once(lambda k: fun(taken(each, np.array([k]))), range(count))
    return jax.device_put(jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts))


class EndToEnd:
    """Preallocated arrays for the leaves of all parts, concatenated along their leading axes.

    Each part is copied when it is ready, so large arrays are not stored or copied twice.
    """

    def __init__(self, parts: int):
        self._parts = parts
        self._room: PyTree = None
        self._lock = threading.Lock()

    def put(self, part: int, result: PyTree) -> None:
        """Stores the result of one part; every part has leaves of the same shapes."""
        with self._lock:
            if self._room is None:
                self._room = jax.tree.map(self._room_for, result)

        def place(room, leaf):
            room[part * len(leaf) : (part + 1) * len(leaf)] = leaf

        jax.tree.map(place, self._room, result)

    def _room_for(self, leaf: Array | np.ndarray) -> np.ndarray:
        # JAX uses memory without a copy if it begins at a multiple of 64 bytes.
        shape = (self._parts * leaf.shape[0], *leaf.shape[1:])
        size = leaf.dtype.itemsize * math.prod(shape)
        held = np.empty(size + 64, np.uint8)
        begin = -held.ctypes.data % 64
        return held[begin : begin + size].view(leaf.dtype).reshape(shape)

    def whole(self, count: int) -> PyTree:
        """The first `count` rows of every leaf, without the padding of the last part."""
        return jax.device_put(jax.tree.map(lambda room: room[:count], self._room))


def everywhere(tree: PyTree, mesh: Mesh) -> PyTree:
    """The same tree with its arrays on every device of a mesh, including other processes'.

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

    If `count` is not a multiple of the number of devices, copies of the last entry are added and
    their results are dropped. The result is on every device, so later computations do not depend on
    the mesh.

    **Arguments:**

    - `fun`: gives arrays with the same leading axis.
    - `same`: data that every device needs.
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
