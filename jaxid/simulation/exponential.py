"""An exponential method, for states of effects along a motion that is given."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float, PyTree

from .fixed_step import AbstractFixedStep

# Below this size the quotient in `_phi` is a series, since its derivative loses digits.
_SMALL = 1e-4


class Exponential(AbstractFixedStep):
    """The exponential Rosenbrock–Euler method, with inputs at the middle of a step.

    Of order two, exact for linear equations with constant inputs, and stable for steps of any
    length (Hochbruck and Ostermann 2010, section 2.2). Explicit methods would need steps as short
    as a bristle's time constant, which is a presliding distance over the largest speed.

    Each leaf of the state is an array `(states,)`. Leaves are treated as independent of each other.
    """

    def order(self, terms: PyTree) -> int:
        """Two."""
        return 2

    def step(self, terms, t0: Any, t1: Any, y0, args, solver_state, made_jump):
        """One step from t0 to t1."""
        h = t1 - t0
        leaves, structure = jax.tree.flatten(y0)

        def end(k: int) -> Float[Array, " _"]:
            def rate(leaf: Float[Array, " _"]) -> tuple[Float[Array, " _"], Float[Array, " _"]]:
                y = jax.tree.unflatten(structure, [*leaves[:k], leaf, *leaves[k + 1 :]])
                found = jax.tree.leaves(terms.vf(t0 + h / 2, y, args))[k]
                return found, found

            slope, now = jax.jacfwd(rate, has_aux=True)(leaves[k])
            return leaves[k] + h * _phi(h * slope) @ now

        # Most effects have no states.
        ends = [end(k) if leaf.size else leaf for k, leaf in enumerate(leaves)]
        y1 = jax.tree.unflatten(structure, ends)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def _phi(x: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """(exp(x) - 1) / x of a matrix, which may be singular."""
    n = x.shape[0]
    if n == 1:
        small = jnp.abs(x) < _SMALL
        safe = jnp.where(small, 1.0, x)
        return jnp.where(small, 1 + x / 2 + x**2 / 6, jnp.expm1(safe) / safe)
    # The upper right block of the exponential of [[x, 1], [0, 0]] (Van Loan 1978).
    wide = jnp.block([[x, jnp.eye(n)], [jnp.zeros((n, 2 * n))]])
    return jax.scipy.linalg.expm(wide)[:n, n:]
