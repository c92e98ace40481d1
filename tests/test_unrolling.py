"""Programs written out scalar by scalar give the values and derivatives of the arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
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


CASES = [_gather, _shapes, _choices, _decomposed, _large, _empty, _chain, _derived]


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
    from jaxid.simulation.runs import initial, prepare, run, set_substeps

    batch = prepare(jaxid.scara(), jaxid.Recordings.of(quick_reference))
    intervals = jax.tree.map(lambda leaf: leaf[0], batch.intervals)

    @eqx.filter_jit
    def signals(loop, steps):
        return run(loop, intervals, initial(loop, intervals, batch.q0[0], batch.v0[0]), steps)[1]

    fixed = signals(set_substeps(jaxid.scara(), 3), None)
    found = signals(jaxid.scara(), jnp.asarray(3))
    np.testing.assert_allclose(found, fixed, rtol=1e-12, atol=1e-12)
