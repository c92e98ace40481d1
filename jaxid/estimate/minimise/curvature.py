"""The Hessian of the squared error where J'J overestimates its curvature."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from .arrow import Arrow
from .descent import Products

# Share of the curvature by J'J below which a step is assumed to have this share (Powell 1978).
_LEAST_SHARE = 0.2
# Share above which steps with J'J converge fast enough.
_LARGE_SHARE = 0.75
# Relative decrease of the squared error above which a step is far from the minimum, where J'J is
# the better Hessian; Fletcher and Xu (1987) choose in the same way.
_FAR = 0.1


def with_curvature(found: Products, before: Products, step: Float[Any, " parameters"]) -> Products:
    """Products whose Hessian has the curvature that the gradients show along the last step.

    If a model does not describe the recordings, the second derivatives of its residual change the
    curvature, and steps with J'J alone converge linearly. (Of an arm with a backlash that the model
    lacks, each step of the delay covered a fifth of the distance to the minimum.) The update is
    that of BFGS with J'J as the previous Hessian (Al-Baali and Fletcher 1985), damped so that the
    result is positive definite (Powell 1978). The products are returned unchanged if the squared
    error still decreases fast, if J'J does not overestimate the curvature along the step much, and
    with estimated initial states, because the updated matrix is then no `Arrow`.

    **Arguments:**

    - `found`: products after the step. `before`: those before it.
    - `step`: change of the parameters, `(parameters,)`.
    """
    hessian = found.hessian
    assert isinstance(hessian, Arrow)
    if found.grad[1].size:
        return found
    along = hessian.dense @ step
    expected = step @ along
    unit = jnp.where(expected > 0, expected, 1.0)
    change = found.grad[0] - before.grad[0]
    share = step @ change / unit
    near = before.f - found.f < _FAR * before.f
    used = (expected > 0) & near & (share < _LARGE_SHARE)
    weight = jnp.where(share < _LEAST_SHARE, (1 - _LEAST_SHARE) / (1 - share), 1.0)
    change = weight * change + (1 - weight) * along
    # The damped change has at least the least share, so the division is safe.
    size = jnp.where(used, step @ change, 1.0)
    added = jnp.outer(change, change) / size - jnp.outer(along, along) / unit
    dense = hessian.dense + jnp.where(used, added, 0.0)
    return Products(found.f, found.grad, Arrow(dense, hessian.blocks, hessian.border))
