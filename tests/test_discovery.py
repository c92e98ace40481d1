"""What is missing is found, on recordings of a simulator that shares no code with jaxid."""

import independent as sim
import jax.numpy as jnp
import numpy as np
import pytest
from independent import effects as fx
from stories import Bump, floor_of, recordings_of, with_chain

import jaxid
from jaxid.effects import TorqueOffset


@pytest.mark.xdist_group("bump")
def test_strange_effect_is_said_to_be_outside(bump_story):
    assert bump_story.verdict == "outside_catalogue"
    first = bump_story.to_dict()["depends_on"][0]
    assert (first["coordinate"], first["joint"]) == ("q2", 2)
    assert "joint 2" in bump_story.sentence


@pytest.mark.xdist_group("bump")
def test_curve_shows_the_bump_where_it_is(bump_case, bump_story):
    curve = bump_story.suggestion()
    grid = np.linspace(float(curve.low), float(curve.high), 400)
    values = np.array([float(curve.value(x)) for x in jnp.asarray(grid)])
    truth = bump_case.effects[0]
    assert isinstance(truth, fx.TorqueBump)
    # A knot's spacing is what a curve can resolve.
    spacing = (grid[-1] - grid[0]) / (curve.coefficients.shape[0] - 3)
    peak = grid[np.argmax(values * np.sign(truth.torque))]
    assert abs(peak - truth.angle) < spacing


@pytest.mark.xdist_group("bump")
def test_own_effect_reaches_the_noise_floor(bump_case, bump_story):
    fit, held_out = recordings_of(bump_case)
    curve = bump_story.suggestion()
    grid = np.linspace(float(curve.low), float(curve.high), 400)
    values = np.array([float(curve.value(x)) for x in jnp.asarray(grid)])
    place = grid[np.argmax(np.abs(values - np.median(values)))]
    mine = Bump(joint=2, height=0.02, place=place)
    fitted = jaxid.fit(bump_story.steps[0].fit.loop.add(mine), fit, jaxid.OEM(start="given"))
    after = jaxid.compare(fitted, held_out).error_percent.to_numpy()[0]
    # 20 parameters among 4800 numbers, and a recording not fitted: 3 % above the floor.
    assert np.all(after <= 1.03 * floor_of(bump_case))


@pytest.mark.xdist_group("bump")
def test_curve_can_be_added_like_any_effect(bump_case, bump_story):
    fit, held_out = recordings_of(bump_case)
    loop = bump_story.steps[0].fit.loop.add(bump_story.suggestion())
    fitted = jaxid.fit(loop, fit, jaxid.OEM(start="given"))
    before = bump_story.steps[0].held_out.error_percent.to_numpy()[0, 1]
    after = jaxid.compare(fitted, held_out).error_percent.to_numpy()[0, 1]
    floor = floor_of(bump_case)[1]
    assert after - floor < 0.3 * (before - floor)


@pytest.mark.xdist_group("offset")
def test_missing_effect_is_found_added_and_leaves_the_floor(offset_case, offset_story):
    story, _ = offset_story
    told = story.to_dict()
    assert told["verdict"] == "explained"
    named = [(a["effect"], a["joint"]) for a in told["added"]]
    groups = [(g["effect"], g["joint"]) for a in told["added"] for g in a["indistinguishable"]]
    assert ("torque_offset", 2) in named + groups
    after = np.asarray(told["error_percent"]["after"]["validate"])
    assert np.all(after <= 1.03 * floor_of(offset_case))
    before = np.asarray(told["error_percent"]["before"]["validate"])
    assert before[1] > after[1]


@pytest.mark.xdist_group("offset")
def test_interrupted_discovery_ends_as_an_undisturbed_one(offset_case, offset_story):
    story, journal = offset_story
    # As if it had been killed after the starting model was done.
    for piece in journal.glob("with_*.piece"):
        piece.unlink()
    kept = {piece: piece.stat().st_mtime_ns for piece in journal.glob("*.piece")}
    assert len(kept) == 2
    fit, held_out = recordings_of(offset_case)
    again = jaxid.discover(jaxid.scara(), fit, held_out, resume=journal, progress=False)
    assert {piece: piece.stat().st_mtime_ns for piece in kept} == kept
    assert again.fit.theta.tobytes() == story.fit.theta.tobytes()
    one, other = again.to_dict(), story.to_dict()
    assert {**one, "seconds": 0} == {**other, "seconds": 0}


@pytest.mark.xdist_group("offset")
def test_steps_of_other_work_are_refused(offset_case, offset_story):
    _, journal = offset_story
    fit, held_out = recordings_of(offset_case)
    with pytest.raises(jaxid.errors.SaveError, match=r"another computation \(different: search\)"):
        jaxid.discover(jaxid.scara(), fit[:1], held_out, resume=journal, progress=False)
    with pytest.raises(jaxid.errors.SaveError, match=r"another computation \(different: search\)"):
        jaxid.discover(jaxid.scara(), fit, held_out, most=2, resume=journal, progress=False)


def test_recordings_of_different_rates_share_no_noise_filter():
    def at(rate):
        time = np.arange(0, 4, 1 / rate)
        q = np.stack([np.sin(2 * time), np.sin(3 * time)], axis=1)
        return jaxid.Recording(time, q, q, q_ref=q, name=f"at {rate}")

    both = [at(100), at(200)]
    for method in (jaxid.SeparablePEM(), jaxid.JointPEM()):
        with pytest.raises(
            jaxid.errors.RecordingError, match="a noise filter is valid for one rate"
        ):
            jaxid.fit(jaxid.scara(), both, method)
    with pytest.raises(jaxid.errors.RecordingError, match="200 samples per second"):
        jaxid.discover(jaxid.scara(), both[0], both[1], progress=False)
    with pytest.raises(jaxid.errors.RecordingError, match="200 samples per second"):
        jaxid.diagnose(jaxid.compare(jaxid.scara(), both), progress=False)


def test_a_search_that_was_told_to_stop_is_undetermined():
    """Of two offsets it may add one, and the fit of that one passes all other tests."""
    offsets = [fx.TorqueOffset(joint=j, torque=0.05) for j in (1, 2)]
    case = sim.make_case(8, effects=offsets, noise="white", duration=8.0)
    fit, held_out = recordings_of(case)
    arguments = {"catalogue": [TorqueOffset], "progress": False}
    found = jaxid.discover(jaxid.scara(), fit, held_out, most=1, **arguments)
    assert found.unfinished
    assert found.verdict == "undetermined"
    assert "the search stopped at the limit of 1 effect: raise most" in found.reason
    assert len(found.steps) == 2


@pytest.mark.xdist_group("offset")
def test_the_recording_that_an_effect_is_on_is_named(offset_case, offset_story):
    start = offset_story[0].steps[0]
    verdict = next(v for v in start.diagnosis.ranking if v.key == ("payload", None))
    payload = start.diagnosis.predicted(verdict)
    (name,) = payload.recordings
    shown = start.diagnosis.table().set_index("effect").loc["payload", "amplitude"]
    assert shown.endswith(f" kg in {name}")
    steps = with_chain(offset_case, start, payload)
    story = jaxid.Discovery("explained", tuple(steps))
    assert f"The model lacked payload in {name} (probability " in story.sentence
    assert f"payload in {name} (probability" in repr(story)
    assert story.to_dict()["added"][0]["recordings"] == [name]


def test_clean_recordings_are_adequate():
    fit, held_out = recordings_of(sim.make_case(12, effects=[], noise="moderate", duration=12.0))
    story = jaxid.discover(jaxid.scara(), fit, held_out, progress=False)
    assert story.verdict == "adequate"
    assert not story.to_dict()["added"]


def test_a_discovery_compares_what_the_loop_is_judged_by():
    time = np.arange(100) * 0.01
    q = np.stack([np.sin(time), np.cos(time)], axis=1)
    record = jaxid.Recording(time, q, q, q_ref=q)
    for output in ("position", "both"):
        with pytest.raises(jaxid.errors.FitError, match="leave out output"):
            jaxid.discover(jaxid.scara(), record, method=jaxid.OEM(output=output), progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("case", [f"case_{k:02d}" for k in range(1, 9)])
def test_hidden_effects(shared_file, case):
    """The eight published cases: verdict, effects and joints, error on the held-out recording."""
    import json

    truth = json.loads(shared_file("hidden_effects/truth.json").read_text())[case]
    folder = shared_file(f"hidden_effects/{case}")
    fit = jaxid.read(folder / "fit_1.csv", folder / "fit_2.csv")
    held_out = jaxid.read(folder / "held_out.csv")
    told = jaxid.discover(jaxid.scara(), fit, held_out, progress=False).to_dict()
    wanted = [(e["effect"], e["joint"]) for e in truth["effects"]]
    assert told["verdict"] == ("explained" if wanted else "adequate")
    assert len(told["added"]) == len(wanted)
    for added in told["added"]:
        group = [added, *added["indistinguishable"]]
        assert any((g["effect"], g["joint"]) in wanted for g in group)
    after = np.asarray(told["error_percent"]["after"]["validate"])
    floor = np.asarray(truth["noise_floor_percent"]["held_out"])
    # Gravity reaches further on case_07's held-out recording than on those fitted, and even with
    # the true structure its estimate there is good to 1 %: 5 % above the floor.
    assert np.all(after <= (1.06 if case == "case_07" else 1.03) * floor)
