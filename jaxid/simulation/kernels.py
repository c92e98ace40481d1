"""Operations that prevent XLA from compiling a loop as one kernel on a CPU, and replacements.

A loop whose body contains a matrix product, a LAPACK call, a sort or the like is run operation by
operation, and each operation costs as much as the whole physics of a few joints.
"""

import math
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..errors import JaxidWarning

# XLA's rule (`small_while_loop_hoisting_pass.cc`), as JAX primitives that lower to such operations.
# Each was confirmed in a compiled Jacobian; convolutions, searches and `argmax` were not affected.
_SPLITTING = frozenset(
    """
    cholesky dot_general eig eigh fft geqrf householder_product io_callback lu pure_callback qr
    ragged_dot_general scatter scatter-add scatter-max scatter-min scatter-mul schur sort svd top_k
    triangular_solve tridiagonal tridiagonal_solve
    """.split()  # noqa: SIM905
)
# Up to these sizes matrix products are written as sums of columns. Times on a SCARA with a network
# of two hidden layers in its torque, 501 samples of 4 steps, in ms with sums / with products
# (without a network the simulation takes 0.5, the Jacobian 1.7):
#   layers of 16: simulation 1.5 / 1.7, Jacobian 9 / 41
#   layers of 32: simulation 2.6 / 2.5, Jacobian 30 / 60
# In code unrolled to scalars the larger network took 9 (simulation) and 185 (Jacobian). One
# reduction over all columns takes 6 for the smaller network's Jacobian. With 49 parameters it takes
# 340, because XLA moves it out of the kernel; sums of columns then take 100.
_MOST_PRODUCTS, _DEEPEST = 1024, 64


def plain_product(params, dtype) -> bool:
    """Whether a product names no algorithm and its accumulation type holds its operands."""
    wanted = params["preferred_element_type"] or dtype
    precision = params["precision"]
    usual = precision is None or isinstance(precision, (tuple, jax.lax.Precision))
    return usual and np.dtype(dtype).kind in "fiu" and np.promote_types(dtype, wanted) == wanted


def summed_product(eqn, operands: list[Any]) -> tuple[Array] | None:
    """A small product with a matrix, as a sum of products of columns; None for other products.

    XLA already compiles products of two vectors as sums.
    """
    if eqn.primitive.name != "dot_general" or not _summed(eqn):
        return None
    params, out, (left, right) = eqn.params, eqn.outvars[0].aval, operands
    if left.dtype != right.dtype or not plain_product(params, left.dtype):
        return None
    (a, b), _ = params["dimension_numbers"]
    depth = math.prod(left.shape[d] for d in a)
    rows = [n for d, n in enumerate(left.shape) if d not in a]
    columns = [n for d, n in enumerate(right.shape) if d not in b]
    left, right = jnp.asarray(left, out.dtype), jnp.asarray(right, out.dtype)
    left = jnp.moveaxis(left, a, range(len(a))).reshape(depth, *rows, *(1 for _ in columns))
    right = jnp.moveaxis(right, b, range(len(b))).reshape(depth, *(1 for _ in rows), *columns)
    terms = [left[k] * right[k] for k in range(depth)]
    while len(terms) > 1:
        pairs = zip(terms[::2], terms[1::2], strict=False)
        terms = [x + y for x, y in pairs] + terms[len(terms) // 2 * 2 :]
    return (terms[0],)


def _summed(eqn) -> bool:
    """Whether a product is small enough to be written as sums."""
    params, out = eqn.params, eqn.outvars[0].aval
    (contracted, _), batch = params["dimension_numbers"]
    depth = math.prod(eqn.invars[0].aval.shape[d] for d in contracted)
    return (
        not any(batch)
        and out.size > 1
        and 0 < depth <= _DEEPEST
        and depth * out.size <= _MOST_PRODUCTS
    )


# Functions that a warning has named; a fit compiles half a dozen programs of one loop.
_SAID: set[str] = set()


def say_what_splits(eqn, origin) -> None:
    """Warns, once per function of the model, of an operation that a loop's kernel cannot contain.

    Chains of bodies are not named: they are jaxid's, and users cannot change them.

    **Arguments:**

    - `eqn`: an equation that is evaluated with whole arrays.
    - `origin`: the outer equation, which has the source location.
    """
    found = _splitting(eqn)
    if found is None or jax.default_backend() != "cpu":
        return
    who = _written_in(origin)
    if who is None or who in _SAID:
        return
    _SAID.add(who)
    warnings.warn(
        f"{who} calls {found}, which XLA does not compile into the kernel of a simulation's loop; "
        "simulations and fits may take 20 times as long: use only sums, products of at most 1024 "
        "terms and solves for at most 8 unknowns, or accept the longer time",
        JaxidWarning,
        stacklevel=2,
    )


def _splitting(eqn) -> str | None:
    """The name of an operation in an equation that a kernel cannot contain."""
    name = eqn.primitive.name
    if name == "dot_general" and eqn.outvars[0].aval.size == 1:
        return None
    # A single window is updated like a slice.
    if name.startswith("scatter") and math.prod(eqn.invars[1].aval.shape[:-1]) == 1:
        return None
    if name in _SPLITTING:
        return name
    if name == "custom_linear_solve":
        # Its parts are evaluated one by one.
        return None
    for value in jax.tree.leaves(eqn.params, is_leaf=lambda x: hasattr(x, "eqns")):
        inner = getattr(value, "jaxpr", value)
        for part in getattr(inner, "eqns", ()):
            found = _splitting(part)
            if found is not None:
                return found
    return None


_LIBRARIES = tuple(
    str(Path(sys.modules[name].__file__ or "").parent) for name in ("jax", "jaxlib", "equinox")
)
_HERE = str(Path(__file__).parent)
_CHAIN = str(Path(__file__).parents[1] / "chain.py")


def _written_in(eqn) -> str | None:
    """The function of the model that an equation comes from: the last that the simulation called;
    None for a chain of bodies."""
    frames = getattr(getattr(eqn.source_info, "traceback", None), "frames", ())
    called, own = "the model", False
    for frame in frames:
        if frame.file_name.startswith(_HERE):
            break
        if not frame.file_name.startswith(_LIBRARIES):
            own |= frame.file_name == _CHAIN
            called = f"{frame.function_name} ({Path(frame.file_name).name}, line {frame.line_num})"
    return None if own else called
