"""Decompositions of small matrices in a few array operations for each row.

A LAPACK call takes as long as the physics of a few joints, and prevents XLA from compiling the loop
around it as one kernel. Times in ms on a SCARA with `jnp.linalg.solve` in its torque, 501 samples
of 4 steps, this module / LAPACK (without a solve: 0.5 and 1.7):

| unknowns   | 2        | 4        | 6        | 8        | 10       |
| simulation | 1.2 / 20 | 2.6 / 20 | 4.7 / 27 | 8.4 / 20 | 13 / 45  |
| Jacobian   | 4.2 / 54 | 6.4 / 41 | 12 / 49  | 17 / 49  | 27 / 57  |

Compilation takes 2 to 4 s longer; with 10 unknowns, 8 s longer. In code unrolled to scalars, with a
selection for each element of each row that may be the pivot, six unknowns take 12 and 22 ms.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# Largest number of unknowns; larger systems go to LAPACK.
MOST_ROWS = 8


def decomposed(eqn, operands: list[Any]) -> tuple[Array, ...] | None:
    """Result of one of JAX's primitives for a small real matrix; None for any other equation."""
    name, matrix = eqn.primitive.name, operands[0] if operands else None
    if name not in _DECOMPOSITIONS or matrix is None or matrix.ndim != 2:
        return None
    square = matrix.shape[0] == matrix.shape[1] <= MOST_ROWS
    if not square or not jnp.issubdtype(matrix.dtype, jnp.floating):
        return None
    return _DECOMPOSITIONS[name](eqn.params, *map(jnp.asarray, operands))


def _lu(
    _, a: Float[Array, "n n"]
) -> tuple[Float[Array, "n n"], Int[Array, " n"], Int[Array, " n"]]:
    """Gaussian elimination with partial pivoting; factors, pivots, permutation as in LAPACK."""
    n = a.shape[0]
    row = order = jnp.arange(n, dtype=jnp.int32)
    pivots = []
    for k in range(n):
        sizes = jnp.where(row >= k, jnp.abs(a[:, k]), -1.0)
        pivot = jax.lax.argmax(sizes, 0, jnp.int32)
        swapped = jnp.where(row == k, pivot, jnp.where(row == pivot, k, row))
        a, order = a[swapped], order[swapped]
        factors = jnp.where(row > k, a[:, k] / a[k, k], 0.0)
        left = a - factors[:, None] * jnp.where(row > k, a[k], 0.0)
        a = jnp.where((row[:, None] > k) & (row == k), factors[:, None], left)
        pivots.append(pivot)
    return a, jnp.stack(pivots), order


def _triangular_solve(
    p: dict[str, Any], a: Float[Array, "n n"], b: Float[Array, "_ _"]
) -> tuple[Float[Array, "_ _"]]:
    """Substitution, one unknown after the other."""
    lower, transposed = p["lower"], p["transpose_a"]
    if not p["left_side"]:
        # X A = B is Aᵀ Xᵀ = Bᵀ.
        b, transposed = b.T, not transposed
    if transposed:
        a, lower = a.T, not lower
    if not lower:
        a, b = a[::-1, ::-1], b[::-1]
    found = []
    while b.shape[0]:
        x = b[0] if p["unit_diagonal"] else b[0] / a[0, 0]
        a, b = a[1:, 1:], b[1:] - a[1:, :1] * x
        found.append(x)
    x = jnp.stack(found if lower else found[::-1])
    return (x if p["left_side"] else x.T,)


def _cholesky(_, a: Float[Array, "n n"]) -> tuple[Float[Array, "n n"]]:
    """The lower triangular factor; NaN from the first pivot that is not positive."""
    n, columns = a.shape[0], []
    for k in range(n):
        column = a[:, 0] / jnp.sqrt(a[0, 0])
        a = a[1:, 1:] - jnp.outer(column[1:], column[1:])
        columns.append(jnp.pad(column, (k, 0)))
    return (jnp.stack(columns, axis=1),)


_DECOMPOSITIONS: dict[str, Callable[..., tuple[Array, ...]]] = {
    "cholesky": _cholesky,
    "lu": _lu,
    "triangular_solve": _triangular_solve,
}
