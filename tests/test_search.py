"""The search of a discovery: which sets it makes, which of them it keeps."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import independent as sim
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from independent import effects as fx
from stories import recordings_of, search_of, two_link_of, with_chain

import jaxid
from jaxid.discovery.data import Data
from jaxid.discovery.diagnosis import over_recordings
from jaxid.discovery.explore import Candidate
from jaxid.discovery.fits import Fits
from jaxid.discovery.likelihood import price, score, weights
from jaxid.discovery.models import Model, Visited, probability
from jaxid.discovery.search import Search, _lost
from jaxid.discovery.signs import of_one_sign
from jaxid.discovery.table import SignatureTable
from jaxid.discovery.verify import Refits
from jaxid.effects import (
    AbstractEffect,
    EncoderEccentricity,
    Motion,
    QuadraticDrag,
    RotorInertia,
    Spring,
    Stribeck,
    TorqueOffset,
    TorqueRipple,
    on_joint,
)
from jaxid.estimate import SeparablePEM
from jaxid.noise import ARFilter
from jaxid.parameters import Scalar, parameter
from jaxid.storage.campaign import Campaign


class OffsetAndDrag(AbstractEffect):
    """A constant torque, and a drag that is not in the data, both of one sign only."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    level: Scalar = parameter(0.0, symbol="l", unit="N·m", lower=0.0, scale=0.1)
    drag: Scalar = parameter(0.0, symbol="d", unit="N·m·s²/rad²", lower=0.0, scale=0.1)
    way: float = eqx.field(static=True, default=1.0)

    @classmethod
    def screened(cls, scene):
        return [cls(joint=j) for j in (1, 2)]

    def torque(self, motion: Motion):
        v = motion.v[self.joint - 1]
        return on_joint(self.joint, self.level + self.drag * self.way * v * jnp.abs(v), motion)


class OffsetAndThrust(OffsetAndDrag):
    """The same with the other sign of the drag."""

    @classmethod
    def screened(cls, scene):
        return [cls(joint=j, way=-1.0) for j in (1, 2)]


# --- the score ------------------------------------------------------------------------------------


def data_of(rest: np.ndarray) -> Data:
    none = np.zeros((*rest.shape, 0))
    return Data(rest, none, SignatureTable.of(none), np.ones(rest.shape[:2], bool))


def test_score_of_white_noise_is_its_likelihood_and_the_price():
    rest = 0.3 * np.random.default_rng(3).standard_normal((2, 500, 2))
    found = score(data_of(rest), rest, freedom=4, size=2, offered=10)
    assert [f.order for f in found.noise] == [0, 0]
    spread = 1000 * np.log(np.mean(rest**2, axis=(0, 1))).sum()
    assert found.value == pytest.approx(spread + 4 * np.log(2000) + 2 * np.log(45), rel=1e-9)


def test_score_of_coloured_noise_pays_for_its_filter():
    rng = np.random.default_rng(4)
    white = rng.standard_normal((1, 4000, 1))
    rest = np.copy(white)
    for k in range(1, 4000):
        rest[:, k] = 0.9 * rest[:, k - 1] + white[:, k]
    found = score(data_of(rest), rest, freedom=0, size=0, offered=10)
    order = found.noise[0].order
    assert order >= 1
    assert found.noise[0].coefficients[0] == pytest.approx(-0.9, abs=0.05)
    expected = 4000 * np.log(found.noise[0].variance) + order * np.log(4000)
    # The first rows are predicted from fewer rows than the order.
    lags = np.fft.ifft(found.noise[0].spectrum(1 << 14)).real[:order]
    expected += np.linalg.slogdet(scipy.linalg.toeplitz(lags / found.noise[0].variance))[1]
    assert found.value == pytest.approx(expected)


def test_a_mean_is_not_taken_off():
    """A constant that the model leaves is not noise."""
    rest = np.random.default_rng(5).standard_normal((1, 1000, 1))
    plain = score(data_of(rest), rest, 0, 0, 10).value
    assert score(data_of(rest), rest + 1.0, 0, 0, 10).value > plain + 100


def test_recordings_have_noise_of_their_own_where_it_is_worth_it():
    rng = np.random.default_rng(6)
    rest = rng.standard_normal((2, 800, 1)) * np.array([1.0, 5.0])[:, None, None]
    power = np.mean(rest[..., 0] ** 2, axis=1)
    found = score(data_of(rest), rest, 0, 0, 10)
    assert found.value == pytest.approx(800 * np.log(power).sum() + np.log(1600))
    assert found.noise[0].variance == pytest.approx(power.mean())
    alike = rest / np.sqrt(power)[:, None, None]
    assert score(data_of(rest), alike, 0, 0, 10).value == pytest.approx(0, abs=1e-9)


def test_price_of_a_search():
    assert price(0, 50) == 0
    assert price(1, 50) == pytest.approx(2 * np.log(50))
    assert price(2, 50) == pytest.approx(2 * np.log(50 * 49 / 2))


def test_weights_are_odds():
    found = weights([-7.0, -7.0 + 2 * np.log(20)])
    assert found.sum() == pytest.approx(1)
    assert found[0] / found[1] == pytest.approx(20)


# --- sets of effects ------------------------------------------------------------------------------


@pytest.mark.xdist_group("offset")
def test_a_fit_that_strays_is_repeated_without_filters_once(offset_story, monkeypatch):
    """Its repetition is the start of the next fit with filters, and not made again."""
    step = offset_story[0].steps[0]
    noise = step.diagnosis.noise
    refits = Refits(step.fit.recordings, jaxid.OEM(progress=False))
    plain = jaxid.fit(
        step.fit.loop,
        step.fit.recordings,
        SeparablePEM(
            refits.given(), filters=tuple(ARFilter(np.zeros(0), f.variance) for f in noise)
        ),
    )
    asked = []
    monkeypatch.setattr(Refits, "filtered", lambda self, loop, noise: asked.append(loop) or plain)
    monkeypatch.setattr(Refits, "unfiltered", lambda *_: pytest.fail("the same fit again"))
    assert refits.with_effects(step.fit, (), noise, promised=100.0) is plain
    assert len(asked) == 2


def test_what_shares_the_weight_is_alike(offset_story):
    fit = offset_story[0].fit
    offset, spring, drag = TorqueOffset(joint=2), Spring(joint=2), QuadraticDrag(joint=1)
    visited = Visited()
    chosen = Model((offset,), 100.0, fit=fit)
    for model in (
        chosen,
        Model((spring,), 103.0),
        Model((drag,), 120.0),
        Model((offset, drag), 104.0),
        Model((), 150.0, fit=fit),
    ):
        visited.add(model)
    assert visited.alike(chosen, offset) == (("spring", 2),)
    shares = np.exp([0, -1.5, -10, -2, -25])
    offset_share = (shares[0] + shares[3]) / shares.sum()
    assert probability(visited.weighed(chosen), ("torque_offset", 2)) == pytest.approx(offset_share)
    # A prediction does not take the place of a refit.
    visited.add(Model((TorqueOffset(joint=2),), 50.0, beyond=1))
    assert visited.fitted([offset]) is chosen


@pytest.mark.xdist_group("offset")
def test_superfluous_effect_is_taken_out_and_a_needed_one_stays(offset_case, offset_story):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    search.visit((), start.fit)
    offset, drag = TorqueOffset(joint=2), QuadraticDrag(joint=1)
    for effects in ((drag, offset), (offset, drag)):
        last = with_chain(offset_case, start, *effects)[-1].fit
        at = search.visit(search.added(last), last)
        left = search._without_one(at)
        assert left is not None
        assert left.names == (("torque_offset", 2),)
    assert search._without_one(left) is None


@pytest.mark.xdist_group("offset")
def test_an_effect_that_was_too_small_is_not_added_again(offset_case, offset_story, monkeypatch):
    """Its prediction may be larger than its fit, so that a search would never end."""
    monkeypatch.setattr("jaxid.discovery.search.needed", lambda *_: False)
    search, start = search_of(offset_case), offset_story[0].steps[0]
    start_model = search.visit((), start.fit)
    last = with_chain(offset_case, start, TorqueOffset(joint=2))[-1].fit
    at = search.visit(search.added(last), last)
    asked, search.asked = search.asked, dataclasses.replace(search.asked, worth=50.0)
    assert search._without_one(at).names == ()
    search.asked = asked
    candidates, _ = search._predicted(start_model)
    assert len(candidates) > 1
    assert not any("torque_offset" in (e.effect_name() for e in c.effects) for c in candidates)


@pytest.mark.xdist_group("offset")
def test_a_set_without_support_is_no_rival(offset_case, offset_story, monkeypatch):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    at = search.visit((), start.fit)
    candidates, nothing = search._predicted(at)
    best, *others = [c for c in candidates if c.effects]
    monkeypatch.setattr("jaxid.discovery.search.imposed", lambda _: True)
    monkeypatch.setattr(
        "jaxid.discovery.search.unsupported",
        lambda _, c: c.effects if c.key == best.key else (),
    )
    monkeypatch.setattr(search, "_fitted", lambda *_: None)
    assert search._verified(at, candidates, nothing) is None
    known = {m.key for m in search.visited.ranked()}
    assert best.key not in known
    assert {c.key for c in others} <= known
    assert any("does not explain stretches" in note for note in search.failures)


@pytest.mark.slow
@pytest.mark.xdist_group("offset")
def test_an_amplitude_at_its_bound_does_not_exclude_an_effect(offset_case):
    """Noise makes one of the two drags negative."""
    fit, held_out = recordings_of(offset_case)
    bound = []
    for effect in (OffsetAndDrag, OffsetAndThrust):
        found = jaxid.discover(
            jaxid.scara(), fit, held_out, catalogue=[effect], most=1, progress=False
        )
        assert [(a.effect_name(), a.joint) for a in found.loop.effects[-1:]] == [
            (effect.effect_name(), 2)
        ]
        bound.append(float(found.loop.effects[-1].drag) < 1e-6)
    assert sorted(bound) == [False, True]


@pytest.mark.slow
@pytest.mark.xdist_group("offset")
def test_what_is_not_worth_knowing_is_not_added(offset_case, offset_story):
    fit, held_out = recordings_of(offset_case)
    found = jaxid.discover(jaxid.scara(), fit, held_out, worth=50.0, progress=False)
    assert found.verdict == "adequate"
    assert offset_story[0].verdict == "explained"


@pytest.mark.xdist_group("offset")
def test_a_search_that_may_add_nothing_says_that_something_is_left(offset_case):
    fit, held_out = recordings_of(offset_case)
    found = jaxid.discover(jaxid.scara(), fit, held_out, most=0, progress=False)
    assert found.unfinished
    assert len(found.steps) == 1
    assert found.verdict == "undetermined"
    assert "stopped at the limit of 0 effects" in found.reason
    assert "lacks an effect, but none was to be added" in found.sentence


def test_effects_share_the_sharpness_that_is_estimated_for_their_joint():
    worn = Stribeck(1, 0.0, 0.02, smoothing=0.2)
    loop = jaxid.emps().with_values(eps1=8e-5).add(worn)
    assert float(of_one_sign(loop).effects[-1].smoothing) == pytest.approx(8e-5)
    halfway = of_one_sign(loop, share=0.5).effects[-1].smoothing
    assert float(halfway) == pytest.approx((0.2 + 8e-5) / 2)
    # What a user has freed, or never asked to estimate, is the user's.
    freed = loop.free("eps1_2")
    assert float(of_one_sign(freed).effects[-1].smoothing) == 0.2
    held = jaxid.scara().add(worn)
    assert float(of_one_sign(held).effects[-1].smoothing) == 0.2


@pytest.mark.slow
def test_two_large_effects_are_fitted_one_after_the_other():
    """A fit of both at once, from their predicted values, does not converge."""
    ripple = fx.TorqueRipple(1, -0.093813, -0.221357, 4.0)
    tilt = fx.Gravity(0.0, 0.2, 0.369468)
    case = sim.make_case(1365823038, [ripple, tilt], noise="moderate", robot="two_link")
    found = jaxid.discover(two_link_of(case), *recordings_of(case), progress=False)
    assert {a["effect"] for a in found.to_dict()["added"]} == {"gravity", "torque_ripple"}
    assert found.verdict == "explained"


@pytest.mark.parametrize("left", [None, 3.0, 1.1])
def test_an_effect_that_a_curve_replaces_is_not_part_of_the_answer(left, monkeypatch):
    """The best model is a curve with one of two effects: the answer has that effect only, even if
    it was never fitted alone, unless the other effect explains as much as the curve.
    """
    spring, stribeck = Spring(joint=1), Stribeck(joint=2)
    search = object.__new__(Search)
    search.asked = SimpleNamespace(most=5)
    errors = [None if left is None else np.array([0.5, x]) for x in (left, 1.0, 5.0)]
    search.at = Model((spring, stribeck), score=-50.0, left=errors[0])
    search.visited = Visited()
    noise = SimpleNamespace(floor_percent=lambda: np.array([0.5, 1.0]))
    search.diagnoses = {search.at.key: noise}
    curve = jaxid.effects.Curve(joint=2, coordinate="tau", of=2)
    alone = Model((Spring(joint=1, stiffness=3.0),), score=-90.0, curve=curve, beyond=2)
    search.visited.add(dataclasses.replace(alone, left=errors[1]))
    asked = []

    def refitted(at, effects):
        asked.append(effects)
        return Model(tuple(effects), -30.0, left=errors[2])

    search.refitted = refitted
    # Nothing has been fitted here.
    monkeypatch.setattr("jaxid.discovery.search.without_loose", lambda search, at: None)
    if left == 1.1:
        assert search._verdict([], 0.0) == ("explained", False)
        assert len(search.at.effects) == 2
        return
    assert search._verdict([], 0.0) == ("outside_catalogue", False)
    assert asked == [[spring]]
    assert search.at.effects[0] is spring


def candidate(score: float, *effects) -> Candidate:
    found = object.__new__(Candidate)
    for name, value in (("effects", effects), ("score", score), ("curve", None)):
        object.__setattr__(found, name, value)
    return found


def test_sets_without_determined_values_do_not_hide_a_curve(monkeypatch):
    """Two ripples and a drag are predicted to explain more than a curve does."""
    monkeypatch.setattr("jaxid.discovery.search.without_loose", lambda search, at: None)
    search = object.__new__(Search)
    search.asked, search.visited = SimpleNamespace(most=5), Visited()
    search.at = Model((), 0.0)
    pair, more = (TorqueRipple(2), TorqueRipple(2, 0.1)), QuadraticDrag(1)
    curve = candidate(-200.0)
    object.__setattr__(curve, "curve", jaxid.effects.Curve(joint=2, coordinate="q", of=2))
    sets = [candidate(-300.0, *pair), candidate(-290.0, *pair, more), curve, candidate(0.0)]
    assert search._verdict(sets, 0.0) == ("adequate", False)
    search.loose = frozenset({sets[0].key})
    assert search._verdict(sets, 0.0) == ("outside_catalogue", False)
    # A set whose values are determined is no approximation of a curve.
    assert search._verdict([candidate(-250.0, more), *sets], 0.0) == ("adequate", False)


def test_sets_with_unsupported_effects_do_not_hide_a_supported_one(monkeypatch):
    """A pair whose second effect fits one stretch is skipped, and the best other set is fitted."""
    search = object.__new__(Search)
    search._supported = lambda c: not any(isinstance(e, RotorInertia) for e in c.effects)
    stribeck, drag, unsupported = Stribeck(1, 0.2, 0.1), QuadraticDrag(1), RotorInertia(1)
    sets = [
        candidate(-300.0, stribeck, unsupported),
        candidate(-290.0, drag, unsupported),
        candidate(-200.0, stribeck),
        candidate(-199.0, drag, stribeck),
        candidate(-190.0, TorqueOffset(1)),
        candidate(-150.0, Spring(1)),
    ]
    monkeypatch.setattr("jaxid.discovery.search._lost", lambda model, at: model.score > at.score)
    fitted = Model((), 0.0)
    search._fitted = lambda at, c, *_: fitted
    # A superset of a better one is left out, and so is what is far behind.
    assert search._best_fitted(fitted, sets, 0.0) == [(fitted, sets[2]), (fitted, sets[4])]
    assert search._best_fitted(fitted, sets[:2], 0.0) == []
    # A set that cannot be fitted does not hide others.
    search._fitted = lambda at, c, *_: None if c is sets[2] else fitted
    assert search._best_fitted(fitted, sets, 0.0) == [(fitted, sets[3]), (fitted, sets[4])]
    worse = Model((), 1.0)
    search._fitted = lambda at, c, *_: worse if c is sets[2] else fitted
    assert search._best_fitted(fitted, sets, 0.0) == [(fitted, sets[3]), (fitted, sets[4])]


@pytest.mark.xdist_group("offset")
def test_a_fit_that_does_not_converge_and_is_worse_has_lost_its_minimum(offset_story):
    fit = offset_story[0].fit
    stopped = dataclasses.replace(fit, status=jaxid.Status.max_steps)
    at = Model((), 0.0, fit=fit)
    assert _lost(Model((), 1.0, fit=stopped), at)
    assert not _lost(Model((), 1.0, fit=fit), at)
    assert not _lost(Model((), -1.0, fit=stopped), at)


@pytest.mark.slow
def test_a_filter_does_not_hide_a_wrong_initial_state():
    """An eccentric encoder starts beside the reference; a filter ignores rows after the start."""
    case = sim.make_case(1554, [fx.EncoderEccentricity(2, 0.09, 4.66)], noise="white")
    refits = Refits(recordings_of(case)[0], jaxid.OEM())
    loop = jaxid.scara().add(EncoderEccentricity(joint=2))
    white = refits.first(loop)
    slow = np.array([0.149, 0.1035, 0.0783, 0.062, 0.0445, 0.0405, 0.0444, 0.0648])
    powers = np.var(white.residuals[0], axis=0).tolist()
    noise = (ARFilter(np.zeros(0), powers[0]), ARFilter(-slow, powers[1]))
    ignored = jaxid.fit(white.loop, refits.recordings, SeparablePEM(refits.given(), filters=noise))
    for r in ignored.residuals:
        assert np.sqrt(np.mean(r[:8, 1] ** 2)) > 3 * np.std(r[50:, 1])
    found = refits.filtered(white.loop, noise)
    for r in found.residuals:
        assert np.sqrt(np.mean(r[:8, 1] ** 2)) < 2 * np.std(r[50:, 1])
    np.testing.assert_allclose(found.error_percent, white.error_percent, rtol=0.01)


@pytest.mark.xdist_group("offset")
def test_filters_do_not_take_an_error_of_the_model_for_noise(offset_case, offset_story):
    """If a joint's error is much larger than before, the fit is repeated without filters."""
    start = offset_story[0].steps[0].fit
    refits = Refits(recordings_of(offset_case)[0], jaxid.OEM())
    error = over_recordings(start.error_percent.to_numpy())
    noise = tuple(ARFilter(np.array([-0.97]), 1e-4) for _ in range(2))
    filtered, plain = refits.filtered(start.loop, noise), refits.unfiltered(start.loop, noise)
    assert not np.allclose(filtered.theta, plain.theta, rtol=1e-3)
    same = dataclasses.replace(refits, before=error).filtered(start.loop, noise)
    np.testing.assert_allclose(same.theta, filtered.theta, rtol=1e-9)
    again = dataclasses.replace(refits, before=error / 2).filtered(start.loop, noise)
    np.testing.assert_allclose(again.theta, plain.theta, rtol=1e-9)


@pytest.mark.xdist_group("offset")
def test_a_model_that_is_fitted_again_from_other_values_is_another_piece(
    offset_story, tmp_path, monkeypatch
):
    found, asked = offset_story[0].fit, []
    monkeypatch.setattr(Refits, "filtered", lambda _, loop, noise: asked.append(loop) or found)
    monkeypatch.setattr(Refits, "best", lambda _, fits: fits[0])
    with Campaign(tmp_path / "steps", {}) as campaign:
        fits = Fits(Refits(found.recordings, jaxid.OEM()), campaign)
        for factor in (1.0, 1.0, 1.1):
            loop = found.loop.with_theta(factor * found.loop.theta)
            fits.exchanged(loop, loop.effects[-1:], loop.effects[-1:], ())
    assert len(asked) == 2
