"""What a search tries at last: other effects in the place of those it has chosen."""

import dataclasses
from types import SimpleNamespace

import independent as sim
import numpy as np
import pytest
from independent import effects as fx
from stories import recordings_of, scene_of, search_of, two_link_of, with_chain

import jaxid
from jaxid.discovery.diagnosis import Diagnosis
from jaxid.discovery.last_tries import doubtful, replaced, with_transmission
from jaxid.discovery.models import Model
from jaxid.discovery.search import Search
from jaxid.discovery.transmissions import similar_ones, suspected
from jaxid.discovery.verify import Refits, held_shapes
from jaxid.effects import (
    Backlash,
    JointElasticity,
    Spring,
    TimeDelay,
    TorqueOffset,
    TorqueSaturation,
)

OFFSET = (TorqueOffset(joint=2, level=0.01),)


def with_a_weak_spring(case, story) -> tuple[Search, Model, Model]:
    """A search of an offset, its start, and the fit of a weak spring in the offset's place."""
    search, start = search_of(case), story[0].steps[0]
    without = search.visit((), start.fit)
    last = with_chain(case, start, Spring(joint=2, stiffness=0.01))[-1].fit
    return search, without, search.visit(search.added(last), last)


@pytest.mark.xdist_group("offset")
def test_a_close_rival_that_was_only_predicted_is_fitted(offset_case, offset_story):
    """A weak spring in the place of the offset; the prediction puts the offset slightly behind."""
    search, _, at = with_a_weak_spring(offset_case, offset_story)
    search.visited.add(Model(OFFSET, at.score + 20.0, noise=at.noise, beyond=1))
    assert replaced(search, at) is None
    search.visited.add(Model(OFFSET, at.score + 5.0, noise=at.noise, beyond=1))
    found = replaced(search, at)
    assert found is not None
    assert found.names == (("torque_offset", 2),)
    assert found.score < at.score - 5
    # It was fitted, so it is not tried again.
    assert replaced(search, found) is None


@pytest.mark.xdist_group("offset")
@pytest.mark.parametrize("worse", [0.0, 1000.0])
def test_a_rival_whose_fit_is_worse_than_that_of_a_part_is_fitted_again(
    worse, offset_case, offset_story
):
    """The fit without the effect has a lower score, so that with it is not at its minimum."""
    search, without, at = with_a_weak_spring(offset_case, offset_story)
    score = without.score + worse if worse else at.score + 5.0
    search.visited.add(Model(OFFSET, score, fit=at.fit, noise=at.noise))
    found = replaced(search, at)
    assert (found is not None) == bool(worse)
    if found is not None:
        assert found.names == (("torque_offset", 2),)
        assert found.score < at.score - 5


@pytest.mark.xdist_group("offset")
def test_a_predicted_model_that_makes_an_effect_doubtful_is_fitted(offset_case, offset_story):
    """Without the spring, and with weight: the offset is better, a second spring has no value."""
    search, _, at = with_a_weak_spring(offset_case, offset_story)
    search.visited.add(Model(OFFSET, at.score + 20.0, noise=at.noise, beyond=1))
    assert doubtful(search, at) is None
    pair = Model(
        (*OFFSET, Spring(joint=1, stiffness=0.01)), at.score - 5.0, noise=at.noise, beyond=2
    )
    search.visited.add(pair)
    asked = search.asked
    search.asked = dataclasses.replace(asked, most=1)
    assert doubtful(search, at) is None
    assert pair.key in [m.key for m in search.visited.ranked()]
    search.asked = asked
    assert doubtful(search, at) is None
    assert pair.key not in [m.key for m in search.visited.ranked()]
    search.visited.add(Model(OFFSET, at.score + 5.0, noise=at.noise, beyond=1))
    found = doubtful(search, at)
    assert found is not None
    assert found.names == (("torque_offset", 2),)
    assert found.score < at.score - 5
    assert doubtful(search, found) is None


def diagnosis_of(*verdicts) -> Diagnosis:
    """One with these verdicts on effects, and on no curve."""
    found = object.__new__(Diagnosis)
    parts = {"forms": verdicts, "ranking": verdicts, "where": (), "significance": 0.01}
    parts["scene"] = scene_of(3.0)
    for name, value in parts.items():
        object.__setattr__(found, name, value)
    return found


def test_a_significant_limit_is_fitted_from_one_that_acts():
    """Screened limits of the other joint are not significant."""
    limits = [TorqueSaturation(joint=j, limit=10.0) for j in (1, 2)]
    gap = Backlash(joint=1, gap=0.1)
    verdicts = [
        SimpleNamespace(hypothesis=SimpleNamespace(effect=e, joint=e.joint), p_value=p)
        for e, p in zip((*limits, gap), (1e-6, 0.5, 1e-6), strict=True)
    ]
    found = suspected(diagnosis_of(*verdicts))
    assert found[0] is gap
    assert [(e.joint, float(e.limit)) for e in found[1:]] == [(1, 8.0)]


@pytest.mark.xdist_group("offset")
def test_a_suspected_transmission_that_explains_nothing_has_one_fit(
    offset_case, offset_story, monkeypatch
):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    at = search.visit((), start.fit)
    soft = JointElasticity(joint=2, compliance=1e-4, rotor=0.02)
    verdict = SimpleNamespace(hypothesis=SimpleNamespace(effect=soft, joint=2), p_value=1e-6)
    search.diagnoses = {at.key: diagnosis_of(verdict)}
    fits = []
    monkeypatch.setattr(Refits, "with_effects", lambda *_: pytest.fail("a further fit"))
    monkeypatch.setattr(Refits, "with_one", lambda *_: fits.append(start.fit) or start.fit)
    assert with_transmission(search, at) is None
    assert len(fits) == 1


@pytest.mark.slow
def test_a_load_that_drives_the_axis_into_its_limit_is_found():
    """Its signature predicts an eighth of it, and filters of that prediction prevent convergence.

    The drive is at the controller's limit in both recordings, in the loaded one for longer.
    """
    load = fx.Payload(3.4137, 0.3, ("fit_2",))
    case = sim.make_case(1817948849, [load], noise="strong", robot="axis")
    found = jaxid.discover(jaxid.emps(), *recordings_of(case), progress=False)
    place = found.fit.names.index("payload")
    assert abs(found.fit.theta[place] - load.mass) < 4 * found.fit.std[place]
    assert found.loop.effects[-1].recordings == load.recordings


@pytest.mark.slow
def test_a_gap_that_is_wider_than_its_signatures_is_found():
    """The best signature of a gap explains 0.2 %, and all others less than they cost."""
    gap = fx.Backlash(2, 0.12253, 0.0043017, 103.408, 3.0)
    case = sim.make_case(1157893421, [gap], noise="white", robot="two_link")
    found = jaxid.discover(two_link_of(case), *recordings_of(case), progress=False)
    assert [(a["effect"], a["joint"]) for a in found.to_dict()["added"]] == [("backlash", 2)]
    place = found.fit.names.index("gap2")
    assert abs(found.fit.theta[place] - gap.gap) < 4 * found.fit.std[place]


def test_a_fitted_elasticity_may_be_a_gap(offset_case):
    asked = search_of(offset_case).asked
    soft = JointElasticity(joint=2, compliance=1e-3, rotor=0.1)
    ((effect, gap),) = similar_ones((TorqueOffset(joint=1), soft), asked, ())
    assert effect is soft
    assert isinstance(gap, Backlash)
    assert (gap.joint, float(gap.rotor)) == (2, 0.1)
    assert float(gap.stiffness) == pytest.approx(1e3)
    load = np.sqrt(np.mean(np.concatenate([r.tau[:, 1] for r in asked.recordings]) ** 2))
    assert float(gap.gap) == pytest.approx(2e-3 * load)
    assert list(similar_ones((gap,), asked, ())) == []
    # A gap that is narrower than the twist may be none.
    ((_, again),) = similar_ones((gap.scaled(0.1),), asked, ())
    assert isinstance(again, JointElasticity)
    np.testing.assert_allclose([again.compliance, again.rotor], [1e-3, 0.1])


@pytest.mark.slow
def test_an_elasticity_takes_the_place_of_a_narrow_gap():
    """A gap of the size of its deviation in a soft contact describes an elasticity as well."""
    soft = fx.JointElasticity(1, 0.031, 0.023, 0.001)
    case = sim.make_case(1511254360, [soft], noise="white", robot="two_link")
    search = search_of(case)
    search.visit((), search.fits.start(two_link_of(case)))
    start = search.visited.fitted(())
    gap = Backlash(joint=1, gap=1e-4, rotor=0.023, stiffness=32.0, damping=0.004)
    loop = start.fit.loop.add(gap)
    loop = loop.free(*held_shapes(loop, 1))
    last = jaxid.fit(loop, search.asked.recordings, jaxid.OEM(start="given"))
    at = search.visit(search.added(last), last)
    search.diagnoses = {at.key: diagnosis_of()}
    found = with_transmission(search, at)
    assert found.names == (("joint_elasticity", 1),)
    assert found.score < at.score - 6
    value, std = (x[found.fit.names.index("compliance1")] for x in (found.fit.theta, found.fit.std))
    assert abs(value - soft.compliance) < 4 * std


def test_a_late_drive_may_be_a_soft_joint(offset_case):
    asked = search_of(offset_case).asked
    period = asked.recordings.common_period()
    soft, late = JointElasticity(joint=2, compliance=1e-3), TimeDelay(joint=2, delay=2 * period)
    screened = (soft, JointElasticity(joint=1), Spring(joint=2))
    pairs = similar_ones((late, TorqueOffset(joint=2)), asked, screened)
    assert [(id(a), id(b)) for a, b in pairs] == [(id(late), id(soft))]
    # As late as a law that is sampled with the recordings and held.
    held = dataclasses.replace(late, delay=0.5 * period)
    assert not list(similar_ones((held,), asked, screened))
