"""Unrolls small array programs into programs of scalars, which compilers optimise far better.

The physics of a few joints is a hundred sums and products. With arrays of two elements, moving
pairs of numbers takes most of the run time and of the compilation. In unrolled form the only array
axis left is a batch of recordings or of tangents, and one processor instruction handles eight of
its elements.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from .decompositions import decomposed
from .kernels import plain_product, say_what_splits, summed_product
from .moves import MOVES
from .values import Fixed, Value

ELEMENTWISE = frozenset(
    """
    abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type
    copy copy_p cos cosh div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le
    lgamma log log1p logistic lt max min mul ne neg nextafter not or pow rem round rsqrt select_n
    sign sin sinh sqrt square stop_gradient sub tan tanh xor
    """.split()  # noqa: SIM905
)
INLINED = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr"}


def unrolled(fun: Callable[..., Any], *like: Any) -> Callable[..., Any]:
    """The same function, traced once and evaluated scalar by scalar.

    Operations that cannot be unrolled (loops, eigenvalues, functions with a custom derivative) and
    large arrays are evaluated as they are; a warning names those that XLA cannot compile as part
    of a loop's kernel.

    Values equal those of `fun` under `jax.jit`, including signed zeros, infinities and NaN, up to
    rounding (sums may be added in another order) and the sign of sums that contain only zeros. A
    product with a zero of a constant array is that zero, whatever the other factor.

    **Arguments:**

    - `fun`: a function of pytrees of arrays.
    - `like`: arguments with the shapes of later calls.
    """
    closed, shape = jax.make_jaxpr(fun, return_shape=True)(*like)
    structure = jax.tree.structure(shape)
    consts = [Value.constant(c) for c in closed.consts]
    for const in consts:
        # Done here, because the first use may be inside a loop.
        const.scalars() if const.small else const.whole()

    def evaluate(*args: Any) -> Any:
        inputs = [Value.of(leaf) for leaf in jax.tree.leaves(args)]
        outputs = _Writer().run(closed.jaxpr, consts, inputs)
        return jax.tree.unflatten(structure, [value.whole() for value in outputs])

    # A separate jitted function: the stages of a step share one trace of it, which is batched and
    # differentiated once. XLA inlines the calls.
    return jax.jit(evaluate)


def _known(x) -> bool:
    return isinstance(x, np.generic)


def _same(name: str, args: list[Any]):
    """The operand that an operation returns unchanged; None if it changes its operands.

    −0 + 0 is 0 by IEEE 754, but XLA also omits the addition of a known zero of either sign. Frames
    and axes of most arms are mostly zeros, with which products are omitted too.
    """
    if name == "select_n" and _known(args[0]):
        return args[1 + int(args[0])]
    if len(args) != 2:
        return None
    if name == "mul":
        zero = next((x for x in args if isinstance(x, Fixed) and x == 0), None)
        if zero is not None:
            return zero
    for a, known in (args, args[::-1]):
        neutral = {"add": 0, "mul": 1, "sub": 0 if known is args[1] else None}.get(name)
        if neutral is not None and _known(known) and known == neutral:
            return a
    return None


def _as_it_is(eqn, inputs: list[Value], origin) -> list[Value]:
    """One equation, part of the outermost one `origin`, evaluated with whole arrays."""
    whole = [v.whole() for v in inputs]
    out = summed_product(eqn, whole) or decomposed(eqn, whole)
    if out is None:
        say_what_splits(eqn, origin)
        out = _bound(eqn, whole, origin)
    shapes = [v.aval for v in eqn.outvars]
    return [Value(s.shape, s.dtype, array=o) for s, o in zip(shapes, out, strict=True)]


def _bound(eqn, whole: list[Any], origin) -> Sequence[Any]:
    """The result of the primitive itself on whole arrays."""
    given = eqn.primitive.get_bind_params(eqn.params)
    # Before jax 0.10, functions among the parameters were returned separately.
    functions, params = given if isinstance(given, tuple) else ((), given)
    if eqn.primitive.name == "custom_linear_solve":
        params = _with_solver_written_out(params, origin)
    out = eqn.primitive.bind(*functions, *whole, **params)
    return out if eqn.primitive.multiple_results else [out]


def _with_solver_written_out(params: dict[str, Any], origin) -> dict[str, Any]:
    """The parameters of a linear solve with unrolled functions; its derivative is still a solve.

    Only reverse mode needs the transposed functions.
    """

    def written(closed: ClosedJaxpr) -> ClosedJaxpr:
        def evaluate(*args):
            consts = [Value.of(c) for c in closed.consts]
            found = _Writer(origin).run(closed.jaxpr, consts, [Value.of(a) for a in args])
            return [value.whole() for value in found]

        return jax.make_jaxpr(evaluate)(*closed.in_avals)

    jaxprs = params["jaxprs"]
    jaxprs = jaxprs._replace(matvec=written(jaxprs.matvec), solve=written(jaxprs.solve))
    return {**params, "jaxprs": jaxprs}


class _Writer:
    """Evaluates a jaxpr, each scalar expression once."""

    def __init__(self, origin=None):
        self.seen: dict[Any, Any] = {}
        # Keys contain `id`s, so the objects with these must stay alive.
        self.alive: list[Any] = []
        # The equation that is being evaluated; the outermost one if equations are nested.
        self.origin = origin

    def run(self, jaxpr: Jaxpr, consts: list[Value], args: list[Value]) -> list[Value]:
        values: dict[Any, Value] = {}

        def look_up(atom) -> Value:
            if isinstance(atom, Literal):
                kind: Any = atom.aval
                return Value(kind.shape, kind.dtype, np.asarray(atom.val, kind.dtype))
            return values[atom]

        values.update(zip(jaxpr.constvars, consts, strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        for eqn in jaxpr.eqns:
            inputs = [look_up(atom) for atom in eqn.invars]
            values.update(zip(eqn.outvars, self.equation(eqn, inputs), strict=True))
        return [look_up(atom) for atom in jaxpr.outvars]

    def equation(self, eqn, inputs: list[Value]) -> list[Value]:
        name = eqn.primitive.name
        if name in INLINED:
            inner = eqn.params[INLINED[name]]
            if isinstance(inner, ClosedJaxpr):
                return self.inlined(eqn, inner, inputs)
        shapes = [v.aval for v in eqn.outvars]
        moved = name in MOVES and all(v.written_out for v in inputs)
        if moved or all(v.small for v in [*inputs, *map(Value.like, shapes)]):
            written = self.written(eqn, name, inputs)
            if written is not None:
                pieces = [written] if not eqn.primitive.multiple_results else written
                return [
                    Value(s.shape, s.dtype, scalars=w.reshape(s.shape))
                    for s, w in zip(shapes, pieces, strict=True)
                ]
        return _as_it_is(eqn, inputs, self.origin or eqn)

    def inlined(self, eqn, inner: ClosedJaxpr, inputs: list[Value]) -> list[Value]:
        """A separately traced function, inlined at its call."""
        before, self.origin = self.origin, self.origin or eqn
        found = self.run(inner.jaxpr, [Value.of(c) for c in inner.consts], inputs)
        self.origin = before
        return found

    def written(self, eqn, name: str, inputs: list[Value]):
        """The scalars of an equation's result; None if it cannot be unrolled."""
        p = eqn.params
        if name in ELEMENTWISE:
            return self.elementwise(eqn, [v.scalars() for v in inputs])
        if name in MOVES:
            return MOVES[name](p, *[v.scalars() for v in inputs])
        if name == "dot_general":
            return self.product(p, *inputs)
        if name == "reduce_sum":
            return self.total(p, inputs[0])
        if name == "cumsum":
            return self.running(p, inputs[0])
        if name == "iota":
            shape = [1] * len(p["shape"])
            shape[p["dimension"]] = -1
            count = np.arange(p["shape"][p["dimension"]]).astype(p["dtype"])
            return Value.of(np.broadcast_to(count.reshape(shape), p["shape"])).scalars()
        if name in ("scatter", "scatter-add", "scatter-mul"):
            return self.scattered(name, p, *inputs)
        return None

    def elementwise(self, eqn, arrays: list[np.ndarray]) -> np.ndarray:
        spread = np.broadcast_arrays(*arrays)
        out = np.empty(spread[0].shape, object)
        for at in np.ndindex(out.shape):
            out[at] = self.scalar(eqn.primitive, eqn.params, [a[at] for a in spread])
        return out

    def scalar(self, primitive, params, args: list[Any]):
        return self.once(primitive.name, params, args, partial(primitive.bind, **params))

    def once(self, name: str, params, args: list[Any], evaluate: Callable[..., Any]):
        """One scalar operation, or its earlier result."""
        if all(_known(a) for a in args):
            if name in ARITHMETIC:
                with np.errstate(all="ignore"):
                    found = ARITHMETIC[name](*args)
                fixed = any(isinstance(a, Fixed) for a in args) and found.dtype == float
                return Fixed(found) if fixed else found
            # XLA decides how numbers outside an integer type's range are converted.
            if name == "convert_element_type" and not (
                args[0].dtype.kind == "f" and np.dtype(params["new_dtype"]).kind in "iu"
            ):
                return np.asarray(args[0], params["new_dtype"])[()]
        same = _same(name, args)
        if same is not None:
            return same
        key = (
            name,
            tuple(sorted((k, str(v)) for k, v in params.items() if v is not None)),
            # Compared by their bits: −0 and 0 are equal, but dividing by them differs.
            tuple((a.dtype, a.tobytes()) if _known(a) else id(a) for a in args),
        )
        if key not in self.seen:
            self.alive.extend(args)
            self.seen[key] = evaluate(*args)
        return self.seen[key]

    def times(self, a, b):
        return self.once("mul", {}, [a, b], jax.lax.mul)

    def plus(self, a, b):
        return self.once("add", {}, [a, b], jax.lax.add)

    def added(self, terms: list[Any], dtype):
        """The sum of zero and the terms, added from first to last."""
        return reduce(self.plus, terms, np.zeros((), dtype)[()])

    def converted(self, value: Value, dtype) -> np.ndarray:
        """The scalars of a value in another type."""
        if value.dtype == dtype:
            return value.scalars()
        params = {"new_dtype": dtype, "weak_type": False}
        evaluate = partial(jax.lax.convert_element_type, new_dtype=dtype)
        out = np.empty(value.shape, object)
        for at in np.ndindex(value.shape):
            out[at] = self.once("convert_element_type", params, [value.scalars()[at]], evaluate)
        return out

    def product(self, p, left: Value, right: Value):
        (contract_left, contract_right), (batch_left, batch_right) = p["dimension_numbers"]
        wanted = np.dtype(p["preferred_element_type"] or left.dtype)
        if left.dtype != right.dtype or not plain_product(p, left.dtype):
            return None
        batch, shared = len(batch_left), len(contract_left)
        first = (*batch_left, *contract_left), (*batch_right, *contract_right)
        a, b = self.converted(left, wanted), self.converted(right, wanted)
        a = np.moveaxis(a, first[0], range(batch + shared))
        b = np.moveaxis(b, first[1], range(batch + shared))
        several, depth = a.shape[:batch], math.prod(a.shape[batch : batch + shared])
        rows, columns = a.shape[batch + shared :], b.shape[batch + shared :]
        a = a.reshape(math.prod(several), depth, math.prod(rows))
        b = b.reshape(math.prod(several), depth, math.prod(columns))
        out = np.empty((a.shape[0], a.shape[2], b.shape[2]), object)
        for n, i, j in np.ndindex(out.shape):
            terms = [self.times(a[n, k, i], b[n, k, j]) for k in range(depth)]
            out[n, i, j] = self.added(terms, wanted)
        return out.reshape(several + rows + columns)

    def running(self, p, value: Value):
        array = np.moveaxis(value.scalars(), p["axis"], 0)
        array = array[::-1] if p["reverse"] else array
        out = np.empty(array.shape, object)
        for at in np.ndindex(array.shape):
            out[at] = self.plus(out[at[0] - 1, *at[1:]], array[at]) if at[0] else array[at]
        return np.moveaxis(out[::-1] if p["reverse"] else out, 0, p["axis"])

    def total(self, p, value: Value):
        array = value.scalars()
        axes = tuple(p["axes"])
        moved = np.moveaxis(array, axes, range(len(axes)))
        kept = moved.shape[len(axes) :]
        out = np.empty(kept, object)
        for to in np.ndindex(kept):
            terms = [moved[at + to] for at in np.ndindex(moved.shape[: len(axes)])]
            out[to] = self.added(terms, value.dtype)
        return out

    def scattered(self, name, p, operand: Value, indices: Value, updates: Value):
        """Elements set, added to or multiplied: one, or all with one index along an axis.

        Indices must be known when the program is made.
        """
        numbers, at = p["dimension_numbers"], indices.scalars()
        indexed = tuple(numbers.inserted_window_dims)
        whole = [d for d in range(len(operand.shape)) if d not in indexed]
        plain = not (numbers.operand_batching_dims or numbers.scatter_indices_batching_dims)
        fits = at.shape == (len(indexed),) and updates.shape == tuple(
            operand.shape[d] for d in whole
        )
        if not plain or not fits or not all(_known(i) for i in at):
            return None
        if tuple(numbers.update_window_dims) != tuple(range(len(whole))):
            return None
        order = [numbers.scatter_dims_to_operand_dims.index(d) for d in indexed]
        index = {d: int(at[k]) for d, k in zip(indexed, order, strict=True)}
        if any(not 0 <= i < operand.shape[d] for d, i in index.items()):
            return None
        combine = {"scatter-add": self.plus, "scatter-mul": self.times}.get(name)
        out, given = operand.scalars().copy(), updates.scalars()
        for k in np.ndindex(given.shape):
            # The rest of the place, in the order of the axes.
            rest = iter(k)
            to = tuple(index[d] if d in index else next(rest) for d in range(out.ndim))
            out[to] = given[k] if combine is None else combine(out[to], given[k])
        return out


# Values worth evaluating when a program is traced: indices and zeros.
ARITHMETIC: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "neg": lambda a: -a,
    "lt": lambda a, b: a < b,
    "eq": lambda a, b: a == b,
}
