"""The regression split of every arm, differentiated along motions, against its regressor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.arms import SCARA, AbstractArm, Axis, TwoLink

ARMS = {
    "two-link": TwoLink(p3=0.02),
    "two-link of known length": TwoLink(link_length=0.3),
    "scara": SCARA(MX2=0.24, MY2=0.01),
    "axis": Axis(),
}


def along(lines, t):
    """Position on a random multi-sine, (joints,)."""
    size, rate, phase = lines
    return jnp.sum(size * jnp.sin(rate * t + phase), axis=-1)


def draw(seed, joints):
    """Amplitudes in rad, rates in rad/s and phases of four lines a joint."""
    rng = np.random.default_rng(seed)
    shape = (joints, 4)
    return tuple(
        jnp.asarray(x)
        for x in (
            rng.normal(size=shape),
            rng.uniform(0.5, 9.0, shape),
            rng.uniform(0, 2 * np.pi, shape),
        )
    )


def both(arm, split, lines, t):
    """The regressor, and the split differentiated in time, at one instant."""

    def rate(f):
        return lambda t: jax.jvp(f, (t,), (1.0,))[1]

    def position(t):
        return along(lines, t)

    velocity, acceleration = rate(position), rate(rate(position))

    def part(name):
        return lambda t: getattr(split(position(t), velocity(t)), name)

    sum_of_parts = rate(rate(part("second")))(t) + rate(part("first"))(t) + part("zeroth")(t)
    return arm.regressor(position(t), velocity(t), acceleration(t)), sum_of_parts


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("general", [False, True], ids=["declared", "by Lagrange"])
def test_split_differentiates_to_the_regressor(name, general):
    arm = ARMS[name]

    def split(q, v):
        return AbstractArm.split(arm, q, v) if general else arm.split(q, v)

    times = jnp.asarray(np.random.default_rng(3).uniform(0.0, 10.0, 50))
    compared = jax.jit(jax.vmap(lambda t, lines: both(arm, split, lines, t), (0, None)))
    for seed in range(3):
        expected, found = compared(times, draw(seed, arm.joints))
        # Sums of a few terms of the regressor's own size.
        assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.parametrize("name", ARMS)
def test_second_part_holds_positions_alone(name):
    arm = ARMS[name]
    q = jnp.asarray(np.random.default_rng(4).normal(size=arm.joints))
    by_velocity = jax.jacfwd(lambda v: arm.split(q, v).second)(jnp.ones(arm.joints))
    assert np.all(by_velocity == 0)
    assert jaxid.arms.Split is type(arm.split(q, q))
