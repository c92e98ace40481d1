"""Shapes of added effects that are estimated when a search has ended, and their deviations."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from test_release import DRY, axis, recorded

import jaxid
from jaxid.discovery.fits import Fits
from jaxid.discovery.models import Model
from jaxid.discovery.shapes import _held_shapes, _merged, _starts, with_shapes
from jaxid.discovery.verify import Refits
from jaxid.effects import Coulomb, Stribeck
from jaxid.noise import ARFilter
from jaxid.storage.campaign import Campaign

PEAK, SPEED, WIDTH = 1.8, 0.03, 0.004


def falling(v):
    """A sign of velocity with a peak that falls as an exponential of speed."""
    return np.tanh(v / WIDTH) * (1 + PEAK / DRY * np.exp(-np.abs(v / SPEED)))


@pytest.fixture(scope="module")
def ended():
    """A fitted model whose exponent is held at 2, where 1 is true, and what made its fit."""
    width = WIDTH * np.arctanh(0.5)
    peak = Stribeck(1, 1.0, 0.03, smoothing=width, form=1.0)
    friction = Coulomb(1, 3.0, smoothing=width, form=1.0)
    loop = axis().without("coulomb").add(friction, peak)
    refits = Refits(jaxid.Recordings.of([recorded(k, falling) for k in (1, 2)]), jaxid.OEM())
    noise = (ARFilter(np.zeros(0), 1e-3),)
    fit = refits.filtered(loop, noise)
    return refits, Model((fit.loop.effects[-1],), 0.0, fit=fit, noise=noise)


def test_an_exponent_is_estimated_at_the_end(ended):
    refits, model = ended
    held = model.fit.table().loc["Fs1"]
    assert abs(held["value"] - PEAK) > 10 * held["std"]
    table = with_shapes(Fits(refits, Campaign(None, {})), model).table()
    for name, true in (("Fs1", PEAK), ("vs1", SPEED), ("ds1", 1.0), ("Fc1", DRY)):
        assert abs(table.loc[name, "value"] - true) < 3 * table.loc[name, "std"]
    assert table.loc["Fs1", "std"] < 0.2 * PEAK


def test_effects_without_a_held_shape_keep_their_fit(ended):
    refits, model = ended
    without = dataclasses.replace(model, effects=())
    assert with_shapes(Fits(refits, Campaign(None, {})), without) is model.fit
    fixed = dataclasses.replace(model.fit, loop=model.fit.loop.hold("ds1"))
    users = dataclasses.replace(model, fit=fixed)
    assert with_shapes(Fits(refits, Campaign(None, {})), users) is fixed


def test_each_shape_has_its_own_starts(ended):
    _, model = ended
    (exponent,) = _held_shapes(model.fit.loop, 1)
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
