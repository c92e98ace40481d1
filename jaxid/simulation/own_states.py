"""Effects' own states along a given motion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects import AbstractEffect, Motion
from ..linear_algebra import exponential

# Slopes that differ by less, relative to the largest one, share their exponential: sample times are
# often rounded.
_SAME = 1e-3


def settled_states(effect: AbstractEffect, motion: Motion) -> Float[Array, "points states"]:
    """The effect's own states along a motion, by an exponential step for each interval.

    Friction and lags make the states stiff. The step is exact if the rate is linear in the state
    and its input is linear from sample to sample.
    """
    first = jax.tree.map(lambda leaf: leaf[0], motion)
    start = effect.settled(eqx.tree_at(lambda m: m.state, first, effect.initial_state()))
    n = start.shape[0]
    if n == 0:
        return jnp.zeros((motion.t.shape[0], 0))
    # One state has a closed form. Otherwise an exponential is computed where the slope changes.
    weights = _weights_of_one if n == 1 else _weights

    def body(carry, pair):
        (x, known), (now, then) = carry, pair
        middle = jax.tree.map(lambda a, b: 0.5 * (a + b), now, then)
        middle = dataclasses.replace(middle, label=now.label)

        def rate(state, at):
            return effect.derivative(eqx.tree_at(lambda m: m.state, at, state))

        h = then.t - now.t
        slope, begin, end = jax.jacfwd(rate)(x, middle), rate(x, now), rate(x, then)
        known = weights(h * slope, known)
        return (x + known.rate @ (h * begin) + known.change @ (h * (end - begin)), known), x

    following = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), motion)
    # No slope is known at first.
    known = _Weights(jnp.full((n, n), jnp.inf), jnp.eye(n), jnp.eye(n))
    return jax.lax.scan(body, (start, known), (motion, following))[1]


class _Weights(eqx.Module):
    """Matrices W and V with x(1) - x(0) = W r + V c, for x' = slope (x - x(0)) + r + t c."""

    slope: Float[Array, "states states"]
    rate: Float[Array, "states states"]
    change: Float[Array, "states states"]


def _weights_of_one(slope: Float[Array, "1 1"], known: _Weights) -> _Weights:
    small = jnp.abs(slope) < 1e-4
    safe = jnp.where(small, 1.0, slope)
    rate = jnp.where(small, 1 + slope / 2, jnp.expm1(safe) / safe)
    change = jnp.where(small, 0.5 + slope / 6, (rate - 1) / safe)
    return _Weights(slope, rate, change)


def _weights(slope: Float[Array, "states states"], known: _Weights) -> _Weights:
    """The known matrices, unless the slope is another one."""
    n = slope.shape[0]

    def computed() -> _Weights:
        # The integrals are blocks of the exponential of a larger matrix (Van Loan 1978).
        zero, one = jnp.zeros((n, n)), jnp.eye(n)
        blocks = [[slope, one, zero], [zero, zero, one], [zero, zero, zero]]
        found = exponential(jnp.block(blocks))
        return _Weights(slope, found[:n, n : 2 * n], found[:n, 2 * n :])

    apart = jnp.max(jnp.abs(slope - known.slope)) > _SAME * jnp.max(jnp.abs(slope))
    return jax.lax.cond(apart, computed, lambda: known)
