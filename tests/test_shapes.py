"""Shapes of added effects that are estimated when a search has ended, and their deviations."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from stories import silent
from test_release import DRY, axis, recorded

import jaxid
from jaxid.discovery.asked import Asked
from jaxid.discovery.fits import Fits
from jaxid.discovery.last_tries import replaced, replaced_by_shape
from jaxid.discovery.models import Model
from jaxid.discovery.search import Search
from jaxid.discovery.shapes import (
    _between_bounds,
    _merged,
    _starts,
    has_held_shape,
    shapes_of,
    with_shapes,
)
from jaxid.discovery.verify import Refits
from jaxid.effects import Coulomb, QuadraticDrag, Stribeck
from jaxid.noise import ARFilter
from jaxid.parameters import Bounds
from jaxid.storage.campaign import Campaign

PEAK, SPEED, WIDTH = 1.8, 0.03, 0.004


def falling(v):
    """A sign of velocity with a peak that falls as an exponential of speed."""
    return np.tanh(v / WIDTH) * (1 + PEAK / DRY * np.exp(-np.abs(v / SPEED)))


def fitted(sign):
    """A fitted model of an axis with a peak whose exponent is held at 2, and what made its fit.

    `sign`: the true sign of velocity, with its peak.
    """
    width = WIDTH * np.arctanh(0.5)
    peak = Stribeck(1, 1.0, 0.03, smoothing=width, form=1.0)
    friction = Coulomb(1, 3.0, smoothing=width, form=1.0)
    loop = axis().without("coulomb").add(friction, peak)
    refits = Refits(jaxid.Recordings.of([recorded(k, sign) for k in (1, 2)]), jaxid.OEM())
    noise = (ARFilter(np.zeros(0), 1e-3),)
    fit = refits.filtered(loop, noise)
    return refits, Model((fit.loop.effects[-1],), 0.0, fit=fit, noise=noise)


@pytest.fixture(scope="module")
def ended():
    """A fitted model whose exponent is held at 2, where 1 is true."""
    return fitted(falling)


def test_an_exponent_is_estimated_at_the_end(ended):
    refits, model = ended
    held = model.fit.table().loc["Fs1"]
    assert abs(held["value"] - PEAK) > 10 * held["std"]
    table = with_shapes(Fits(refits, Campaign(None, {})), model).table()
    for name, true in (("Fs1", PEAK), ("vs1", SPEED), ("ds1", 1.0), ("Fc1", DRY)):
        assert abs(table.loc[name, "value"] - true) < 3 * table.loc[name, "std"]
    assert table.loc["Fs1", "std"] < 0.2 * PEAK


def bell(v):
    """A sign of velocity with a peak that falls as a Gaussian of speed, the default shape."""
    return np.tanh(v / WIDTH) * (1 + PEAK / DRY * np.exp(-((v / SPEED) ** 2)))


def test_a_shape_that_the_recordings_do_not_contradict_stays_and_makes_values_less_certain():
    """The values of the fit with a free shape would only follow the noise."""
    refits, model = fitted(bell)
    held, found = model.fit, with_shapes(Fits(refits, Campaign(None, {})), model)
    np.testing.assert_array_equal(found.theta, held.theta)
    assert "ds1" not in found.names
    assert np.all(found.std >= held.std * (1 - 1e-9))
    k = found.names.index("Fs1")
    assert found.std[k] > 1.5 * held.std[k]
    assert abs(found.theta[k] - PEAK) < 3 * found.std[k]
    assert any("do not contradict the default ds1 of 2" in note for note in found.notes)


def test_effects_without_a_held_shape_keep_their_fit(ended):
    refits, model = ended
    without = dataclasses.replace(model, effects=())
    assert with_shapes(Fits(refits, Campaign(None, {})), without) is model.fit
    fixed = dataclasses.replace(model.fit, loop=model.fit.loop.hold("ds1"))
    users = dataclasses.replace(model, fit=fixed)
    assert with_shapes(Fits(refits, Campaign(None, {})), users) is fixed


def test_each_shape_has_its_own_starts(ended):
    _, model = ended
    (exponent,) = shapes_of(model.fit.loop, 1)
    starts = _starts(model.fit.loop, [exponent])
    assert [float(exponent.where(x)) for x in starts] == [2.0, 1.0]
    # The form of the joint's sign is varied where it is estimated.
    starts = _starts(model.fit.loop.free("form1"), [exponent])
    assert len(starts) == 4
    # A start that two shapes share is tried once.
    assert len(_starts(model.fit.loop, [exponent, exponent])) == 2


def test_deviations_contain_the_distance_between_minima(ended):
    _, model = ended
    one = model.fit
    k = one.names.index("Fs1")
    away = one.theta.copy()
    away[k] += 8 * one.std[k]
    other = dataclasses.replace(one, loop=one.loop.with_theta(jnp.asarray(away)))
    # Their residuals are the same, so each has a weight of one half.
    found = _merged([one, other])
    expected = one.covariance.copy()
    expected[k, k] += 0.5 * (8 * one.std[k]) ** 2
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-12)
    assert any("2 sets of values" in note for note in found.notes)
    # A worse minimum, and the same one twice, change nothing.
    loud = tuple(3 * r for r in one.residuals)
    worse = dataclasses.replace(other, residuals=loud)
    found = _merged([worse, one, one])
    np.testing.assert_allclose(found.covariance, one.covariance, rtol=1e-12)
    np.testing.assert_array_equal(found.theta, one.theta)
    assert found.notes == one.notes


def searched(refits, peak):
    """A search that has fitted the axis without and with its peak, the bare loop, and the latter.

    `refits`, `peak`: as returned by `fitted`.
    """
    asked = Asked(refits.recordings, None, jaxid.OEM(), jaxid.catalogue, 0.01, 0.05, 6)
    search = Search(asked, Campaign(None, {}), silent)
    bare = dataclasses.replace(
        peak.fit.loop.with_effects(peak.fit.loop.effects[:-1]), held=peak.fit.loop.held
    )
    search.visit((), refits.filtered(bare, peak.noise))
    return search, bare, search.visit(search.added(peak.fit), peak.fit)


def test_an_effect_that_corrects_a_held_shape_is_compared_with_the_shape_free(ended):
    """Drag beside the peak, whose exponent is held at 2; without the drag the exponent is free."""
    refits, peak = ended
    search, _, held = searched(refits, peak)
    both = refits.filtered(peak.fit.loop.add(QuadraticDrag(1)), peak.noise)
    at = search.visit(search.added(both), both)
    assert at.score < held.score - 20
    found = replaced_by_shape(search, at)
    assert found is not None
    assert found.names == (("stribeck", 1),)
    assert "ds1" in found.fit.loop.names
    assert found.score < at.score - 20
    assert any("quadratic_drag on joint 1: not needed if" in said for said in search.failures)
    # Nothing else has a held shape, so the result is final.
    assert replaced_by_shape(search, found) is None


def test_a_true_effect_stays_beside_a_free_shape():
    """Without the drag, which is true, the free exponent explains less."""
    refits, peak = fitted(lambda v: bell(v) + 0.3 * v * np.abs(v))
    search, _, _ = searched(refits, peak)
    both = refits.filtered(peak.fit.loop.add(QuadraticDrag(1)), peak.noise)
    at = search.visit(search.added(both), both)
    assert replaced_by_shape(search, at) is None


def test_a_rival_whose_shape_is_held_is_fitted_with_the_shape_free(ended):
    """Drag in the place of the peak, which with its exponent held has a score that is worse by 20.

    The score of the drag is made up; the fits are not.
    """
    refits, peak = ended
    search, bare, held = searched(refits, peak)
    assert has_held_shape(held.effects[0])
    dragged = refits.filtered(bare.add(QuadraticDrag(1)), peak.noise)
    drag = search.judged(search.added(dragged), dragged)
    drag = dataclasses.replace(drag, score=held.score - 20.0)
    search.visited.add(drag)
    found = replaced(search, drag)
    assert found is not None
    assert found.names == (("stribeck", 1),)
    assert "ds1" in found.fit.loop.names
    assert found.score < drag.score - 20
    # Its shape is estimated now, so it is not tried again.
    assert replaced(search, dataclasses.replace(drag, score=found.score - 1.0)) is None


@pytest.mark.parametrize("centre", [0.1, 0.5, 1.0])
def test_deviations_are_at_most_those_between_two_bounds(centre):
    """Compared with draws of which those beyond the bounds of the first value are left out."""
    std = np.array([6.2, 0.46, 0.1])
    correlation = np.array([[1.0, -0.999, 0.0], [-0.999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    wide = correlation * np.outer(std, std)
    one = jnp.array([1.0, jnp.inf, jnp.inf])
    bounds = Bounds(jnp.array([0.0, -jnp.inf, 0.0]), one, jnp.ones(3))
    found = np.sqrt(np.diag(_between_bounds(wide, bounds)))
    rng = np.random.default_rng(3)
    drawn = rng.multivariate_normal([centre, 0.0, 0.0], wide, 200_000)
    drawn = drawn[(drawn[:, 0] > 0) & (drawn[:, 0] < 1)]
    spread = drawn.std(axis=0)
    assert found[0] == pytest.approx(0.5)
    assert found[2] == pytest.approx(0.1)
    assert np.all(found > 0.98 * spread)
    assert np.all(found < 2 * spread)
    # Values that are certain enough, or that nothing determines, keep their deviations.
    narrow = np.diag([0.04, np.inf, 0.01])
    np.testing.assert_array_equal(_between_bounds(narrow, bounds), narrow)
