"""Noise of recorded positions: its level, its way into a batch, and p-values that allow for it.

Torque is that of inverse dynamics written out here, along motions in closed form.
"""

import dataclasses

import independent as sim
import numpy as np
import pytest
from loops import sines

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.data import Data
from jaxid.discovery.motion_noise import Changes, _products
from jaxid.discovery.score import Whitened
from jaxid.discovery.table import SignatureTable
from jaxid.effects import Coulomb, JointElasticity, Stribeck, TimeDelay, Viscous
from jaxid.estimate.covariance import covariance_of
from jaxid.estimate.minimise import Prior
from jaxid.noise import ARFilter
from jaxid.signals import encoder
from jaxid.signals.encoder import position_noise
from jaxid.simulation.batch import prepare
from jaxid.simulation.perturbed import with_errors

MASS, DRAG, DRY = 5.0, 4.0, 3.0
RATE, DEVIATION = 200.0, 2e-5


def recorded(rng, deviation=DEVIATION, step=0.0, samples=2400):
    """An axis whose encoder has white noise, or steps."""
    time = np.arange(samples) / RATE
    frequencies = (0.2, 0.5, 1.3)
    q, v, a = sines(time, (0.2, 0.08, 0.02), frequencies, rng.uniform(0, 6, 3))
    tau = MASS * a + DRAG * v + DRY * 2 / np.pi * np.arctan(v / 0.01)
    tau = tau + 0.1 * rng.standard_normal(samples)
    q = q + deviation * rng.standard_normal(samples)
    q = step * np.round(q / step) if step else q
    return jaxid.Recording.from_arrays(time, q, tau, name=f"run_{rng.integers(10**9)}")


def axis(cutoff=None):
    effects = Viscous(1, 1.0), Coulomb(1, 1.0, smoothing=0.01)
    return jaxid.ClosedLoop(jaxid.arms.Axis(M=MASS), Tracking(cutoff=cutoff), effects, name="axis")


@pytest.mark.parametrize(("deviation", "step"), [(2e-5, 0.0), (2e-4, 0.0), (0.0, 1e-4)])
def test_the_noise_of_an_encoder_is_measured_where_there_is_no_motion(deviation, step):
    found = position_noise(recorded(np.random.default_rng(1), deviation, step))
    # Steps of an encoder are uniform errors.
    expected = deviation or step / np.sqrt(12)
    np.testing.assert_allclose(found, expected, rtol=0.12)
    short = recorded(np.random.default_rng(1), samples=40)
    np.testing.assert_array_equal(position_noise(short), 0.0)


def test_errors_enter_a_batch_like_those_of_a_recording():
    rng, loop = np.random.default_rng(2), axis(cutoff=RATE / 4)
    records = [recorded(rng, samples=n) for n in (900, 1200)]
    errors = [1e-3 * rng.standard_normal(r.q.shape) for r in records]
    other = [
        jaxid.Recording.from_arrays(r.time, r.q + e, r.tau, name=r.name)
        for r, e in zip(records, errors, strict=True)
    ]
    found, expected = (
        with_errors(loop, records, prepare(loop, records), errors),
        prepare(loop, other),
    )
    # The measured position is not compared.
    for name in ("q0", "v0", "tau"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    reference = np.asarray(expected.intervals.reference)
    np.testing.assert_allclose(
        found.intervals.reference, reference, atol=1e-8 * abs(reference).max()
    )


CATALOGUE = (JointElasticity, TimeDelay, Stribeck)


def least(seed):
    """The smallest p-value of a clean axis."""
    rng = np.random.default_rng([3, seed])
    runs = [recorded(rng), recorded(rng)]
    fit = jaxid.fit(axis(cutoff=10.0), runs, jaxid.OEM(progress=False))
    found = jaxid.diagnose(fit, catalogue=CATALOGUE, progress=False)
    return min((*found.ranking, *found.where), key=lambda v: v.p_value)


def test_p_values_of_clean_recordings_allow_for_the_noise_of_the_motion(monkeypatch):
    # Six uniform numbers are all above this with a probability of 0.99.
    assert min(least(seed).p_value for seed in range(6)) > 0.0017
    with monkeypatch.context() as patch:
        patch.setattr(encoder, "position_noise", lambda r: np.zeros(1))
        without = least(0)
    assert without.p_value < 1e-6
    assert without.hypothesis.name in ("joint_elasticity", "time_delay")


@pytest.mark.slow
def test_noise_of_the_torque_is_not_separated_from_what_explains_noise_of_the_motion():
    """An elastic joint did, which made all other effects significant: 9e-16 for a curve."""
    p_values = pytest.importorskip("benchmarks.p_values", reason="a checkout alone has benchmarks")
    robot = p_values.Robot(seed=272699719, colour="strong", draws=8, law="unknown")
    case = sim.make_case(robot.seed, (), robot.colour)
    pair = p_values.pairs(case, robot)[-1]
    fit = jaxid.fit(jaxid.scara(Tracking()), pair, jaxid.OEM(progress=False))
    found = jaxid.diagnose(fit, progress=False)
    assert min(v.p_value for v in (*found.ranking, *found.where)) > 0.05


def test_an_elastic_joint_is_still_found():
    rng = np.random.default_rng(4)
    runs = [recorded(rng) for _ in range(2)]
    late = [
        jaxid.Recording.from_arrays(
            r.time, r.q, r.tau + 0.02 * np.gradient(r.tau, 1 / RATE, axis=0), name=r.name
        )
        for r in runs
    ]
    fit = jaxid.fit(axis(cutoff=10.0).hold("delay"), late, jaxid.OEM(progress=False))
    found = jaxid.diagnose(fit, catalogue=CATALOGUE, progress=False)
    assert found.ranking[0].p_value < 1e-6


@pytest.mark.parametrize("kind", ["sandwich", "newey_west"])
def test_deviations_contain_the_error_that_the_noise_of_the_motion_causes(kind):
    """It makes the mass too small, by several deviations of the torque's noise."""
    off, predicted, covered = [], [], []
    for seed in range(8):
        rng = np.random.default_rng([6, seed])
        runs = [recorded(rng, 2e-4) for _ in range(2)]
        fit = jaxid.fit(axis(cutoff=10.0), runs, jaxid.OEM(deviations=kind, progress=False))
        plain = dataclasses.replace(fit.optimum, by_motion=None)
        k = fit.names.index("M")
        without = covariance_of(plain, kind)[0][k, k]
        off.append(fit.theta[k] - MASS)
        predicted.append(-np.sqrt(fit.covariance[k, k] - without))
        covered.append(abs(off[-1]) < 2 * fit.std[k])
        assert jaxid.with_deviations(fit, kind).std == pytest.approx(fit.std)
    assert np.mean(off) == pytest.approx(np.mean(predicted), rel=0.25)
    assert np.mean(off) < -2 * np.sqrt(without)
    assert sum(covered) >= 7


@pytest.mark.parametrize("known", [False, True])
def test_products_of_changes_are_those_of_dense_matrices(known):
    """The base absorbs a part of a signature, and it changes too."""
    rng, shape = np.random.default_rng(5), (2, 60, 2)
    base, table = rng.standard_normal((*shape, 3)), rng.standard_normal((*shape, 4))
    table[:, :, 0, 1] = table[:, :, 1, 2] = 0.0
    prior = Prior(np.eye(3)[:1], np.array([0.3, 0.0, 0.0])) if known else None
    mask = np.ones(shape[:2], bool)
    data = Data(rng.standard_normal(shape), base, SignatureTable.of(table), mask, known=prior)
    noise = (ARFilter(np.array([-0.5]), 0.3), ARFilter(np.array([0.2]), 0.7))
    white, columns, draws = Whitened.of(data, noise), [3, 1, 2], 2
    moved = table[..., columns] + 0.1 * rng.standard_normal((draws, *shape, 3))
    by_base = 0.1 * rng.standard_normal((draws, *shape, 3))
    residual = rng.standard_normal((draws, *shape))
    tables = tuple(SignatureTable.of(x) for x in moved)
    changed = Changes(residual, by_base, tables, tuple(columns))
    found = _products(changed, data, noise, white)

    z, x = (data.white_columns(c, noise, k) for c, k in ((base, slice(None)), (table, None)))
    taken = np.linalg.lstsq(z, x[:, columns])[0]
    away = np.eye(len(z)) - z @ np.linalg.pinv(z)

    def whole(rows):
        flat = data.white(rows, noise).reshape(np.prod(shape), -1)
        return np.pad(flat, ((0, len(z) - len(flat)), (0, 0)))

    for one in range(draws):
        change = away @ whole(moved[one] - table[..., columns] - by_base[one] @ taken)
        for other in range(draws):
            expected = change.T @ (away @ whole(residual[other]))[:, 0]
            np.testing.assert_allclose(found[one, other], expected, rtol=1e-9, atol=1e-9)
