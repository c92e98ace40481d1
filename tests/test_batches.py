"""Derivatives of arms with many joints, computed for many intervals at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops import four_joints

import jaxid
from jaxid.arms import AbstractArm
from jaxid.discovery.linear import base_columns, linearise
from jaxid.simulation.batch import prepare
from jaxid.simulation.dynamics import forward
from jaxid.simulation.integration import initial
from jaxid.simulation.runs import run, run_with_sensitivities
from jaxid.simulation.steps import with_batches, with_substeps

pinocchio = pytest.importorskip("pinocchio")

GAINS = np.array([60.0, 50.0, 30.0, 10.0])


def moving(samples: int) -> jaxid.Recording:
    """A recording with a reference; only its motion is used."""
    time = 0.004 * np.arange(samples)
    q = 0.3 * np.sin(np.outer(time, [5.0, 7.0, 9.0, 11.0]) + np.array([0.1, 0.4, 0.9, 1.5]))
    return jaxid.Recording.from_arrays(time, q, q, q_ref=q, name="sines")


def drive() -> jaxid.ClosedLoop:
    """A sampled law with a delay; links held."""
    pid = jaxid.control.PID(Kp=30 * GAINS, Ki=40 * GAINS, Kd=2 * GAINS)
    law = jaxid.control.Sampled(pid, every=1e-3, velocity="difference", cutoff=100.0, delay=1)
    return jaxid.serial(four_joints(), law)


def soft() -> jaxid.ClosedLoop:
    """A continuous law and a soft joint; links estimated."""
    pid = jaxid.control.PID(Kp=30 * GAINS, Ki=40 * GAINS, Kd=2 * GAINS)
    gear = jaxid.effects.JointElasticity(2, compliance=1e-2, damping=1.0, rotor=0.5)
    return jaxid.serial(four_joints(), pid, bodies="free").with_effects([gear])


class Prepared:
    """A loop with its intervals and start; the last block of intervals is not full."""

    def __init__(self, loop):
        recording = jaxid.Recordings.of(moving(41))
        self.loop = with_substeps(loop, recording)
        self.batch = prepare(self.loop, recording)
        self.intervals = jax.tree.map(lambda leaf: leaf[0, :37], self.batch.intervals)
        self.x0 = initial(self.loop, self.intervals, self.batch.q0[0], self.batch.v0[0])

    def differences(self, d_theta, d_x):
        """Torque, position and last state; and their derivatives along a direction, from central
        differences of two sizes."""

        @jax.jit
        def whole(theta, x):
            loop = self.loop.with_theta(theta)
            states, seen, _ = run(loop, self.intervals, x, rows=(0, 1))
            return seen, states[-1]

        theta, x0, found = self.loop.theta, self.x0, []
        for h in (2e-4, 1e-4):
            after, before = (whole(theta + s * d_theta, x0 + s * d_x) for s in (h, -h))
            found.append([(a - b) / (2 * h) for a, b in zip(after, before, strict=True)])
        slopes = [(4 * fine - coarse) / 3 for coarse, fine in zip(*found, strict=True)]
        return whole(theta, x0), slopes


def agree(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("make", [drive, soft])
def test_derivatives_of_many_joints_are_those_of_the_run(make):
    case = Prepared(make())
    loop, x0 = case.loop, case.x0
    assert with_batches(loop).stepping.batched
    p, m = len(loop.theta), len(x0)
    rng = np.random.default_rng(0)
    start = jnp.asarray(np.hstack([np.zeros((m, p)), rng.normal(size=(m, 2))]))
    found = jax.jit(
        lambda x, start: run_with_sensitivities(loop, case.intervals, x, start, (0, 1))
    )(x0, start)
    weights = jnp.asarray(rng.normal(size=p + 2)) / 10
    (seen, end), slopes = case.differences(weights[:p], start[:, p:] @ weights[p:])
    np.testing.assert_allclose(found.seen, seen, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.end, end, rtol=1e-9, atol=1e-9)
    agree(found.slopes @ weights, slopes[0])
    agree(found.end_slopes @ weights, slopes[1])


@pytest.mark.slow
def test_the_linear_system_of_many_joints_is_that_of_the_run():
    case = Prepared(drive())
    p = len(case.loop.theta)
    linear = linearise(case.loop, case.batch, "tau")
    columns = base_columns(linear, p, False)[0]
    weights = jnp.asarray(np.random.default_rng(0).normal(size=p)) / 10
    _, (slopes, _) = case.differences(weights, jnp.zeros(len(case.x0)))
    agree(columns[:37] @ weights, slopes[:, 0])


def test_accelerations_have_the_derivatives_of_pinocchio():
    text = four_joints()
    loop = with_batches(with_substeps(drive(), jaxid.Recordings.of(moving(23))))
    model = pinocchio.buildModelFromXML(text)
    data = model.createData()
    none = jnp.zeros((4, 4))
    slopes = jax.jit(
        jax.jacfwd(lambda q, v, tau: forward(loop, q, v, tau, none), argnums=(0, 1, 2))
    )
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, v, tau = rng.normal(size=(3, 4))
        by_q, by_v, by_tau = slopes(q, v, tau)
        pinocchio.computeABADerivatives(model, data, q, v, tau)
        inverse = np.triu(data.Minv) + np.triu(data.Minv, 1).T
        for ours, theirs in ((by_q, data.ddq_dq), (by_v, data.ddq_dv), (by_tau, inverse)):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_derivatives_of_inverse_dynamics_are_those_of_autodiff():
    arm = drive().arm
    q, v, a = map(jnp.asarray, np.random.default_rng(2).normal(size=(3, 4)))
    expected = AbstractArm.inverse_slopes(arm, q, v, a)
    for ours, theirs in zip(arm.inverse_slopes(q, v, a), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12 * np.abs(theirs).max())


def test_few_joints_are_unrolled():
    loop = with_substeps(jaxid.two_link(), jaxid.Recordings.of(two_joints()))
    assert not with_batches(loop).stepping.batched


def two_joints() -> jaxid.Recording:
    full = moving(23)
    return jaxid.Recording.from_arrays(
        full.time, full.q[:, :2], full.tau[:, :2], q_ref=full.q[:, :2], name="two"
    )
