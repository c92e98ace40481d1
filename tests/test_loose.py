"""Effects of which the recordings determine no value."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from stories import with_chain

import jaxid
from jaxid.discovery.loose import undetermined, with_fewer, without_loose
from jaxid.discovery.models import Model, Visited
from jaxid.discovery.search import Search
from jaxid.discovery.verify import values_of, wald
from jaxid.effects import AsymmetricFriction, QuadraticDrag, TorqueOffset


@pytest.mark.xdist_group("offset")
def test_every_added_effect_must_be_determined(offset_case, offset_story):
    start = offset_story[0].steps[0]
    fit = with_chain(offset_case, start, TorqueOffset(joint=2), QuadraticDrag(joint=1))[-1].fit
    offset, drag = fit.loop.effects[-2:]
    # The drag is not there, so its coefficient is at its bound, zero.
    assert undetermined(fit, 2) == (drag,)
    assert undetermined(fit, 1) == (drag,)
    # A value is determined if it is at least two deviations away from zero.
    for std, found in ((0.49, (drag,)), (0.51, (offset, drag)), (np.inf, (offset, drag))):
        covariance = fit.covariance.copy()
        covariance[-2, -2] = (std * fit.theta[-2]) ** 2
        assert undetermined(dataclasses.replace(fit, covariance=covariance), 2) == found


@pytest.mark.xdist_group("offset")
@pytest.mark.parametrize(("correlation", "known"), [(0.9, False), (0.0, False), (-0.9, True)])
def test_values_that_replace_each_other_are_determined_together(
    correlation, known, offset_case, offset_story
):
    start = offset_story[0].steps[0]
    fit = with_chain(offset_case, start, AsymmetricFriction(joint=1))[-1].fit
    (added,) = fit.loop.effects[-1:]
    values = [k for k, linear in values_of(fit.loop, len(fit.loop.effects) - 1) if linear]
    assert len(values) == 2
    # Each value is one deviation away from zero.
    own, covariance = fit.theta[values], fit.covariance.copy()
    covariance[np.ix_(values, values)] = [
        [own[0] ** 2, correlation * own[0] * own[1]],
        [correlation * own[0] * own[1], own[1] ** 2],
    ]
    changed = dataclasses.replace(fit, covariance=covariance)
    # The closed form for two values: the sum of squares of the principal components.
    assert wald(changed, values) == pytest.approx(2 / (1 + correlation))
    assert undetermined(changed, 1) == (() if known else (added,))
    covariance[values[0], values[0]] = np.inf
    assert undetermined(dataclasses.replace(fit, covariance=covariance), 1) == (added,)


@pytest.mark.xdist_group("offset")
def test_of_two_effects_that_take_each_others_place_one_is_fitted(offset_case, offset_story):
    """Beside itself, an offset has no determined value."""
    start = offset_story[0].steps[0]
    both = with_chain(offset_case, start, TorqueOffset(joint=2), TorqueOffset(joint=2))[-1].fit
    loose = undetermined(both, 2)
    assert len(loose) == 2
    search = object.__new__(Search)
    search.added = lambda fit: fit.loop.effects[-2:]
    search.had, search.judged = (lambda at, kept: None), (lambda added, fit: None)
    search.not_genuine = lambda fit: ()
    alone = offset_story[0].fit
    search.refitted = lambda model, kept: Model(tuple(kept), -5.0, fit=alone)
    assert with_fewer(search, Model((), 0.0), both, loose).effects == (loose[1],)
    none = dataclasses.replace(alone, covariance=np.full_like(alone.covariance, np.inf))
    search.refitted = lambda model, kept: Model(tuple(kept), -5.0, fit=none)
    assert with_fewer(search, Model((), 0.0), both, loose) is None
    assert with_fewer(search, Model((loose[0],), 0.0), both, loose) is None


@pytest.mark.parametrize(("percent", "replaced"), [(1.1, True), (4.0, False)])
@pytest.mark.xdist_group("offset")
def test_effects_without_a_determined_value_are_left_to_a_curve(
    percent, replaced, offset_case, offset_story
):
    start = offset_story[0].steps[0]
    fit = with_chain(offset_case, start, TorqueOffset(joint=2), QuadraticDrag(joint=1))[-1].fit
    offset, drag = fit.loop.effects[-2:]
    assert undetermined(fit, 2) == (drag,)
    search = object.__new__(Search)
    search.failures, search.visited = (), Visited()
    search.at = Model((offset, drag), -50.0, fit=fit, left=np.array([1.0, 1.0]))
    search.diagnoses = {search.at.key: SimpleNamespace(floor_percent=lambda: np.ones(2))}
    curve = jaxid.effects.Curve(joint=1, coordinate="q", of=1)
    search.visited.add(Model((offset,), -20.0, curve=curve, left=np.array([percent, 1.0])))
    part = Model((offset,), 30.0, left=np.array([5.0, 1.0]))
    search.refitted = lambda at, effects: part
    assert without_loose(search, search.at) is (part if replaced else None)
    assert bool(search.failures) == replaced
