"""Functions without the computations that their results do not need."""

from collections.abc import Callable
from typing import Any

import jax
from jax.core import eval_jaxpr
from jax.interpreters.partial_eval import dce_jaxpr


def pruned(fun: Callable[..., Any], *like: Any) -> Callable[..., Any]:
    """A function of arrays without the equations that its results do not depend on.

    XLA leaves them out too, but only after they have been traced, batched and differentiated in
    each loop that calls the function.

    **Arguments:**

    - `like`: arguments with the structure, shapes and types of those that follow.
    """
    closed, shape = jax.make_jaxpr(fun, return_shape=True)(*like)
    jaxpr, _ = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    structure = jax.tree.structure(shape)

    def call(*args: Any) -> Any:
        found = eval_jaxpr(jaxpr, closed.consts, *jax.tree.leaves(args))
        return jax.tree.unflatten(structure, found)

    # Jitted, so that all stages of a step share one trace of it.
    return jax.jit(call)
