"""LAPACK's decompositions of small matrices, one after the other under `vmap`.

jaxlib (0.10) distributes a batch of matrices over the threads of a pool to which the caller
belongs. If two batches run on two cores at once, both threads wait for each other and the program
deadlocks. A single matrix is decomposed in the calling thread.
"""

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float


@sequential_vmap
def solve(
    matrix: Float[Array, "size size"], right: Float[Array, "size *columns"]
) -> Float[Array, "size *columns"]:
    """The solution of matrix @ x = right."""
    return jnp.linalg.solve(matrix, right)


@sequential_vmap
def _exponential(matrix: Float[Array, "size size"]) -> Float[Array, "size size"]:
    return jax.scipy.linalg.expm(matrix)


@jax.custom_jvp
def exponential(matrix: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """The matrix exponential, by a rational approximation that needs a linear solve."""
    return _exponential(matrix)


@exponential.defjvp
def _(primals, tangents):
    """By the exponential of a block matrix (Najfeld and Havel 1995)."""
    (matrix,), (along,) = primals, tangents
    n = matrix.shape[-1]
    both = _exponential(jnp.block([[matrix, along], [jnp.zeros_like(matrix), matrix]]))
    # The value is computed separately: under `vmap` it may lack the batch axis of its slopes.
    return _exponential(matrix), both[:n, n:]


@sequential_vmap
def column_basis(
    matrix: Float[Array, "rows columns"],
) -> tuple[Float[Array, "rows rank"], Float[Array, " rank"]]:
    """Left singular vectors and singular values, largest first."""
    basis, size, _ = jnp.linalg.svd(matrix, full_matrices=False)
    return basis, size


@sequential_vmap
def smallest_eigenvalue(matrix: Float[Array, "size size"]) -> Float[Array, ""]:
    """The smallest eigenvalue of a symmetric matrix."""
    return jnp.linalg.eigvalsh(matrix)[0]
