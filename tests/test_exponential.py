"""States of effects along a recorded motion, integrated by an exponential method."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
import scipy.linalg

import jaxid
from jaxid.discovery.linear import linearise
from jaxid.effects import Hysteresis, LuGre
from jaxid.simulation.batch import prepare
from jaxid.simulation.exponential import Exponential
from jaxid.simulation.integration import SIGNALS, initial
from jaxid.simulation.runs import run, run_with_sensitivities
from jaxid.simulation.steps import with_substeps

PERIOD = 0.004


def recorded() -> jaxid.Recording:
    """Two joints in motion at 250 Hz, with reversals, and at rest at the end."""
    time = np.arange(0.0, 1.6, PERIOD)
    moving = np.minimum(time, 1.2)
    q = np.stack(
        [0.8 * np.sin(5 * moving), 0.5 * np.cos(4 * moving) + 0.1 * np.sin(15 * moving)], axis=1
    )
    return jaxid.Recording(time=time, q=q, tau=np.zeros_like(q), q_ref=q)


def tracking(*effects):
    return jaxid.scara(jaxid.control.Tracking(cutoff=20.0)).add(*effects)


def bristle(effect, run) -> np.ndarray:
    """The bristle of an effect on joint 2 by LSODA, along a run's positions and velocities."""
    motion = scipy.interpolate.CubicHermiteSpline(run.time, run.q[:, 1], run.v[:, 1]).derivative()

    def rate(t, z):
        v = motion(t)
        steady = 1.0
        if isinstance(effect, LuGre):
            steady += float(effect.excess) * np.exp(-((v / float(effect.velocity)) ** 2))
        return (v - np.abs(v) * z / steady) / float(effect.slide)

    span, at = (run.time[0], run.time[-1]), run.time
    return scipy.integrate.solve_ivp(
        rate, span, [0.0], "LSODA", at, rtol=1e-7, atol=1e-9, max_step=PERIOD / 4
    ).y[0]


@pytest.mark.parametrize("slide", [0.05, 2e-3, 1e-5])
@pytest.mark.parametrize("kind", [Hysteresis, LuGre])
def test_a_bristle_follows_a_recorded_motion_as_by_scipy(kind, slide):
    effect = kind(joint=2, level=1.0, slide=slide)
    (with_it,) = jaxid.simulate(tracking(effect), recorded())
    (without,) = jaxid.simulate(tracking(), recorded())
    # The torque of the bristle alone; its damping is zero.
    error = (with_it.tau - without.tau)[:, 1] - bristle(effect, with_it)
    # Within the interval of a reversal the bristle turns over at the middle speed's rate.
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.median(np.abs(error)) < 1e-3


def test_a_short_presliding_distance_needs_no_more_steps():
    few = with_substeps(
        tracking(Hysteresis(joint=2, slide=0.05)), jaxid.Recordings.of(recorded())
    ).stepping.substeps
    many = with_substeps(
        tracking(Hysteresis(joint=2, slide=1e-6)), jaxid.Recordings.of(recorded())
    ).stepping.substeps
    assert few == many


@pytest.mark.parametrize("kind", [Hysteresis, LuGre])
def test_derivatives_of_a_bristle_are_those_of_differences(kind):
    loop = tracking(kind(joint=2, level=1.0, slide=0.01)).free("slide2")
    batch = prepare(loop, jaxid.Recordings.of(recorded()))
    intervals = jax.tree.map(lambda leaf: leaf[0], batch.intervals)
    x0 = initial(loop, intervals, batch.q0[0], batch.v0[0])
    (k,) = [n for n, p in enumerate(loop.free_parameters) if p.name == "slide2"]
    start = jnp.zeros((x0.size, loop.theta.size))

    @jax.jit
    def torque(slide):
        return run(loop.with_theta(loop.theta.at[k].set(slide)), intervals, x0, rows=(0,))[1]

    @jax.jit
    def slope():
        return run_with_sensitivities(loop, intervals, x0, start, (0,)).slopes[..., k]

    found, by_difference = slope(), (torque(0.01 + 1e-6) - torque(0.01 - 1e-6)) / 2e-6
    gap = np.linalg.norm(found - by_difference)
    assert gap < 1e-6 * np.linalg.norm(by_difference)


def test_a_linear_system_around_a_bristle_has_the_same_run():
    loop = tracking(Hysteresis(joint=2, level=1.0, slide=1e-3))
    recordings = jaxid.Recordings.of(recorded())
    batch = prepare(loop, recordings)
    linear = linearise(with_substeps(loop, recordings), batch, "tau")
    (run,) = jaxid.simulate(loop, recordings)
    seen = np.asarray(linear.seen[0, : len(run.time), SIGNALS.index("tau")])
    np.testing.assert_allclose(seen, run.tau, atol=1e-9 * np.abs(run.tau).max())
    # The bristle carries an error of its state on while it slides by a thousandth of a radian.
    assert np.any(np.abs(linear.A[0, :, -1, -1]) > 0.1)
    assert np.any(np.abs(linear.A[0, :, -1, -1]) < 0.01)


def ends(equation, y0, steps: int) -> np.ndarray:
    """The state after a second, in so many steps."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(equation), Exponential(), 0.0, 1.0, 1.0 / steps, y0
    )
    assert solution.ys is not None
    return np.asarray(jax.tree.leaves(solution.ys)[0][-1])


def test_linear_equations_are_exact_in_one_step():
    # Two coupled states, one of them fast, and one alone; the input is constant.
    slopes, push = jnp.array([[-300.0, 40.0], [0.5, -1.0]]), jnp.array([3.0, 1.0])
    y0 = {"pair": jnp.array([1.0, -2.0]), "single": jnp.array([2.0])}

    def equation(t, y, args):
        return {"pair": slopes @ y["pair"] + push, "single": 1.0 - 1e4 * y["single"]}

    wide = np.block([[np.asarray(slopes), np.asarray(push)[:, None]], [np.zeros((1, 3))]])
    expected = scipy.linalg.expm(wide) @ np.array([1.0, -2.0, 1.0])
    np.testing.assert_allclose(ends(equation, y0, 1), expected[:2], rtol=1e-9)


def test_the_error_falls_with_the_square_of_the_step():
    def pendulum(t, y, args):
        return jnp.array([y[1], -9.0 * jnp.sin(y[0]) - 0.5 * y[1] + jnp.cos(5 * t)])

    start = jnp.array([1.0, 0.0])
    exact = scipy.integrate.solve_ivp(
        lambda t, y: np.asarray(pendulum(t, y, None)), (0, 1), start, rtol=1e-10, atol=1e-12
    ).y[:, -1]
    coarse, fine = (np.linalg.norm(ends(pendulum, start, n) - exact) for n in (20, 40))
    assert 3.5 < coarse / fine < 4.5
