"""Programs written out scalar by scalar give the values and derivatives of the arrays."""

import dataclasses
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxid
from jaxid.simulation import kernels
from jaxid.simulation.moves import MOVES
from jaxid.simulation.unrolling import unrolled


def _gather(x, y):
    return jnp.stack([x[0] * y[1], x[1] - y[0]]).at[1].add(3.0).at[0].multiply(2.0)


def _shapes(x, y):
    m = jnp.outer(x, y) + jnp.eye(2)
    return (m.T @ x)[::-1], m.reshape(4)[1:3], jnp.concatenate([x, y]).sum(), jnp.diag(m)


def _choices(x, y):
    return jnp.where(x > y, x, jnp.clip(y, -0.5, 0.5)), jnp.maximum(x, y) ** 3, jnp.hypot(x, y)


def _decomposed(x, y):
    """What cannot be written out stays as it is: a decomposition, a loop, a rule of its own."""
    m = jnp.outer(x, x) + 2 * jnp.eye(2)
    looped = jax.lax.fori_loop(0, 3, lambda k, z: jnp.sin(z) + y, x)
    return jnp.linalg.solve(m, y), looped, jax.nn.relu(x), jax.nn.softplus(y)


def _large(x, y):
    knots = jnp.linspace(0, 1, 40)
    return jnp.exp(-((x[0] - knots) ** 2)) @ jnp.sin(knots * y[1]), jnp.sort(knots * x[1])[:3]


def _empty(x, y):
    return jnp.concatenate([x, jnp.zeros(0), y]), jnp.zeros((2, 2)) @ x + y


def _chain(x, y):
    """What arms of several joints are made of: sums along a chain, products link by link."""
    each = jnp.cumsum(jnp.stack([jnp.cos(jnp.cumsum(x)), y * x, x]), axis=0)
    turned = jnp.einsum("kx,kxi,kxj->ij", each, each[..., None] * x, each[..., None] * y)
    one, other, _ = each
    return turned, one * other, jnp.cumsum(each, axis=1, dtype=float)[::-1], jnp.cumsum(y[::-1])


def _derived(x, y):
    """Derivatives of a matrix by positions: more numbers than a matrix, and written out too."""

    def matrix(q):
        return jnp.outer(jnp.cos(q), jnp.sin(jnp.cumsum(q))) + jnp.eye(3)

    three = jnp.concatenate([x, y[:1]])
    return jax.jacfwd(matrix)(three) @ three, jax.grad(lambda q: matrix(q).sum())(three)


def _solved(x, y):
    """Decompositions that are written out; the first pivot is zero."""
    m = jnp.array([[0.0, 1.0, 2.0], [1.0, 0.5, 0.0], [-3.0, 1.0, 1.0]])
    m = m.at[1, 2].set(x[0]).at[2, 2].add(y[1])
    three = jnp.concatenate([x, y[:1]])
    positive = m.T @ m + jnp.eye(3)
    lower = jnp.linalg.cholesky(positive)
    return (
        jnp.linalg.solve(m, three),
        jnp.linalg.inv(m),
        jnp.linalg.det(m),
        jax.scipy.linalg.solve(positive, three, assume_a="pos"),
        jax.scipy.linalg.solve_triangular(lower, three, lower=True, trans=1),
        jax.lax.linalg.triangular_solve(lower, m, lower=True, unit_diagonal=True),
    )


def _network(x, y):
    """Layers too large to be written out, and small enough to be sums of columns."""
    first = jnp.sin(jnp.arange(64.0).reshape(16, 4))
    second = jnp.cos(jnp.arange(256.0).reshape(16, 16)) / 16
    hidden = jnp.tanh(first @ jnp.concatenate([x, y]))
    return jnp.tanh(second @ hidden), jnp.stack([hidden, hidden + 1]) @ first, hidden @ hidden


CASES = [_gather, _shapes, _choices, _decomposed, _large, _empty, _chain, _derived]
CASES += [_solved, _network]


@pytest.mark.parametrize("fun", CASES, ids=lambda f: f.__name__.strip("_"))
def test_values_and_derivatives_are_those_of_the_arrays(fun):
    x, y = jnp.array([0.3, -1.2]), jnp.array([0.7, 0.4])

    @jax.jit
    def both(x, y):
        written = unrolled(fun, x, y)
        return (fun(x, y), jax.jacfwd(fun)(x, y)), (written(x, y), jax.jacfwd(written)(x, y))

    expected, found = both(x, y)
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-13, atol=1e-13)


def _bits(tree) -> list[bytes]:
    # Which NaN it is depends on the instruction.
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return [np.where(np.isnan(leaf), np.nan, leaf).tobytes() for leaf in leaves]


@pytest.mark.parametrize(
    "fun",
    [
        lambda x: 1 / jnp.stack([x * 0.0, x * -0.0]),
        lambda x: jnp.copysign(1.0, jnp.stack([-0.0 * x, 0.0 * x])),
        lambda x: jnp.stack([jnp.arctan2(x * 0.0, -1.0), jnp.arctan2(x * -0.0, -1.0)]),
        lambda x: jnp.stack([x - 0.0, x + -0.0, x + 0.0, 0.0 - x, -0.0 - x, 1.0 * x]),
    ],
    ids=["reciprocal", "copysign", "arctan2", "neutral"],
)
def test_zeros_keep_their_signs(fun):
    for x in (0.5, 0.0, -0.0):
        assert _bits(unrolled(fun, x)(x)) == _bits(jax.jit(fun)(x))


_PLACES = st.integers(0, 5)
_STEPS = st.lists(
    st.tuples(
        st.sampled_from(["add", "sub", "mul", "select", "neg"]),
        _PLACES,
        st.one_of(_PLACES, st.sampled_from([0.0, -0.0, 1.0, -1.0, 2.0, -0.5])),
    ),
    min_size=1,
    max_size=6,
)


@settings(max_examples=25, deadline=None)
@given(
    steps=_STEPS,
    inputs=st.lists(
        st.sampled_from([0.0, -0.0, 1.0, -2.0, 0.5, np.inf, -np.inf, np.nan]),
        min_size=4,
        max_size=4,
    ),
)
def test_small_programs_give_the_bits_of_the_arrays(steps, inputs):
    """All sums and products of these few powers of two are exact, in whatever order."""

    def program(x):
        values = [x[:2], x[2:]]
        for name, one, other in steps:
            a = values[one % len(values)]
            b = values[other % len(values)] if isinstance(other, int) else other
            values.append(
                {
                    "add": lambda a, b: a + b,
                    "sub": lambda a, b: a - b,
                    "mul": lambda a, b: a * b,
                    "select": lambda a, b: jnp.where(a > b, b, a),
                    "neg": lambda a, _: -a,
                }[name](a, b)
            )
        # The sign of a NaN has no meaning, and compilers do not keep it.
        last = values[-1]
        return values, jnp.where(jnp.isnan(last), last, jnp.copysign(1.0, last))

    x = jnp.array(inputs)
    assert _bits(unrolled(program, x)(x)) == _bits(jax.jit(program)(x))


def test_products_are_summed_in_the_type_that_is_asked_for():
    x = jnp.array([0.1, 0.7, -0.3], jnp.float32)
    wide = jnp.array([1.1, -0.7, 0.3])
    few = jnp.array([100, 90, 80], jnp.int8)

    def product(a, wanted):
        found = unrolled(lambda a: jax.lax.dot(a, a, preferred_element_type=wanted), a)(a)
        assert found.dtype == wanted
        return found

    # To single precision the two differ in the eighth digit.
    exact = np.asarray(x, np.float64) @ np.asarray(x, np.float64)
    np.testing.assert_allclose(product(x, jnp.float64), exact, rtol=1e-15)
    assert product(few, jnp.int32) == 100**2 + 90**2 + 80**2
    np.testing.assert_allclose(product(wide, jnp.float32), wide @ wide, rtol=1e-6)


@pytest.mark.parametrize("n", [1, 3, 8])
def test_small_systems_are_solved_with_pivots(n):
    rng = np.random.default_rng(n)
    # Well conditioned, but its diagonal is zero where n is above one.
    matrix = np.roll(np.diag(rng.uniform(1, 3, n)), 1, axis=0) + (n > 1) * 0.1 * np.tri(n, k=-1)
    right = rng.standard_normal(n)
    found = unrolled(jnp.linalg.solve, matrix, right)(matrix, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-13, atol=1e-13)


def _primitives(fun, *args) -> set[str]:
    found = set()

    def walk(jaxpr):
        for eqn in jaxpr.eqns:
            found.add(eqn.primitive.name)
            # The transposed solve is reverse mode's alone.
            if eqn.primitive.name == "custom_linear_solve":
                walk(eqn.params["jaxprs"].solve.jaxpr)
                walk(eqn.params["jaxprs"].matvec.jaxpr)
                continue
            for value in eqn.params.values():
                inner = getattr(value, "jaxpr", value)
                if hasattr(inner, "eqns"):
                    walk(inner)

    walk(jax.make_jaxpr(unrolled(fun, *args))(*args).jaxpr)
    return found


def test_what_splits_a_kernel_is_avoided_up_to_a_size():
    def solved(n):
        return _primitives(jnp.linalg.solve, jnp.eye(n), jnp.ones(n))

    def layer(n):
        return _primitives(lambda m, x: jnp.tanh(m @ x), jnp.ones((n, n)), jnp.ones(n))

    lapack = {"lu", "triangular_solve"}
    assert not lapack & solved(8)
    assert lapack <= solved(9)
    assert "dot_general" not in layer(32)
    assert "dot_general" in layer(33)
    # A product of two vectors is a sum to XLA, however long.
    assert "dot_general" in _primitives(jnp.dot, jnp.ones(40), jnp.ones(40))


def test_what_it_closes_over_may_be_used_in_a_loop_and_after_it():
    @jax.jit
    def looped(weights, x):
        written = unrolled(lambda z: weights * jnp.sin(z), x)
        inside = jax.lax.scan(lambda z, _: (written(z), None), x, length=3)[0]
        return inside, written(x)

    weights, x = jnp.array([0.5, 2.0]), jnp.array([0.1, 0.2])
    expected = x
    for _ in range(3):
        expected = weights * jnp.sin(expected)
    inside, after = looped(weights, x)
    np.testing.assert_allclose(inside, expected, rtol=1e-14)
    np.testing.assert_allclose(after, weights * jnp.sin(x), rtol=1e-14)


def test_products_and_sums_have_gradients():
    # By forward and by reverse mode: both go through what was written out.
    m = jnp.array([[0.5, 2.0], [1.0, -0.3]])

    def whole(x):
        return jnp.sum(m @ jnp.sin(x * (m @ x)))

    x = jnp.array([0.4, -0.7])
    expected = jax.grad(whole)(x)
    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(lambda z: unrolled(whole, z)(z))(x)
        np.testing.assert_allclose(found, expected, rtol=1e-13)


class _Lapack(jaxid.effects.AbstractEffect):
    """A user's effect with a decomposition in it."""

    level: jax.Array = jaxid.parameter(0.1, symbol="L", unit="N·m", scale=0.1)

    def torque(self, motion):
        metric = jnp.outer(motion.v, motion.v) + jnp.eye(2)
        return self.level * jnp.linalg.solve(metric, motion.v)


class _ByHand(jaxid.effects.AbstractEffect):
    """The same without one (Sherman and Morrison)."""

    level: jax.Array = jaxid.parameter(0.1, symbol="L", unit="N·m", scale=0.1)

    def torque(self, motion):
        return self.level * motion.v / (1 + motion.v @ motion.v)


class _Own(jaxid.effects.AbstractEffect):
    """A torque of the user's."""

    rule: Callable
    level: jax.Array = jaxid.parameter(0.1, symbol="L", unit="N·m", scale=0.1)

    def torque(self, motion):
        return self.level * self.rule(jnp.concatenate([motion.q, motion.v]))


def _traced(*effects: jaxid.effects.AbstractEffect) -> list[str]:
    """What is said when a simulation with effects is traced."""
    from jaxid.simulation.batch import prepare
    from jaxid.simulation.integration import initial
    from jaxid.simulation.runs import run

    time = np.linspace(0, 0.2, 21)
    q = 0.1 * np.sin(time)[:, None] * np.ones(2)
    loop = jaxid.scara().add(*effects)
    batch = prepare(loop, jaxid.Recordings.of(jaxid.Recording.from_arrays(time, q, q, q_ref=q)))
    intervals = jax.tree.map(lambda leaf: leaf[0], batch.intervals)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        start = initial(loop, intervals, batch.q0[0], batch.v0[0])
        jax.eval_shape(lambda x: run(loop, intervals, x)[1], start)
    return [str(w.message) for w in said if issubclass(w.category, jaxid.errors.JaxidWarning)]


def test_what_splits_the_loop_is_said_once_and_of_whom(monkeypatch):
    monkeypatch.setattr(kernels, "_SAID", set())
    slow = _Own(lambda x: jnp.linalg.eigvalsh(jnp.outer(x[2:], x[2:])))
    (message,) = _traced(slow)
    assert "_Own.torque (test_unrolling.py, line" in message
    assert "eigh" in message
    assert _traced(slow) == []
    monkeypatch.setattr(kernels, "_SAID", set())
    in_a_loop = _Own(lambda x: jax.lax.fori_loop(0, 2, lambda _, z: jnp.sort(z), x)[:2])
    (message,) = _traced(in_a_loop)
    assert "sort" in message


def test_nothing_is_said_of_what_stays_fast(monkeypatch):
    monkeypatch.setattr(kernels, "_SAID", set())
    network = eqx.nn.MLP(4, 2, 32, 2, key=jax.random.key(0))
    assert _traced(_Own(network), _Lapack()) == []
    # A joint has one transmission.
    two = [e for e in jaxid.catalogue if not issubclass(e, jaxid.effects.Backlash)]
    fields = [{f.name for f in dataclasses.fields(e)} for e in two]
    # Effects along a chain are for arms in space.
    two, fields = (
        [e for e, f in zip(two, fields, strict=True) if "chain" not in f],
        [f for f in fields if "chain" not in f],
    )
    built_in = [e(joint=1) if "joint" in f else e() for e, f in zip(two, fields, strict=True)]
    assert _traced(*built_in) == []
    assert _traced(jaxid.effects.Backlash(joint=1)) == []


def test_an_effect_that_calls_lapack_still_simulates(quick_reference):
    found, expected = (
        jaxid.simulate(jaxid.scara().add(effect()), quick_reference)[0].tau
        for effect in (_Lapack, _ByHand)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


@pytest.fixture
def quick_reference():
    time = 0.01 * np.arange(60)
    q = np.stack([0.3 * np.sin(3 * time) ** 2, 0.2 * np.sin(5 * time) ** 2], axis=1)
    return jaxid.Recording.from_arrays(time, q, q + 0.1 * time[:, None], q_ref=q)


def test_a_program_for_any_number_of_steps_gives_the_numbers_of_a_fixed_one(quick_reference):
    from jaxid.simulation.batch import prepare
    from jaxid.simulation.integration import initial
    from jaxid.simulation.runs import run
    from jaxid.simulation.steps import set_substeps

    batch = prepare(jaxid.scara(), jaxid.Recordings.of(quick_reference))
    intervals = jax.tree.map(lambda leaf: leaf[0], batch.intervals)

    @eqx.filter_jit
    def signals(loop, steps):
        return run(loop, intervals, initial(loop, intervals, batch.q0[0], batch.v0[0]), steps)[1]

    fixed = signals(set_substeps(jaxid.scara(), 3), None)
    found = signals(jaxid.scara(), jnp.asarray(3))
    np.testing.assert_allclose(found, fixed, rtol=1e-12, atol=1e-12)


def test_a_vector_is_unstacked_into_scalars() -> None:
    # From jax 0.12 on, this is a primitive of its own.
    def product(x):
        a, b, c = jnp.unstack(x)
        return a * b - c

    x = jnp.array([2.0, 3.0, 5.0])
    assert unrolled(product, x)(x) == 1.0
    pieces = MOVES["unstack"]({"axis": 0}, np.array([1.0, 2.0], object))
    assert [(p.shape, p.item()) for p in pieces] == [((), 1.0), ((), 2.0)]
