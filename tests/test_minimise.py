"""The minimiser and its parts, against dense linear algebra, SciPy and published minima."""

import dataclasses
import time

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from scipy import optimize

import jaxid
from jaxid.control import Sampled
from jaxid.errors import FitError
from jaxid.estimate import minimise as room
from jaxid.estimate.minimise import (
    Arrow,
    BoundedDescent,
    LevenbergMarquardt,
    Problem,
    linearise,
    promised,
    with_curvature,
    with_derivatives,
)
from jaxid.parameters import Bounds
from jaxid.simulation.batch import prepare

Products = optx.FunctionInfo.EvalGradHessian
pytestmark = pytest.mark.xdist_group("minimise")


def random_products(rng, recordings=3, rows=20, p=4, initials=2):
    """Products of random derivatives, all derivatives as one matrix, and the residual."""
    r = rng.standard_normal((recordings, rows))
    j = rng.standard_normal((recordings, rows, p)) * [1.0, 30.0, 0.1, 5.0]
    s = rng.standard_normal((recordings, rows, initials)) * [1.0, 10.0][:initials]
    arrow = Arrow(
        jnp.einsum("rkp,rkq->pq", j, j),
        jnp.einsum("rka,rkb->rab", s, s),
        jnp.einsum("rka,rkp->rap", s, j),
    )
    grad = jnp.einsum("rkp,rk->p", j, r), jnp.einsum("rka,rk->ra", s, r)
    wide = np.zeros((recordings, rows, p + recordings * initials))
    wide[..., :p] = j
    for k in range(recordings):
        wide[k, :, p + k * initials : p + (k + 1) * initials] = s[k]
    products = Products(jnp.sum(r**2) / 2, grad, arrow)
    return products, wide.reshape(-1, wide.shape[-1]), r.reshape(-1)


def step_of(products, size, lower=-np.inf, upper=np.inf):
    """The step from zero, and its promise for the squared error."""
    y = jax.tree.map(jnp.zeros_like, products.grad)
    descent = BoundedDescent(jnp.full_like(y[0], lower), jnp.full_like(y[0], upper))
    blank = jax.tree.map(jnp.zeros_like, products)
    state = descent.query(y, products, descent.init(y, blank))
    (theta, start), _ = descent.step(jnp.asarray(size), state)
    return theta, start, 2 * promised((theta, start), products)


def test_an_arrow_is_the_matrix_that_it_stands_for():
    products, wide, _ = random_products(np.random.default_rng(1))
    arrow = products.hessian
    whole = wide.T @ wide
    np.testing.assert_allclose(arrow.as_matrix(), whole, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(lx.diagonal(arrow), np.diag(whole), rtol=1e-12)
    theta, start = arrow.mv(products.grad)
    flat = np.concatenate([products.grad[0], np.ravel(products.grad[1])])
    np.testing.assert_allclose(np.concatenate([theta, start.ravel()]), whole @ flat, rtol=1e-10)
    solved = lx.linear_solve(arrow, products.grad, lx.Cholesky()).value
    dense = np.linalg.solve(whole, flat)
    np.testing.assert_allclose(np.concatenate([solved[0], solved[1].ravel()]), dense, rtol=1e-8)


def test_eliminating_initial_states_gives_the_dense_step():
    products, wide, r = random_products(np.random.default_rng(0))
    step, start, gain = step_of(products, 10.0)
    damped = wide.T @ wide + 0.1 * np.diag(np.sum(wide**2, axis=0))
    dense = -np.linalg.solve(damped, wide.T @ r)
    assert np.allclose(step, dense[:4])
    assert np.allclose(start.reshape(-1), dense[4:])
    # The promise is the quadratic model's, exactly.
    assert np.isclose(gain, np.sum(r**2) - np.sum((r + wide @ dense) ** 2))


def test_a_step_into_bounds_is_the_best_within_them():
    for seed in range(20):
        products, wide, r = random_products(np.random.default_rng(seed), initials=0)
        step, _, gain = step_of(products, 1e10, -0.02, 0.02)
        best = optimize.lsq_linear(wide, -r, (-0.02, 0.02), tol=1e-12)
        promise = np.sum(r**2) - 2 * best.cost
        assert np.all(np.abs(step) <= 0.02)
        # Freezing what overshoots is not an exact quadratic program, but most of one.
        assert 0.8 * promise <= gain <= promise * (1 + 1e-6)


def own_solver(lower, upper):
    """Ours, with a tolerance at which rounding decides."""
    return LevenbergMarquardt(
        BoundedDescent(jnp.asarray(lower), jnp.asarray(upper)), tolerance=1e-6, worth=0.0
    )


def nothing():
    """Initial states where none are estimated."""
    return jnp.zeros((0, 0))


def test_published_minima_are_found_through_optimistix():
    """Misra1a of NIST's reference datasets for nonlinear regression (StRD)."""
    x = np.array([77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8,
                  593.1, 689.1, 760.0])  # fmt: skip
    y = np.array([10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01,
                  66.40, 75.47, 81.78])  # fmt: skip

    def residual(b, args):
        theta, _ = b
        return theta[0] * (1 - jnp.exp(-theta[1] * x)) - y

    solver = own_solver([-np.inf, -np.inf], [np.inf, np.inf])
    found = optx.least_squares(
        residual, solver, (jnp.array([500.0, 1e-4]), nothing()), max_steps=200
    )
    certified = np.array([2.3894212918e2, 5.5015643181e-4])
    np.testing.assert_allclose(found.value[0], certified, rtol=1e-8)


def test_a_large_residual_is_minimised_in_few_steps():
    """At the minimum the curvature is a fifth of J'J: Gauss-Newton steps cover a fifth each."""

    def residual(b, args):
        x, _ = b
        return jnp.stack([x[0], 2.0 - 0.2 * x[0] ** 2, x[1] - 3.0])

    solver, first = own_solver([-np.inf] * 2, [np.inf] * 2), jnp.array([0.5, 3.0])
    # It takes 6 steps, and 52 without the correction.
    found = optx.least_squares(residual, solver, (first, nothing()), max_steps=12)
    np.testing.assert_allclose(found.value[0], [0.0, 3.0], atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_the_hessian_has_the_curvature_along_the_last_step(seed):
    """The secant equation; convex also where the gradients show a negative curvature."""
    rng = np.random.default_rng(seed)
    products, wide, _ = random_products(rng, initials=0)
    gram, step = wide.T @ wide, rng.standard_normal(4)
    for curvature in (gram / 2, gram / 2 + 0.01 * np.diag(np.diag(gram))):
        change = curvature @ step
        before = dataclasses.replace(products, grad=(products.grad[0] - change, products.grad[1]))
        hessian = with_curvature(products, before, jnp.asarray(step)).hessian.dense
        np.testing.assert_allclose(hessian @ step, change, rtol=1e-9)
        assert np.linalg.eigvalsh(hessian).min() > 0
        # A step that lowers the squared error much does not change the Hessian.
        far = dataclasses.replace(before, f=2 * products.f)
        hessian = with_curvature(products, far, jnp.asarray(step)).hessian.dense
        np.testing.assert_array_equal(hessian, products.hessian.dense)
    before = dataclasses.replace(products, grad=(products.grad[0] + gram @ step, products.grad[1]))
    hessian = with_curvature(products, before, jnp.asarray(step)).hessian.dense
    assert step @ hessian @ step == pytest.approx(0.2 * step @ gram @ step)
    assert np.linalg.eigvalsh(hessian).min() > 0
    same = with_curvature(products, before, jnp.zeros(4)).hessian.dense
    np.testing.assert_array_equal(same, products.hessian.dense)


@pytest.mark.parametrize("seed", range(4))
def test_bounds_end_where_scipys_do(seed):
    rng = np.random.default_rng(seed)
    a, target = rng.standard_normal((30, 4)), rng.standard_normal(30)
    low, high = np.array([-0.05, -np.inf, 0.0, -0.1]), np.array([0.05, 0.1, np.inf, 0.1])

    def plain(theta):
        z = a @ theta
        return z + 0.1 * z**2 - target

    solver = own_solver(low, high)
    begin = jnp.zeros(4), nothing()
    ours = optx.least_squares(
        lambda y, _: (lambda z: z + 0.1 * z**2 - target)(a @ y[0]), solver, begin, max_steps=200
    )
    scipys = optimize.least_squares(plain, np.clip(1e-3, low, high), bounds=(low, high), xtol=1e-12)
    assert np.all((ours.value[0] >= low) & (ours.value[0] <= high))
    assert np.sum(plain(np.asarray(ours.value[0])) ** 2) <= 2 * scipys.cost * (1 + 1e-9)


def test_initial_states_by_recording_are_found_with_the_parameters():
    """Exponentials of one rate, each with its own height: the dense problem by SciPy."""
    rng, t = np.random.default_rng(3), np.linspace(0, 1, 40)
    heights = np.array([1.0, -2.0, 0.5])
    data = heights[:, None] * np.exp(-1.7 * t) + 0.01 * rng.standard_normal((3, 40))

    def residual(y, args):
        (rate,), start = y
        return start * jnp.exp(-rate * t) - data

    def flat(z):
        return (z[1:, None] * np.exp(-z[0] * t) - data).ravel()

    begin = jnp.array([1.0]), jnp.ones((3, 1))
    ours = optx.least_squares(residual, own_solver([0.0], [np.inf]), begin, max_steps=100)
    scipys = optimize.least_squares(flat, np.ones(4), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found = np.concatenate([ours.value[0], ours.value[1].ravel()])
    np.testing.assert_allclose(found, scipys.x, rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_small_jumps_of_the_loss_are_no_failure(seed):
    """A rounded model, as of a law on an encoder: steps are refused near the minimum."""
    rng = np.random.default_rng(seed)
    a, true = rng.standard_normal((300, 3)), np.array([0.4, -1.0, 2.0])
    data = 0.05 * np.round(a @ true / 0.05) + 0.2 * rng.standard_normal(300)

    def rounded(y, args, slope=1.0):
        z = a @ y[0]
        jump = 0.05 * jnp.round(z / 0.05) - slope * z
        return slope * z + jax.lax.stop_gradient(jump) - data

    begin, solver = (jnp.zeros(3), nothing()), own_solver([-np.inf] * 3, [np.inf] * 3)
    found = optx.least_squares(rounded, solver, begin, max_steps=300, throw=False)
    assert found.result == optx.RESULTS.successful
    best, *_ = np.linalg.lstsq(a, data, rcond=None)
    deviation = 0.2 * np.sqrt(np.diag(np.linalg.inv(a.T @ a)))
    assert np.all(np.abs(found.value[0] - best) < deviation)
    # A derivative of the wrong sign is one: no step lowers the loss, far from the minimum.
    wrong = optx.least_squares(
        lambda y, args: rounded(y, args, slope=-1.0), solver, begin, max_steps=300, throw=False
    )
    assert wrong.result == optx.RESULTS.nonlinear_divergence


# --- on a robot ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recordings():
    """Two short recordings of unequal length by the independent simulator, with noise."""
    rng, made = np.random.default_rng(5), []
    for k, seconds in enumerate((3.0, 2.0)):
        reference = sim.draw_multisine(rng, seconds)
        run = sim.simulate(sim.Scara(), reference, sim.PD(), (), seconds, 0.01)
        tau = run.tau + 0.005 * rng.standard_normal(run.tau.shape)
        made.append(
            jaxid.Recording.from_arrays(run.time, run.q, tau, q_ref=run.q_ref, name=f"r{k}")
        )
    return jaxid.Recordings.of(made)


@pytest.fixture(scope="module")
def ours(recordings):
    """A fit by jaxid's own solver."""
    return jaxid.fit(jaxid.scara(), recordings, jaxid.OEM(tolerance=1e-4, progress=False))


@pytest.mark.parametrize(
    ("solver", "off"),
    [
        # A hundredth of a deviation lowers the squared error by 1e-4 of a residual's variance.
        (optx.LevenbergMarquardt(1e-4, 1e-4), 0.01),
        (optx.Dogleg(1e-4, 1e-4), 0.01),
        (optx.GaussNewton(1e-4, 1e-4), 0.01),
        # Without J'J the scale of each parameter is learnt step by step.
        (optx.BFGS(1e-6, 1e-6), 0.5),
    ],
    ids=lambda s: type(s).__name__,
)
def test_every_solver_of_optimistix_finds_the_same_minimum(solver, off, recordings, ours):
    # Undamped Gauss-Newton steps need a start close by.
    method = jaxid.OEM(solver=solver, progress=False, max_steps=400, start="given")
    begin = ours.loop.with_theta(1.05 * ours.loop.theta)
    fit = jaxid.fit(begin, recordings, method)
    assert fit.succeeded or off > 0.1
    assert np.all(np.abs(fit.theta - ours.theta) < off * ours.std)
    np.testing.assert_allclose(fit.std, ours.std, rtol=0.02)


def test_what_is_no_solver_is_refused(recordings):
    with pytest.raises(FitError, match="is not a solver: give an optimistix solver"):
        jaxid.fit(jaxid.scara(), recordings, jaxid.OEM(solver="BFGS"))
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("recordings",))
    method = jaxid.OEM(solver=optx.BFGS(1e-6, 1e-6), mesh=mesh)
    with pytest.raises(FitError, match="BFGS cannot share recordings over the devices of a mesh"):
        jaxid.fit(jaxid.scara(), recordings, method)


def test_a_solver_that_runs_out_of_steps_says_so(recordings):
    method = jaxid.OEM(solver=optx.GradientDescent(1e-9, 1e-9, 1e-9), max_steps=3, progress=False)
    fit = jaxid.fit(jaxid.scara(), recordings, method)
    assert fit.status is jaxid.Status.max_steps


def test_a_deadline_holds_for_every_solver(recordings, monkeypatch):
    # An hour passes with every look at the clock.
    hours = iter(range(0, 10**9, 3600))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(hours)))
    for solver in (None, optx.LevenbergMarquardt(1e-9, 1e-9)):
        method = jaxid.OEM(solver=solver, max_seconds=1.0, progress=False, start="given")
        fit = jaxid.fit(jaxid.scara(), recordings, method)
        assert fit.status is jaxid.Status.max_seconds


def test_the_stop_rule_counts_samples_and_no_padding(ours, recordings):
    assert ours.optimum.problem.rows == 2 * sum(r.samples for r in recordings)
    assert ours.optimum.problem.batch.mask.size > sum(r.samples for r in recordings)


def test_derivatives_that_were_dropped_are_the_same_again(ours, monkeypatch):
    problem, theta, start = ours.optimum.problem, ours.optimum.theta, ours.optimum.start
    monkeypatch.setattr(room.linearising, "_KEPT", 0)
    monkeypatch.setattr(room.linearising, "_WORTH_SHARING", 0)
    monkeypatch.setattr(room.linearising, "cores", lambda: 2)
    point = room.linearisation(problem)(theta, start)
    assert point.found.jacobian is None
    whole, again = linearise(problem, theta, start), with_derivatives(problem, point)
    assert eqx.tree_equal(whole, again)
    expected = np.einsum("rkop,rkoq->opq", whole.jacobian, whole.jacobian)
    np.testing.assert_allclose(point.sums.gram, expected, rtol=1e-10)


@pytest.mark.parametrize("law", ["continuous", "sampled"])
@pytest.mark.parametrize("free", [False, True], ids=["given start", "free start"])
def test_stretches_of_time_give_the_linearisation_of_the_whole(law, free, recordings, ours):
    """Long recordings are linearised piece by piece, with noise filters that look back."""
    loop = ours.loop
    if law == "sampled":
        # Ticks fall between the samples.
        loop = dataclasses.replace(loop, controller=Sampled(loop.controller, every=0.004))
    batch = prepare(loop, recordings)
    noise = jnp.zeros((2, 8)).at[:, 0].set(1.0).at[:, 3].set(-0.5)
    bounds = Bounds.of(loop.free_parameters)
    problem = Problem(
        loop,
        batch,
        jnp.array([3.0, 7.0]),
        noise,
        free * jnp.ones(2),
        bounds.lower,
        bounds.upper,
        ("tau",),
        free,
    )
    theta, start = loop.theta, jnp.concatenate([batch.q0, batch.v0], axis=1)
    for k in range(2):
        alone = room.linearising._share(problem, np.array([k]))
        cut = room.stretches.Stretches.of(alone, 70, True)(theta, start[k : k + 1])
        whole = room.point_around(alone, theta, start[k : k + 1])
        for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(cut), strict=True):
            scale = np.max(np.abs(a), initial=1e-300)
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * scale)
