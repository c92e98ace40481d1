"""The parts of a discovery's search: what is refitted, what is taken out, what begins afresh."""

import dataclasses
import sys

import independent as sim
import numpy as np
import pytest
from independent import effects as fx
from stories import Bump, search_of, silent, with_chain

import jaxid
from jaxid.discovery.choices import addable, doubled, rivals_of
from jaxid.discovery.pruning import is_series, prune
from jaxid.discovery.refits import Refits, of_one_sign, with_released
from jaxid.discovery.story import Contender
from jaxid.discovery.turns import Search
from jaxid.effects import Backlash, JointElasticity, QuadraticDrag, Spring, Stribeck, TorqueOffset


@pytest.mark.xdist_group("offset")
def test_superfluous_effect_is_taken_out_and_a_needed_one_stays(offset_case, offset_story):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    offset, drag = TorqueOffset(joint=2), QuadraticDrag(joint=1)
    left, removed = prune(search, with_chain(search, start, drag, offset), silent)
    assert removed == (("quadratic_drag", 1),)
    assert [s.added.effect_name() for s in left[1:]] == ["torque_offset"]
    assert "drag" not in repr(left[-1].fit.loop)
    left, removed = prune(search, with_chain(search, start, offset, drag), silent)
    assert removed == (("quadratic_drag", 1),)
    assert [s.added.effect_name() for s in left[1:]] == ["torque_offset"]
    assert left[-1].fit.loop.effects[-1].effect_name() == "torque_offset"


@pytest.mark.xdist_group("offset")
def test_rival_with_less_takes_the_place_of_an_early_effect(offset_case, offset_story, monkeypatch):
    search, start = search_of(offset_case), offset_story[0].steps[0]

    def step(self, label, found, **extra):
        return dataclasses.replace(start, label=label, fit=found, **extra)

    def grown(self, last, contenders, say):
        best = contenders[0]
        added = best.fit.loop.effects[-1]
        return step(self, "+", best.fit, added=added, contenders=tuple(contenders))

    # Which effect goes and which comes is asked here, and a diagnosis of each takes long.
    monkeypatch.setattr(Search, "step", step)
    monkeypatch.setattr(Search, "grown", grown)
    spring, drag = Spring(joint=2), QuadraticDrag(joint=1)
    steps = with_chain(search, start, spring, drag)
    fits = steps[1].fit, with_chain(search, start, TorqueOffset(joint=2))[1].fit
    contenders = tuple(
        Contender(name, 2, fitted, search.refits.criterion(fitted, start.diagnosis))
        for name, fitted in zip(("spring", "torque_offset"), fits, strict=True)
    )
    steps[1] = dataclasses.replace(steps[1], contenders=contenders)
    left, removed = prune(search, steps, silent)
    # The drag, last and never needed, goes once the offset has come.
    assert removed == (("quadratic_drag", 1),)
    assert [s.added.effect_name() for s in left[1:]] == ["torque_offset"]
    assert type(left[-1].fit.loop.effects[-1]) is TorqueOffset
    # Not the other way round: a spring has more to adjust than an offset.
    assert rivals_of(dataclasses.replace(left[1], contenders=contenders[::-1])) == []


@pytest.mark.xdist_group("offset")
def test_transmission_that_alone_does_better_begins_afresh(offset_case, offset_story, monkeypatch):
    search, steps = search_of(offset_case), offset_story[0].steps
    value = {"good": 5.0, "poor": 12.0}
    found = [
        Contender(name, 1, dataclasses.replace(steps[0].fit, notes=(word,)), 0.0)
        for name, word in (("joint_elasticity", "poor"), ("backlash", "good"))
    ]
    tried = []

    def refit(self, last, leading, say):
        tried.extend(v.key for v in leading)
        return found

    def grown(self, last, contenders, say):
        return dataclasses.replace(last, contenders=tuple(contenders))

    monkeypatch.setattr(Refits, "refit", refit)
    monkeypatch.setattr(Search, "grown", grown)
    monkeypatch.setattr(
        Refits, "criterion", lambda self, fit, _: value.get("".join(fit.notes[-1:]), 10.0)
    )
    assert search.afresh(steps, silent).contenders == (found[1],)
    # All of them, from the starting model.
    kinds = ("joint_elasticity", "backlash")
    assert sorted(tried) == sorted((kind, joint) for kind in kinds for joint in (1, 2))
    value["good"] = 11.0
    assert search.afresh(steps, silent) is None


def test_contact_is_released_from_several_stiffnesses():
    loop = jaxid.scara().add(Backlash(joint=2, gap=0.01, stiffness=200.0, damping=2.0))
    released = with_released(loop, ("kc2", "dk2"))
    values = [dict(zip(r.names, np.asarray(r.theta), strict=True)) for r in released]
    assert [(v["kc2"], v["dk2"]) for v in values] == [
        (200.0, 2.0),
        (100.0, 2.0),
        (400.0, 2.0),
        (200.0, 1.0),
        (200.0, 4.0),
    ]
    assert with_released(loop, ()) == []


def fits_replaced(monkeypatch, result: jaxid.Fit) -> list:
    """Loops and methods that a discovery fits from now on, each with this result."""
    calls = []

    def fit(loop, recordings, method):
        calls.append((loop, method))
        return dataclasses.replace(result, loop=loop)

    monkeypatch.setattr(sys.modules["jaxid.discovery.refits"], "fit", fit)
    return calls


@pytest.mark.xdist_group("offset")
def test_contact_is_free_from_the_start_in_some_refits(offset_case, offset_story, monkeypatch):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    calls = fits_replaced(monkeypatch, start.fit)
    of = {v.key: v for v in start.diagnosis.ranking}
    screened = of["backlash", 2].hypothesis.effect
    loops = search.refits.starts(start, of["backlash", 2])
    gaps = [float(loop.effects[-1].gap / screened.gap) for loop in loops]
    assert gaps[1:] == pytest.approx([1.0, 1.0, 10.0])
    assert ["kc2" in loop.names for loop in loops] == [False, False, True, True]
    # Without noise filters, which knew nothing of a gap.
    assert [type(method) for _, method in calls] == [jaxid.OEM, jaxid.OEM]
    assert len(search.refits.starts(start, of["joint_elasticity", 2])) == 3
    assert [f.order for f in calls[-1][1].filters] == [0, 0]
    assert len(search.refits.starts(start, of["spring", 2])) == 1


@pytest.mark.xdist_group("offset")
def test_backlash_is_tried_where_an_elasticity_leads(offset_case, offset_story, monkeypatch):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    calls = fits_replaced(monkeypatch, start.fit)
    monkeypatch.setattr(Refits, "criterion", lambda self, fit, _: 3.0)
    soft = JointElasticity(joint=2, compliance=0.02, rotor=0.03)
    leading = Contender(
        "joint_elasticity", 2, dataclasses.replace(start.fit, loop=start.fit.loop.add(soft)), 5.0
    )
    found = search.refits.with_siblings([leading], start, silent)
    assert [(c.name, c.joint) for c in found] == [("backlash", 2), ("joint_elasticity", 2)]
    loop, _ = calls[0]
    gap = loop.effects[-1]
    load = np.std(np.concatenate([r.tau[:, 1] for r in search.refits.recordings]))
    assert float(gap.gap) == pytest.approx(2 * 0.02 * load)
    assert float(gap.rotor) == 0.03
    assert float(gap.stiffness) == pytest.approx(50.0)
    assert "kc2" in loop.names
    # Not of a backlash, and not of what is no transmission.
    of = {v.key: v.hypothesis.effect for v in start.diagnosis.ranking}
    for name in ("backlash", "spring"):
        loop = start.fit.loop.add(of[name, 2])
        other = Contender(name, 2, dataclasses.replace(start.fit, loop=loop), 5.0)
        assert search.refits.with_siblings([other], start, silent) == [other]


@pytest.mark.xdist_group("offset")
def test_effect_is_added_twice_at_the_most(offset_story):
    start = offset_story[0].steps[0]
    top = next(v for v in start.diagnosis.ranking if v.possible and v.evidence > 0)
    step = dataclasses.replace(start, added=start.diagnosis.predicted(top))
    for often in (0, 1):
        found = addable([start] + often * [step], lambda v: True)
        assert top.key in [v.key for v in found]
    assert top.key not in [v.key for v in addable([start, step, step], lambda v: True)]


@pytest.mark.xdist_group("bump")
def test_chain_that_a_curve_outdoes_is_a_series(bump_case, bump_story):
    search, start = search_of(bump_case), bump_story.steps[0]
    poor = [QuadraticDrag(joint=2), TorqueOffset(joint=2), QuadraticDrag(joint=1)]
    assert is_series(search, with_chain(search, start, *poor), silent)
    true = [Bump(joint=2, height=0.05, place=0.5, width=0.25), *poor[:2]]
    assert not is_series(search, with_chain(search, start, *true), silent)
    assert not is_series(search, with_chain(search, start, *poor[:2]), silent)


def test_a_transmission_is_no_second_one():
    loop = jaxid.scara().add(Backlash(joint=1, gap=0.01), TorqueOffset(joint=1))
    shaft = JointElasticity(joint=1, compliance=0.01)
    assert doubled(loop, 1, shaft)
    assert not doubled(loop, 2, shaft)
    assert not doubled(loop, 1, TorqueOffset(joint=1))


def test_effects_share_the_sharpness_that_is_estimated_for_their_joint():
    worn = Stribeck(1, 0.0, 0.02, gamma=5.0)
    loop = jaxid.emps().with_values(gamma1=1.2e4).add(worn)
    assert float(of_one_sign(loop).effects[-1].gamma) == 1.2e4
    # What a user has freed, or never asked to estimate, is the user's.
    freed = loop.free("gamma1_2")
    assert float(of_one_sign(freed).effects[-1].gamma) == 5.0
    held = jaxid.scara().add(worn)
    assert float(of_one_sign(held).effects[-1].gamma) == 5.0


@pytest.mark.slow
def test_a_load_that_drives_the_axis_into_its_limit_is_found():
    """Its signature promises an eighth of it, and filters that know no more bar the way.

    The drive is at the controller's limit in both recordings, in the loaded one for longer.
    """
    load = fx.Payload(3.4137, 0.3, ("fit_2",))
    case = sim.make_case(1817948849, [load], noise="strong", robot="axis")
    search = search_of(case)
    start = search.begin(jaxid.emps(), silent)
    verdict = next(v for v in start.diagnosis.ranking if v.key == ("payload", None))
    assert start.diagnosis.amplitude(verdict)[0] < 0.2 * load.mass
    (best,) = search.refits.refit(start, [verdict], silent)
    place = best.fit.names.index("payload")
    assert abs(best.fit.theta[place] - load.mass) < 4 * best.fit.std[place]
    assert best.fit.loop.effects[-1].recordings == load.recordings
