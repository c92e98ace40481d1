"""What must speak for a model before a verdict sounds sure."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from stories import recordings_of

import jaxid
from jaxid.control import Sampled, Tracking
from jaxid.discovery import verdict
from jaxid.discovery.floor import Floor
from jaxid.discovery.held_out import one_raised
from jaxid.discovery.models import Model
from jaxid.discovery.remarks import looks_sampled
from jaxid.discovery.undecided import undecided
from jaxid.discovery.verdict import (
    _chance,
    _mean_square,
    _power,
    _spread,
    indefinite,
    on_unseen,
    refuted,
)
from jaxid.discovery.verify import Refits
from jaxid.effects import Spring, TimeDelay, TorqueOffset, TorqueRipple
from jaxid.noise import ARFilter
from jaxid.report._head import values

pytestmark = pytest.mark.xdist_group("offset")
WORTH = 0.05


@pytest.fixture(scope="module")
def found(offset_story):
    return offset_story[0]


def asked(story, fit=None, both=None, worth=WORTH) -> str:
    fit = story.fit if fit is None else fit
    diagnosis = story.diagnosis
    return refuted(fit, diagnosis.noise, diagnosis, both, worth)


def louder(record: jaxid.Recording, joint: int, share: float) -> jaxid.Recording:
    """The recording with a slow torque more, as large as a share of the torque's."""
    slow = np.sin(2 * np.pi * 0.4 * record.time)
    size = share * np.sqrt(2 * np.mean(record.tau[:, joint - 1] ** 2))
    tau = record.tau.copy()
    tau[:, joint - 1] += size * slow
    return dataclasses.replace(record, tau=tau)


def test_a_true_model_is_not_refuted(found):
    first, last = found.steps[0].held_out, found.steps[-1].held_out
    assert asked(found, both=(first, last)) == ""
    assert found.verdict == "explained"
    assert found.reason == ""


def test_held_out_recordings_above_the_noise_refute(found, offset_case):
    held_out = recordings_of(offset_case)[1]
    record = louder(held_out[0], 2, 0.2)
    after = jaxid.compare(found.fit, record)
    said = asked(found, both=(after, after))
    assert f"held-out recording {record.name}" in said
    assert "of joint 2" in said
    # What the user does not find worth knowing refutes nothing.
    assert asked(found, both=(after, after), worth=50.0) == ""
    # Neither does what unsure parameters may do there.
    unsure = dataclasses.replace(found.fit, covariance=1e6 * found.fit.covariance)
    assert asked(found, unsure, (after, after)) == ""


def test_an_addition_that_raises_the_held_out_error_is_refuted(found):
    first, last = found.steps[0].held_out, found.steps[-1].held_out
    said = asked(found, both=(last, first))
    assert "raised the error of joint" in said


def test_one_addition_that_raises_the_held_out_error_is_named(found):
    first, last = found.steps[0], found.steps[-1]
    # The comparisons changed places: the added effect then raises the error.
    before = dataclasses.replace(first, held_out=last.held_out)
    noise = found.diagnosis.noise
    seen = on_unseen(last.held_out, first.held_out, noise, WORTH)
    step = dataclasses.replace(last, held_out=first.held_out, unseen=seen)
    said = one_raised([before, step], noise, WORTH)
    error = first.held_out.error_percent.to_numpy().max()
    assert said.startswith(f"torque_offset on joint {last.added.joint} raised the error of joint ")
    assert f"to {error:.3g} %" in said
    for unseen in ("mixed", "lowers"):
        spared = dataclasses.replace(step, unseen=unseen)
        assert one_raised([before, spared], noise, WORTH) == ""


def test_what_held_out_recordings_say_of_an_effect_is_told(found):
    step, noise = found.steps[-1], found.diagnosis.noise
    first, last = found.steps[0].held_out, step.held_out
    assert step.unseen == on_unseen(first, last, noise, WORTH) == "lowers"
    assert "confirmed by held-out recordings): " in " ".join(repr(found).split())
    assert on_unseen(last, last, noise, WORTH) == "unchanged"
    refuted = dataclasses.replace(step, unseen=on_unseen(last, first, noise, WORTH))
    story = dataclasses.replace(found, steps=(found.steps[0], refuted))
    # No probability is given beside recordings that speak against the effect.
    assert "(refuted: raises the error on held-out recordings)" in story.sentence
    assert "probability" not in story.sentence
    assert story.to_dict()["added"][0]["held_out"] == "raises"


def test_an_undecided_search_tells_what_its_best_model_gains_on_held_out_recordings(found):
    start, last = found.steps[0], found.steps[-1]
    story = dataclasses.replace(found, verdict="undetermined", reason="a test fails")
    before, after = (s.held_out.error_percent.to_numpy()[0, 1] for s in (start, last))
    gain = f"from {before:.3g} to {after:.3g} %, but a test fails."
    assert f" and lowers the error of joint 2 on held-out recordings {gain}" in story.sentence
    without = tuple(dataclasses.replace(s, held_out=None) for s in found.steps)
    for steps in ((last, last), without):
        assert "lowers the error" not in dataclasses.replace(story, steps=steps).sentence


def test_no_probability_is_given_if_no_examined_model_passes_the_tests(found):
    step = dataclasses.replace(found.steps[-1], probability=None)
    story = dataclasses.replace(
        found, verdict="undetermined", reason="a test fails", steps=(found.steps[0], step)
    )
    assert "the best model adds torque offset on joint 2 and lowers" in story.sentence
    text = " ".join(repr(story).split())
    assert "torque_offset on joint 2 (confirmed by held-out recordings): level" in text
    assert "no probabilities are given" in text
    assert "no probabilities are given" not in repr(found)
    assert story.to_dict()["added"][0]["probability"] is None
    page = str(values(story))
    assert "(confirmed by held-out recordings): " in page
    assert "probability" not in page


def test_an_effect_that_lowers_one_error_and_raises_another_is_neither(found, offset_case):
    first, noise = found.steps[0].held_out, found.diagnosis.noise
    # The effect lowers the error of joint 2, and a torque is added to joint 1.
    after = jaxid.compare(found.fit, louder(recordings_of(offset_case)[1][0], 1, 0.2))
    assert on_unseen(first, after, noise, WORTH) == "mixed"
    step = dataclasses.replace(found.steps[-1], unseen="mixed")
    assert "raises others" in step.belief()
    assert "others" not in step.belief(tested=False)


def test_a_fit_that_failed_is_no_verdict(found):
    status = jaxid.Status.misfit
    assert "check the units" in asked(found, dataclasses.replace(found.fit, status=status))
    status = jaxid.Status.max_steps
    assert "did not converge" in asked(found, dataclasses.replace(found.fit, status=status))


def test_an_effect_without_a_determined_value_is_no_answer(found):
    assert indefinite(found.fit, 1) == ""
    loose = dataclasses.replace(found.fit, covariance=1e12 * found.fit.covariance)
    assert "determine no value of torque_offset on joint 2, although" in indefinite(loose, 1)


def test_what_noise_does_not_account_for_is_no_verdict(found):
    start = found.steps[0]
    # The starting model lacks the offset, and its floor knows.
    said = refuted(start.fit, start.diagnosis.noise, start.diagnosis, None, WORTH)
    assert "neither the catalogue nor a curve" in said
    assert "of joint 2" in said


def test_a_further_effect_that_is_probable_is_undecided(offset_story):
    fit = offset_story[0].fit
    offset, spring = TorqueOffset(joint=2), Spring(joint=1)
    start, chosen = Model((), 0.0), Model((offset,), -50.0, fit=fit)
    more = Model((offset, spring), -55.0, fit=fit)
    said = undecided([more, chosen, start], chosen, {}, WORTH)
    assert "a further effect have a probability of 0.924, most of all spring on joint 1" in said
    # Not if it was only predicted, or if it is worse.
    assert undecided([dataclasses.replace(more, fit=None), chosen, start], chosen, {}, WORTH) == ""
    worse = dataclasses.replace(more, score=-49.0)
    assert undecided([chosen, worse, start], chosen, {}, WORTH) == ""
    # Nor if it raises the error on held-out recordings.
    first, last = (offset_story[0].steps[k] for k in (0, -1))
    noise = last.diagnosis.noise
    chosen, more = (
        dataclasses.replace(m, noise=noise, held_out=step.held_out)
        for m, step in ((chosen, last), (more, first))
    )
    assert undecided([more, chosen, start], chosen, {}, WORTH) == ""
    more = dataclasses.replace(more, held_out=last.held_out)
    assert undecided([more, chosen, start], chosen, {}, WORTH) == said


def test_a_start_that_shares_the_weight_is_undecided():
    start, rival = Model((), 100.0), Model((TorqueOffset(joint=2),), 98.0)
    models = [dataclasses.replace(rival, weight=0.73), dataclasses.replace(start, weight=0.27)]
    assert "only 2 larger" in undecided(models, rival, {}, WORTH)
    sure = dataclasses.replace(rival, score=90.0)
    sure = dataclasses.replace(sure, weight=0.9)
    assert undecided([sure, start], sure, {}, WORTH) == ""
    # Models without the effect have more weight, unless their effect is indistinguishable.
    other = Model((Spring(joint=1),), 80.0, weight=0.99)
    models = [other, dataclasses.replace(sure, weight=0.01), start]
    said = undecided(models, sure, {}, WORTH)
    assert "without torque_offset on joint 2 have a probability of 0.99" in said
    assert "spring on joint 1" in said
    assert undecided(models, sure, {("torque_offset", 2): [("spring", 1)]}, WORTH) == ""
    alone = [dataclasses.replace(start, weight=0.9), dataclasses.replace(rival, weight=0.1)]
    assert undecided(alone, alone[0], {}, WORTH) == ""
    crowd = [dataclasses.replace(start, weight=0.4), Model((Spring(joint=1),), 101, weight=0.3)]
    assert "spring on joint 1" in undecided(crowd, crowd[0], {}, WORTH)


def test_a_fit_that_leaves_a_third_says_what_to_check(found):
    fit, diagnosis = found.fit, found.diagnosis
    poor = dataclasses.replace(fit, error_percent=40 + 0 * fit.error_percent)
    slow = [ARFilter(np.array([-0.99]), 1.0)] * 2
    assert "check the units" in refuted(poor, slow, diagnosis, None, WORTH)
    # White noise may be as loud.
    white = [ARFilter(np.zeros(0), 1.0)] * 2
    assert "check the units" not in refuted(poor, white, diagnosis, None, WORTH)


def test_torque_and_motion_apart_in_time_are_named_with_the_delay(found):
    fit, diagnosis, late = found.fit, found.diagnosis, 0.02
    time, torque = np.asarray(diagnosis.motion.t), np.asarray(diagnosis.motion.tau)
    rate = np.gradient(torque[..., 1], float(time[0, 1] - time[0, 0]), axis=1)
    residual = diagnosis.data.residual.copy()
    residual[..., 1] += late * rate * diagnosis.data.mask
    shifted = dataclasses.replace(
        diagnosis, data=dataclasses.replace(diagnosis.data, residual=residual)
    )
    said = refuted(fit, diagnosis.noise, shifted, None, WORTH)
    assert "the residual of joint 2" in said
    delay = 1e-3 * float(re.search(r"recorded ([\d.]+) ms before it acts", said)[1])
    assert delay == pytest.approx(late, rel=0.1)


def test_the_time_shift_of_one_torque_is_found_beside_the_delay_of_all(offset_case):
    """Torque of joint 2 logged 8 ms late, under an unknown law, whose delay is estimated too."""
    made = []
    for r in recordings_of(offset_case)[0]:
        tau = np.array(r.tau)
        tau[:, 1] = np.interp(r.time - 0.008, r.time, tau[:, 1])
        made.append(jaxid.Recording.from_arrays(r.time, r.q, tau, name=r.name))
    loop = jaxid.scara(Tracking()).add(TorqueOffset(joint=2))
    fit = jaxid.fit(loop, made, jaxid.OEM(progress=False))
    diagnosis = jaxid.diagnose(fit, catalogue=[Spring], progress=False)
    said = refuted(fit, diagnosis.noise, diagnosis, None, WORTH)
    # With two joints, one late torque is the same as a common delay and the other torque early.
    assert re.search(r"joint 1 .* before it acts|joint 2 .* after it acts", said)
    delay = re.search(r"relative to the other joints, its torque is recorded ([\d.]+) ms", said)[1]
    assert float(delay) == pytest.approx(8.0, rel=0.2)


def test_rows_that_are_not_compared_change_no_mean_square():
    rng = np.random.default_rng(3)
    rows = NOISE.simulate((4000,), rng)
    at_rest = np.where(np.arange(4000) % 2000 < 1500, 0.0, rows)
    moving = at_rest[at_rest != 0]
    assert _mean_square(at_rest[:, None]) == pytest.approx(np.mean(moving**2))
    assert _power(NOISE, at_rest) == pytest.approx(NOISE.gain * NOISE.variance, rel=0.25)
    assert _chance(NOISE, at_rest) == pytest.approx(2 * _chance(NOISE, rows), rel=0.01)


def test_a_drive_that_is_late_by_half_a_sample_looks_sampled(found):
    fit = found.fit
    half = fit.recordings.common_period() / 2
    late = fit.loop.add(TimeDelay(joint=2, delay=jnp.asarray(half)))
    (said,) = looks_sampled(dataclasses.replace(fit, loop=late))
    assert f"Sampled(law, every={2 * half:.4g})" in said
    assert "joint 2" in said
    fast = fit.loop.add(TimeDelay(joint=2, delay=jnp.asarray(half / 4)))
    (said,) = looks_sampled(dataclasses.replace(fit, loop=fast))
    assert f"sampled every {5e2 * half:.2g} ms" in said
    later = fit.loop.add(TimeDelay(joint=2, delay=jnp.asarray(8 * half)))
    assert looks_sampled(dataclasses.replace(fit, loop=later)) == []
    ticking = dataclasses.replace(late, controller=Sampled(late.controller, every=2 * half))
    assert looks_sampled(dataclasses.replace(fit, loop=ticking)) == []


NOISE = ARFilter(np.array([-1.6, 0.7]), 0.3)


def test_spread_of_a_mean_square_is_that_of_drawn_noise():
    rows = NOISE.simulate((2000, 600), np.random.default_rng(0))
    power = np.mean(rows**2, axis=1)
    assert _spread(NOISE, 600) == pytest.approx(power.std() / power.mean(), rel=0.1)


def test_power_of_noise_is_known_beside_slow_physics():
    rows = 3.0 * NOISE.simulate((50, 3000), np.random.default_rng(1))
    true = 9 * NOISE.variance * NOISE.gain
    slow = 20 * np.sin(np.arange(3000) * 0.01)
    found = np.array([_power(NOISE, row) for row in rows])
    assert found.mean() == pytest.approx(true, rel=0.02)
    assert found.std() / true == pytest.approx(2 / np.sqrt(3000), rel=0.3)
    assert _power(NOISE, rows[0] + slow) == pytest.approx(found[0], rel=0.1)


def test_variance_of_a_sum_with_noise_is_the_covariance():
    delta = np.cos(np.arange(200) * 0.1)
    lags = np.fft.ifft(NOISE.spectrum(4096)).real[:200]
    exact = delta @ scipy.linalg.toeplitz(lags) @ delta
    assert NOISE.product_variance(delta) == pytest.approx(exact, rel=0.01)


def test_the_table_of_models_tells_what_each_is_worth(found):
    table = found.models
    assert table["difference"].iloc[0] == 0
    assert table["score"].is_monotonic_increasing
    assert table["weight"].sum() == pytest.approx(1, abs=1e-6)
    assert set(table["model"]) >= {"start", found.considered[0].label}
    chosen = table.iloc[0]
    held = found.table().iloc[-1]
    assert chosen["held out, joint 2"] == pytest.approx(held["held out, joint 2"])
    told = found.to_dict()
    assert [m["model"] for m in told["models"]] == list(table["model"])
    assert 0.95 < told["added"][0]["probability"] <= 1


def test_another_model_of_the_table_can_be_chosen(found):
    predicted = [k for k, m in enumerate(found.considered) if m.fit is None]
    fit = found.choose(predicted[0])
    assert len(fit.loop.effects) == len(found.steps[0].fit.loop.effects) + 1
    left = np.sqrt(np.mean(fit.error_percent.to_numpy() ** 2, axis=0))
    assert left == pytest.approx(found.considered[predicted[0]].left, rel=0.05)
    assert found.choose("start") is found.steps[0].fit
    with pytest.raises(jaxid.errors.ModelError, match="no row 999"):
        found.choose(999)
    with pytest.raises(jaxid.errors.ModelError, match="no model 'no such'"):
        found.choose("no such")


def test_an_effect_that_is_there_twice_is_chosen_twice(found, monkeypatch):
    one, other = TorqueRipple(joint=1, harmonic=2.0), TorqueRipple(joint=1, harmonic=3.0)
    fit = found.fit
    both = Model((one, other), 1.0, beyond=1)
    table = (Model((one,), 0.0, fit=fit), both, Model((), 9.0, fit=fit))
    asked = []
    monkeypatch.setattr(
        Refits, "with_effects", lambda self, before, effects, noise: asked.extend(effects) or before
    )
    dataclasses.replace(found, considered=table).choose(1)
    assert asked == [other]


def test_the_held_out_floor_leaves_out_joints_with_coloured_noise_and_names_the_others(found):
    after = found.steps[-1].held_out
    left = after.error_percent.to_numpy()
    sources = (("above the motion",) * 2,) * len(left)
    floor = Floor(0.2 * left, 0.1 * left, 0.3 * left, sources)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdict, "floor_of", lambda *_: floor)
        slow = dataclasses.replace(
            floor, sources=(("unpredicted", "above the motion"),) * len(left)
        )
        kept = verdict._floor_of_unseen(found.fit, slow, after)
    assert "the error of joint 1" in verdict._above_measured(
        after, dataclasses.replace(floor, percent=0.2 * left * [0.5, 1.0]), WORTH
    )
    said = verdict._above_measured(after, kept, WORTH)
    assert "the error of joint 2" in said
    assert "nan" not in said
