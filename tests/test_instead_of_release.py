"""Effects that a release hides, which are fitted to the model before the release."""

import numpy as np
import pytest

from jaxid.discovery.explore import Candidate, key_of
from jaxid.discovery.models import Model
from jaxid.discovery.predict import Prediction
from jaxid.discovery.search import Search
from jaxid.effects import Curve, QuadraticDrag, Stribeck

PEAK, DRAG = Stribeck(1), QuadraticDrag(1)


def candidate(score, *effects, curve=None):
    unused, rest = object.__new__(Prediction), np.zeros((1, 1, 1))
    return Candidate(effects, score, (), unused, rest, np.zeros(0), curve)


def searched(fitted=-130.0, supported=True):
    """A search after a release that lowered the score from 0 to -30, and what it fits."""
    search = object.__new__(Search)
    search.seen, fits = "released", []
    search._supported = lambda c: supported and search.seen == "before"

    def fit(at, c, examined, promised):
        fits.append((at.score, c.key, promised))
        return None if fitted is None else Model(c.effects, fitted)

    search._fitted = fit
    sets = [
        candidate(0.0),
        candidate(-9.0, DRAG),
        candidate(-120.0, PEAK),
        candidate(-150.0, curve=Curve(joint=1, coordinate="q", of=1)),
    ]
    search.unreleased = Model((), 0.0), "before", sets, 0.0
    return search, fits


def test_a_peak_that_explains_little_after_a_release_is_fitted_before_it():
    search, fits = searched()
    # The scores of predictions have another origin than those of fits.
    now = [candidate(70.0), candidate(66.0, PEAK), candidate(69.0, DRAG)]
    found = search._instead_of_release(Model((), -30.0), now, 70.0)
    assert found.effects == (PEAK,)
    assert fits == [(0.0, key_of([PEAK]), 120.0)]
    # It is tried once, and the linear system is that of the current model again.
    assert (search.unreleased, search.seen) == (None, "released")
    assert search._instead_of_release(Model((), -30.0), now, 70.0) is None
    assert len(fits) == 1


@pytest.mark.parametrize(
    ("fitted", "supported", "now"),
    [
        # What it explains after the release is as good.
        (-130.0, True, [candidate(70.0), candidate(-15.0, PEAK)]),
        # A part of the set is as good.
        (-130.0, True, [candidate(-20.0)]),
        # The fit is not better than the release by ten, or fails.
        (-35.0, True, [candidate(70.0), candidate(66.0, PEAK)]),
        (None, True, [candidate(70.0), candidate(66.0, PEAK)]),
        # It does not explain stretches that are left out.
        (-130.0, False, [candidate(70.0), candidate(66.0, PEAK)]),
    ],
)
def test_a_release_stays_unless_an_effect_in_its_place_is_better(fitted, supported, now):
    search, fits = searched(fitted, supported)
    assert search._instead_of_release(Model((), -30.0), now, 70.0) is None
    hidden = min(c.score for c in now) > 0
    assert len(fits) == (hidden and supported)
    assert search.seen == "released"


def test_without_a_release_nothing_is_tried():
    search, fits = searched()
    search.unreleased = None
    assert search._instead_of_release(Model((), -30.0), [candidate(np.inf)], 70.0) is None
    assert fits == []
