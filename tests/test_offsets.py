"""Offsets of a model that may be friction that differs by direction.

Torque is that of inverse dynamics written out here, along motions in closed form.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from test_release import axis, predictor, recorded

import jaxid
from jaxid.discovery.fits import Fits
from jaxid.discovery.last_tries import without_offset
from jaxid.discovery.models import LIKELY, Model, Visited
from jaxid.discovery.offsets import held_offsets, instead_of_offsets
from jaxid.discovery.predict import Predictor
from jaxid.discovery.search import Search
from jaxid.discovery.system import System
from jaxid.discovery.undecided import undecided
from jaxid.discovery.verify import Refits
from jaxid.effects import AsymmetricFriction, QuadraticDrag
from jaxid.noise import ARFilter
from jaxid.storage.campaign import Campaign

SIZE, EPS = 0.8, 0.003


def sharp(v):
    return 2 / np.pi * np.arctan(v / EPS)


def biased(seed: int, smooth: bool, noise: float = 0.1, viscous: float = 0.0) -> jaxid.Recording:
    """An axis with a constant torque, or with friction that is larger forward than backward."""
    record = recorded(seed, sharp, noise=noise)
    v = np.gradient(record.q[:, 0], record.time)
    more = SIZE * (np.abs(sharp(v)) if smooth else np.ones_like(v)) + viscous * np.abs(v)
    return dataclasses.replace(record, tau=record.tau + more[:, None])


def values(found) -> np.ndarray:
    return np.full(len(found.system.loop.theta), 1e-3)


@pytest.mark.slow
def test_friction_by_direction_replaces_an_offset_that_absorbed_it():
    seen = predictor([biased(1, True), biased(2, True)], axis(EPS))
    (found,) = instead_of_offsets(seen, values(seen))
    assert found.loss < -LIKELY
    assert float(found.effect.coulomb) == pytest.approx(SIZE, rel=0.02)
    assert held_offsets(found.loop) == ["offset1"]
    assert float(found.loop.effects[2].level) == 0.0
    # The friction does not differ in its viscous part, which is not estimated.
    assert found.loop.effects[3] is found.effect
    assert found.loop.held_names == {"offset1", "dFv1"}
    assert float(found.effect.viscous) == 0.0
    # An offset that is not significant is not examined, nor one that the user holds.
    assert instead_of_offsets(seen, 1e3 * values(seen)) == []
    held = predictor([biased(1, True)], axis(EPS).hold("offset1"))
    assert instead_of_offsets(held, values(held)) == []


@pytest.mark.slow
def test_a_viscous_part_that_explains_its_price_is_estimated():
    runs = [biased(seed, True, viscous=1.5) for seed in (1, 2)]
    seen = predictor(runs, axis(EPS))
    (found,) = instead_of_offsets(seen, values(seen))
    assert found.loop.held_names == {"offset1"}
    assert float(found.effect.viscous) == pytest.approx(1.5, rel=0.05)
    assert float(found.effect.coulomb) == pytest.approx(SIZE, rel=0.05)


def test_an_offset_stays_where_the_torque_is_constant():
    seen = predictor([biased(1, False), biased(2, False)], axis(EPS))
    (found,) = instead_of_offsets(seen, values(seen))
    assert found.loss > LIKELY


def test_a_fit_without_an_offset_is_saved_under_its_own_name(monkeypatch):
    runs = jaxid.Recordings.of([recorded(1, sharp)])
    fit = jaxid.fit(axis(EPS), runs, jaxid.OEM(progress=False))
    campaign, names = Campaign(None, {}), []
    monkeypatch.setattr(campaign, "piece", lambda name, work: names.append(name) or fit)
    fits = Fits(Refits(runs, jaxid.OEM()), campaign)
    for loop in (axis(EPS), axis(EPS).hold(offset1=0.0)):
        fits.exchanged(loop, (), (), ())
    assert names[1].endswith(", offset1 held")
    assert "offset1 held" not in names[0]


def test_the_friction_is_tried_beside_the_effects_that_were_added(monkeypatch):
    runs = [biased(1, True), biased(2, True)]
    drag = QuadraticDrag(joint=1)
    fit = jaxid.fit(axis(EPS).add(drag), runs, jaxid.OEM(progress=False))
    seen = Predictor.of(System.of(fit), [ARFilter(np.zeros(0), 0.01)])
    tried = []
    monkeypatch.setattr(Refits, "unfiltered", lambda self, loop, noise: fit)
    monkeypatch.setattr(Refits, "filtered", lambda self, loop, noise: tried.append(loop) or fit)
    at = Model((fit.loop.effects[-1],), 0.0, fit=fit)
    search = object.__new__(Search)
    search.seen, search.offsets, search.small = (fit, seen), {}, set()
    search.visited = Visited()
    search.asked = SimpleNamespace(catalogue=(AsymmetricFriction,), most=6)
    search.fits = Fits(Refits(jaxid.Recordings.of(runs), jaxid.OEM()), Campaign(None, {}))
    search.watched = SimpleNamespace(begin=lambda *_: None)
    search.not_genuine = lambda fit: ()
    search.added = lambda fit: fit.loop.effects[-1:]
    search.visit = lambda effects, fit: Model(effects, 10.0, fit=fit)
    assert without_offset(search, at) is None
    names = [e.effect_name() for e in tried[0].effects]
    assert names == ["viscous", "coulomb", "torque_offset", "quadratic_drag", "asymmetric_friction"]


def searched(smooth: bool, noise: float = 0.1, **settings) -> jaxid.Discovery:
    runs = [biased(k, smooth, noise) for k in (1, 2)]
    unseen = biased(3, smooth, noise)
    return jaxid.discover(axis(EPS), runs, validate=unseen, progress=False, **settings)


@pytest.mark.slow
def test_friction_by_direction_is_named_and_an_offset_is_not():
    # What the friction explains beside the offset is smaller than `worth`.
    found = searched(True, worth=5.0)
    assert found.verdict == "explained"
    (added,) = found.to_dict()["added"]
    assert (added["effect"], added["joint"]) == ("asymmetric_friction", 1)
    assert added["parameters"]["coulomb"]["value"] == pytest.approx(SIZE, rel=0.05)
    assert any("offset1 was left out" in note for note in found.notes)
    constant = searched(False)
    assert constant.verdict == "adequate"
    assert not any("offset" in note for note in constant.notes)


def test_where_noise_hides_the_difference_both_have_a_weight():
    found = searched(True, noise=2.0)
    assert found.verdict == "undetermined"
    weights = found.models.set_index("model")["weight"]
    share = f"{weights['asymmetric_friction on joint 1']:.2g}"
    assert f"asymmetric_friction on joint 1 has {share}" in found.reason
    assert any("may also be asymmetric_friction" in note for note in found.notes)
    # Both have one value, and an offset of this size is less likely: the friction that is there has
    # more weight.
    assert 0.5 < weights["asymmetric_friction on joint 1"] < 0.95
    assert weights.sum() == pytest.approx(1.0)


def test_an_offset_and_its_friction_at_one_score_do_not_contradict_each_other():
    fit = jaxid.fit(axis(EPS), [biased(1, False, 0.1)])
    friction = AsymmetricFriction(joint=1)
    loop = fit.loop.add(friction).hold(offset1=0.0)
    there = dataclasses.replace(fit, loop=loop)
    start = Model((), 100.0, fit=fit, weight=0.4)

    def told(score, other=there):
        rival = Model((friction,), score, fit=other, weight=0.6)
        return undecided(sorted([rival, start], key=lambda m: m.score), start, {}, 0.05)

    assert told(99.0) == ""
    assert told(102.0) == ""
    # Unless the friction is decidedly better, or in addition to the offset.
    assert "asymmetric_friction on joint 1 has 0.6" in told(97.0)
    beside = dataclasses.replace(fit, loop=fit.loop.add(friction))
    assert "asymmetric_friction on joint 1 has 0.6" in told(99.0, beside)
