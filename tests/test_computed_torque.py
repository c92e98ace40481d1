"""Computed torque against the independent simulator, and the certificate of its stability."""

import sys

import independent as sim
import numpy as np
import pytest

import jaxid
from jaxid.control import ComputedTorque, certify, holds, mass_error
from jaxid.control.certificate import error_dynamics
from jaxid.errors import MissingExtraError, ModelError

TRUE = sim.TwoLink(gamma=20.0)
TRUTH = {name: getattr(TRUE, name) for name in TRUE.base}
MODEL = sim.TwoLink(p1=0.09, p2=0.04, p3=0.03, p4=0.3, p5=0.1)
ARM = jaxid.arms.TwoLink(**{n: getattr(MODEL, n) for n in ("p1", "p2", "p3", "p4", "p5")})
GAINS = {"Kp": (192.0, 150.0), "Ki": (512.0, 300.0), "Kd": (24.0, 20.0)}
TICK = 0.005


def reference(t):
    """Position, velocity and acceleration, (3, samples, 2)."""
    w = np.array([1.7, 2.3])
    x = np.outer(t, w)
    return np.stack([0.5 - 0.5 * np.cos(x), 0.5 * w * np.sin(x), 0.5 * w**2 * np.cos(x)])


def test_sampled_law_is_that_of_the_independent_simulator():
    t = TICK * np.arange(401)
    law = sim.SampledComputedTorque(MODEL, **GAINS, period=TICK, window=3)
    expected = sim.simulate_batch([TRUE], reference(t), law, np.zeros(1), substeps=20)
    own = ComputedTorque(ARM, **GAINS, every=TICK, window=3)
    loop = jaxid.two_link(own).with_values(**TRUTH, eps1=0.05, eps2=0.05)
    asked = jaxid.Recording.from_arrays(t, expected.q[0], expected.tau[0], q_ref=reference(t)[0])
    run = jaxid.simulate(loop, asked)[0]
    assert np.abs(run.q - expected.q[0]).max() < 1e-5
    # A spline's acceleration is (w T)² off, and a third of it at its ends.
    settled = slice(5, -5)
    off = np.abs(run.tau - expected.tau[0])[settled].max()
    assert off < 1e-3 * np.abs(expected.tau[0]).max()


def test_batch_simulator_agrees_with_the_continuous_one():
    # A law that only holds a pose, over ticks so short that holding hardly matters.
    t = 0.0005 * np.arange(801)
    still = np.zeros((3, len(t), 2))
    still[0] = 0.4
    law = sim.SampledComputedTorque(
        sim.TwoLink(p1=0.1, p2=0.1, p3=0.0, p4=0.0, p5=0.0),
        (60.0, 60.0),
        (0.0, 0.0),
        (10.0, 10.0),
        period=0.0005,
        window=1,
    )
    found = sim.simulate_batch([TRUE], still, law, np.zeros(1), q0=np.zeros((1, 2)))

    class Still:
        def position(self, t):
            return [0.4, 0.4]

    # M̂ = [[0.2, 0.1], [0.1, 0.1]] is not a diagonal law, so its torque is prescribed.
    class Law:
        period = None

        def torque(self, ref, q, v, t):
            u = [60 * (r - x) - 10 * w for r, x, w in zip(ref, q, v, strict=True)]
            return [0.2 * u[0] + 0.1 * u[1], 0.1 * u[0] + 0.1 * u[1]]

    expected = sim.simulate(TRUE, Still(), Law(), (), 0.4, 0.0005, rtol=1e-8, atol=1e-10)
    # Holding and differencing delay by half a tick each; the motion lasts some 100 ms.
    assert np.abs(found.q_true[0] - expected.q_link).max() < 0.01 * 0.4


def test_the_model_of_the_law_is_not_estimated():
    loop = jaxid.two_link(ComputedTorque(ARM, **GAINS))
    assert [p.name for p in loop.parameters].count("p1") == 1
    moved = loop.with_theta(2 * loop.theta)
    assert float(moved.arm.p1) != float(loop.arm.p1)
    assert float(moved.controller.model.p1) == float(loop.controller.model.p1)


# --- the certificate ------------------------------------------------------------------------------

cvxpy = pytest.importorskip("cvxpy", reason="needs the extra sdp")


@pytest.fixture(scope="module")
def bound():
    return mass_error(ARM, ARM.workspace(), 0.1, draws=500)


def errors_inside(bound, count, seed):
    """Matrices M~ with M~ M~' below mu, on its edge."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(count, 2, 2)))
    return np.linalg.cholesky(bound.mu) @ turn


def test_bound_holds_for_arms_it_has_not_seen(bound):
    rng = np.random.default_rng(9)
    for _ in range(300):
        p = {n: getattr(MODEL, n) * rng.uniform(0.9, 1.1) for n in ("p1", "p2", "p3")}
        q = [0.0, rng.uniform(-np.pi, np.pi)]
        true, taken = (np.array(x.inertia(q)) for x in (sim.TwoLink(**p), MODEL))
        error = np.linalg.solve(true, true - taken)
        assert np.linalg.eigvalsh(bound.mu - error @ error.T).min() > 0


def test_certified_gains_are_stable_for_every_error_inside(bound):
    law = ComputedTorque(ARM, Kp=[300.0, 300.0], Ki=[1000.0, 1000.0], Kd=[40.0, 40.0])
    found = certify(law, bound)
    assert found.certified
    assert holds(found, law)
    A, B, K = error_dynamics(law)
    for error in errors_inside(bound, 200, 1):
        true = A + B @ error @ K
        assert np.linalg.eigvals(true).real.max() < 0
        falls = true.T @ found.P + found.P @ true
        scale = np.sqrt(np.diag(found.P))
        assert np.linalg.eigvalsh(falls / np.outer(scale, scale)).max() < 0
    # Another law's certificate proves nothing.
    assert not holds(found, ComputedTorque(ARM, Kp=[9.0, 9.0], Ki=[9.0, 9.0], Kd=[2.0, 2.0]))


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        ({"Kp": [100.0] * 2, "Ki": [100.0] * 2, "Kd": [3.0] * 2}, "no quadratic function"),
        ({"Kp": [100.0] * 2, "Ki": [0.0] * 2, "Kd": [1.0] * 2}, "no quadratic function"),
        ({"Kp": [10.0] * 2, "Ki": [100.0] * 2, "Kd": [1.0] * 2}, "unstable even on the exact"),
    ],
)
def test_gains_that_are_too_low_are_not_certified(gains, said, bound):
    law = ComputedTorque(ARM, **gains)
    found = certify(law, bound)
    assert not found.certified
    assert said in repr(found)
    assert not holds(found, law)


def test_what_the_bound_cannot_be_for_is_said(bound):
    with pytest.raises(ModelError, match="no parameter 'p9'"):
        mass_error(ARM, ARM.workspace(), {"p9": (0.0, 1.0)})
    with pytest.raises(ModelError, match="not positive definite"):
        mass_error(ARM, ARM.workspace(), 0.6)
    with pytest.raises(ModelError, match="give a share"):
        mass_error(ARM, ARM.workspace(), 20.0)
    with pytest.raises(ModelError, match="for 2 joints, but the gains are for 1"):
        certify(ComputedTorque(ARM, Kp=[9.0], Ki=[1.0], Kd=[6.0]), bound)


def test_the_extra_is_named_where_it_is_missing(bound, monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(MissingExtraError, match=r"jaxid-robotics\[sdp\]"):
        certify(ComputedTorque(ARM, **GAINS), bound)
