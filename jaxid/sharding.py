"""Work shared out over the devices of a mesh: cores, accelerators, or machines."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

Result = TypeVar("Result")


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
