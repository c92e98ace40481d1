"""Sets of effects in the linear system against full refits of recordings from another simulator."""

import dataclasses

import independent as sim
import numpy as np
import pytest
import scipy
from independent import effects as fx
from stories import recordings_of, silent

import jaxid
from jaxid.discovery.bounded import bounded_amplitudes
from jaxid.discovery.hypotheses import amplitudes
from jaxid.discovery.landscape import Landscape
from jaxid.discovery.predict import Predictor
from jaxid.discovery.ranking import judge
from jaxid.discovery.screening import screen
from jaxid.effects import QuadraticDrag, Spring, Stribeck, TorqueOffset, TorqueRipple

HIDDEN = (fx.Stribeck(joint=2, torque=0.015, velocity=0.3), fx.Spring(1, 0.04, 0.1))


@pytest.fixture(scope="module")
def found():
    """A fit that lacks two effects, what was screened of it, and its diagnosis."""
    case = sim.make_case(77, effects=list(HIDDEN), noise="white", duration=10.0)
    recordings, _ = recordings_of(case)
    fit = jaxid.fit(jaxid.scara(), recordings, jaxid.OEM(progress=False))
    screened = screen(fit, jaxid.catalogue, silent)
    return fit, screened, judge(fit, screened, 0.01, lambda _: None)


@pytest.fixture(scope="module")
def predictor(found):
    _, screened, diagnosis = found
    return Predictor.of(screened.system, diagnosis.noise, diagnosis.data.level)


def refitted(found, effects):
    """The whitened squared error of a full refit with some effects, and the fit."""
    fit, screened, diagnosis = found
    plain = jaxid.OEM(start="given", progress=False)
    method = jaxid.SeparablePEM(plain, filters=diagnosis.noise)
    after = jaxid.fit(fit.loop.add(*effects), fit.recordings, method)
    assert after.succeeded
    mask = screened.system.mask
    rows = np.zeros((*mask.shape, 2))
    for k, residual in enumerate(after.residuals):
        rows[k, : len(residual)] = residual
    return float(np.sum(diagnosis.data.white(rows, diagnosis.noise) ** 2)), after


@pytest.mark.parametrize(
    "effects",
    [
        (Stribeck(2, 0.02, 0.5),),
        (Spring(1, 0.1),),
        (TorqueRipple(2, harmonic=2.9),),
        (Stribeck(2, 0.02, 0.5), Spring(1, 0.1)),
        (Stribeck(2, 0.02, 0.5), Spring(1, 0.1), TorqueOffset(2, 0.0)),
    ],
    ids=lambda effects: "+".join(e.effect_name() for e in effects),
)
def test_prediction_is_the_refit(found, predictor, effects):
    """Also of effects that are not there: what they take is what a refit gives them."""
    before = predictor.predict(()).loss
    predicted = predictor.predict(effects)
    loss, after = refitted(found, predicted.effects)
    assert predicted.loss < before
    assert abs(predicted.loss - loss) < 0.02 * (before - loss) + 10
    if len(effects) == 2:
        for k, effect in enumerate(after.loop.effects[-2:]):
            for p in amplitudes(effect):
                there = float(np.ravel(p.where(effect))[0])
                guess = float(np.ravel(p.where(predicted.effects[k]))[0])
                assert abs(guess - there) < 0.05 * abs(there)


def test_finite_effects_are_simulated(found, predictor):
    soft = jaxid.effects.JointElasticity(joint=2, compliance=2e-3, rotor=0.02)
    shown = predictor.shown(soft)
    fit, _, _ = found
    moved = [r.tau for r in jaxid.simulate(fit.loop.add(soft), fit.recordings)]
    plain = [r.tau for r in jaxid.simulate(fit.loop, fit.recordings)]
    for k, (one, other) in enumerate(zip(moved, plain, strict=True)):
        change = np.asarray(one) - np.asarray(other)
        size = np.abs(change).max()
        np.testing.assert_allclose(shown[k, : len(change), :, 0], change, atol=1e-6 * size)
    # The derivative by compliance, from a difference of our own.
    by = 1e-3 * 2e-3
    further = dataclasses.replace(soft, compliance=2e-3 + by)
    again = [r.tau for r in jaxid.simulate(fit.loop.add(further), fit.recordings)]
    slope = (np.asarray(again[0]) - np.asarray(moved[0])) / by
    error = np.linalg.norm(shown[0, : len(slope), :, 1] - slope) / np.linalg.norm(slope)
    assert error < 0.02


def test_an_amplitude_at_its_bound_is_not_possible(predictor):
    drag = predictor.predict([QuadraticDrag(joint=1, coefficient=0.0)])
    low = float(drag.effects[0].coefficient) <= 0
    assert drag.possible is not low


def test_entries_beside_a_set_are_those_that_it_lacks(found, predictor):
    _, screened, diagnosis = found
    landscape = Landscape.of(screened, diagnosis)
    alone = [e.effect.effect_name() for e in landscape.beside(None)[:4]]
    assert {"stribeck", "spring"} & set(alone)
    spring = predictor.predict([Spring(1, 0.1)])
    assert landscape.beside(spring)[0].effect.effect_name() == "stribeck"
    both = predictor.predict([Spring(1, 0.1), Stribeck(2, 0.02, 0.5)])
    assert landscape.beside(both)[0].evidence < 10
    pairs = landscape.pairs(None, landscape.beside(None)[:8])
    names = {e.effect.effect_name() for e in pairs[0]}
    assert names == {"stribeck", "spring"}


def test_amplitudes_within_bounds_are_those_of_scipy():
    rng = np.random.default_rng(8)
    columns, left = rng.standard_normal((2, 40, 3))[0], rng.standard_normal(40)
    columns[:, 2] -= left
    gram, score_ = columns.T @ columns, columns.T @ left
    limits, size = ((0.0,) * 3, (np.inf,) * 3), np.array([2.0, 1.0, 0.5])
    found, explained = bounded_amplitudes(gram, score_, size, limits)
    expected, rest = scipy.optimize.nnls(columns, left)
    assert 0.0 in expected
    np.testing.assert_allclose(found * size, expected, atol=1e-8)
    assert explained == pytest.approx(left @ left - rest**2)
    assert bounded_amplitudes(gram, np.full(3, -1.0), size, limits)[1] == 0.0
