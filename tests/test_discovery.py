"""What is missing is found, on recordings of a simulator that shares no code with jaxid."""

import dataclasses
import sys

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from independent import effects as fx

import jaxid
from jaxid.discovery.score import corrected, effective_tests
from jaxid.discovery.search import _doubled, _entries, _of_one_sign, _released, _rivals, _Search
from jaxid.discovery.signatures import candidates, survey
from jaxid.discovery.story import Contender, Step
from jaxid.effects import (
    AbstractEffect,
    Backlash,
    Curve,
    JointElasticity,
    Motion,
    QuadraticDrag,
    Spring,
    Stribeck,
    TorqueOffset,
    on_joint,
)
from jaxid.parameters import Scalar, parameter


def recordings_of(case: sim.Case) -> tuple[jaxid.Recordings, jaxid.Recordings]:
    made = {
        name: jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name=name)
        for name, r in case.recordings.items()
    }
    fit = jaxid.Recordings.of([made["fit_1"], made["fit_2"]])
    return fit, jaxid.Recordings.of(made["held_out"])


def floor_of(case: sim.Case, name: str = "held_out") -> np.ndarray:
    return np.asarray(case.recordings[name]["noise_floor_percent"])


class Bump(AbstractEffect):
    """A torque around one angle: height exp(-((q - place) / width)²)."""

    joint: int = eqx.field(static=True)
    height: Scalar = parameter(0.0, symbol="h", unit="N·m", scale=0.1)
    place: Scalar = parameter(0.0, symbol="place", unit="rad", scale=0.1, linear=False)
    width: Scalar = parameter(0.2, symbol="w", unit="rad", lower=0.01, scale=0.1, linear=False)

    def torque(self, motion: Motion):
        distance = (motion.q[self.joint - 1] - self.place) / self.width
        return on_joint(self.joint, self.height * jnp.exp(-(distance**2)), motion)


BUMP = fx.TorqueBump(joint=2, torque=0.06, angle=0.5, width=0.25)


@pytest.fixture(scope="session")
def bump_case() -> sim.Case:
    return sim.make_case(31, effects=[BUMP], noise="moderate", multiple=6.0, duration=12.0)


@pytest.fixture(scope="session")
def bump_story(bump_case) -> jaxid.Discovery:
    fit, held_out = recordings_of(bump_case)
    return jaxid.discover(jaxid.scara(), fit, held_out, progress=False)


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


@pytest.mark.xdist_group("bump")
def test_own_effect_is_screened_like_the_rest(bump_story):
    class AtHalf(Bump):
        @classmethod
        def screened(cls, scene):
            return [
                cls(joint=j, place=x, width=0.25)
                for j in scene.joints
                for x in np.linspace(scene.q_low[j - 1], scene.q_high[j - 1], 12)
            ]

    diagnosis = jaxid.diagnose(
        bump_story.steps[0].fit, catalogue=(*jaxid.catalogue, AtHalf), progress=False
    )
    best = diagnosis.ranking[0]
    assert (best.hypothesis.name, best.hypothesis.joint) == ("at_half", 2)
    assert diagnosis.best.place == best.hypothesis.effect.place


@pytest.mark.xdist_group("bump")
def test_results_show_themselves(bump_story):
    diagnosis = bump_story.steps[0].diagnosis
    assert {"effect", "joint", "p_value", "amplitude"} <= set(diagnosis.table().columns)
    assert diagnosis.where_table().iloc[0]["coordinate"] == "q2"
    # A story keeps the signatures of its rankings alone; those of all curves are far more.
    assert diagnosis.data.table.shape[-1] < 0.5 * len(diagnosis.gram.score)
    with pytest.raises(jaxid.errors.FitError, match="diagnose"):
        diagnosis.predicted_error(diagnosis.where[0])
    for figure in (
        diagnosis.plot(),
        diagnosis.plot_where(),
        diagnosis.plot_shares(joint=2),
        bump_story.plot(),
    ):
        assert any(axis.title.text for axis in figure.select_xaxes())
    assert "position of joint 2" in bump_story._repr_html_()


@pytest.fixture(scope="session")
def offset_case() -> sim.Case:
    return sim.make_case(
        7, effects=[fx.TorqueOffset(joint=2, torque=0.03)], noise="strong", duration=12.0
    )


@pytest.fixture(scope="session")
def offset_story(offset_case, tmp_path_factory):
    fit, held_out = recordings_of(offset_case)
    journal = tmp_path_factory.mktemp("journal") / "steps"
    story = jaxid.discover(jaxid.scara(), fit, held_out, resume=journal, progress=False)
    return story, journal


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
def test_predicted_error_is_the_one_that_adding_leaves(offset_story):
    story, _ = offset_story
    start = story.steps[0].diagnosis
    predicted = start.predicted_error(start.ranking[0])
    np.testing.assert_allclose(predicted, story.to_dict()["error_percent"]["after"]["fit"], 0.02)
    assert story.table().iloc[0, 1] > 1.1 * predicted[1]


@pytest.mark.xdist_group("offset")
def test_interrupted_discovery_ends_as_an_undisturbed_one(offset_case, offset_story):
    story, journal = offset_story
    # As if it had been killed after the starting model was done.
    for piece in journal.glob("turn_*.piece"):
        piece.unlink()
    kept = {piece: piece.stat().st_mtime_ns for piece in journal.glob("*.piece")}
    assert len(kept) == 1
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
    with pytest.raises(jaxid.errors.SaveError, match=r"other work \(not the same: search\)"):
        jaxid.discover(jaxid.scara(), fit[:1], held_out, resume=journal, progress=False)
    with pytest.raises(jaxid.errors.SaveError, match=r"other work \(not the same: most\)"):
        jaxid.discover(jaxid.scara(), fit, held_out, most=2, resume=journal, progress=False)


def with_chain(search: _Search, start: Step, *effects: AbstractEffect) -> list[Step]:
    """The starting step, and one more for each effect, all in the last one's loop."""
    steps = [start]
    for effect in effects:
        loop = steps[-1].fit.loop.add(effect)
        fitted = jaxid.fit(loop, search.recordings, search.whitened_method(start.diagnosis))
        added = fitted.loop.effects[-1]
        steps.append(dataclasses.replace(start, label="+", fit=fitted, added=added))
    return steps


def search_of(case: sim.Case) -> _Search:
    return _Search(*recordings_of(case), jaxid.catalogue, jaxid.OEM(), 0.01, False)


def silent(*_: object) -> None:
    """Says nothing."""


@pytest.mark.xdist_group("offset")
def test_superfluous_effect_is_taken_out_and_a_needed_one_stays(offset_case, offset_story):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    offset, drag = TorqueOffset(joint=2), QuadraticDrag(joint=1)
    left, removed = search.prune(with_chain(search, start, drag, offset), silent)
    assert removed == (("quadratic_drag", 1),)
    assert [s.added.effect_name() for s in left[1:]] == ["torque_offset"]
    assert "drag" not in repr(left[-1].fit.loop)
    left, removed = search.prune(with_chain(search, start, offset, drag), silent)
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
    monkeypatch.setattr(_Search, "step", step)
    monkeypatch.setattr(_Search, "grown", grown)
    spring, drag = Spring(joint=2), QuadraticDrag(joint=1)
    steps = with_chain(search, start, spring, drag)
    fits = steps[1].fit, with_chain(search, start, TorqueOffset(joint=2))[1].fit
    contenders = tuple(
        Contender(name, 2, fitted, search.criterion(fitted, start.diagnosis))
        for name, fitted in zip(("spring", "torque_offset"), fits, strict=True)
    )
    steps[1] = dataclasses.replace(steps[1], contenders=contenders)
    left, removed = search.prune(steps, silent)
    # The drag, last and never needed, goes once the offset has come.
    assert removed == (("quadratic_drag", 1),)
    assert [s.added.effect_name() for s in left[1:]] == ["torque_offset"]
    assert type(left[-1].fit.loop.effects[-1]) is TorqueOffset
    # Not the other way round: a spring has more to adjust than an offset.
    assert _rivals(dataclasses.replace(left[1], contenders=contenders[::-1])) == []


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

    monkeypatch.setattr(_Search, "refit", refit)
    monkeypatch.setattr(_Search, "grown", grown)
    monkeypatch.setattr(
        _Search, "criterion", lambda self, fit, _: value.get("".join(fit.notes[-1:]), 10.0)
    )
    assert search.afresh(steps, silent).contenders == (found[1],)
    # All of them, from the starting model.
    kinds = ("joint_elasticity", "backlash")
    assert sorted(tried) == sorted((kind, joint) for kind in kinds for joint in (1, 2))
    value["good"] = 11.0
    assert search.afresh(steps, silent) is None


def test_contact_is_released_from_several_stiffnesses():
    loop = jaxid.scara().add(Backlash(joint=2, gap=0.01, stiffness=200.0, damping=2.0))
    released = _released(loop, ("kc2", "dk2"))
    values = [dict(zip(r.names, np.asarray(r.theta), strict=True)) for r in released]
    assert [(v["kc2"], v["dk2"]) for v in values] == [
        (200.0, 2.0),
        (100.0, 2.0),
        (400.0, 2.0),
        (200.0, 1.0),
        (200.0, 4.0),
    ]
    assert _released(loop, ()) == []


def fits_replaced(monkeypatch, result: jaxid.Fit) -> list:
    """Loops and methods that a discovery fits from now on, each with this result."""
    calls = []

    def fit(loop, recordings, method):
        calls.append((loop, method))
        return dataclasses.replace(result, loop=loop)

    monkeypatch.setattr(sys.modules["jaxid.discovery.search"], "fit", fit)
    return calls


@pytest.mark.xdist_group("offset")
def test_contact_is_free_from_the_start_in_some_refits(offset_case, offset_story, monkeypatch):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    calls = fits_replaced(monkeypatch, start.fit)
    of = {v.key: v for v in start.diagnosis.ranking}
    screened = of["backlash", 2].hypothesis.effect
    loops = search.starts(start, of["backlash", 2])
    gaps = [float(loop.effects[-1].gap / screened.gap) for loop in loops]
    assert gaps[1:] == pytest.approx([1.0, 1.0, 10.0])
    assert ["kc2" in loop.names for loop in loops] == [False, False, True, True]
    # Without noise filters, which knew nothing of a gap.
    assert [type(method) for _, method in calls] == [jaxid.OEM, jaxid.OEM]
    assert len(search.starts(start, of["joint_elasticity", 2])) == 3
    assert [f.order for f in calls[-1][1].filters] == [0, 0]
    assert len(search.starts(start, of["spring", 2])) == 1


@pytest.mark.xdist_group("offset")
def test_backlash_is_tried_where_an_elasticity_leads(offset_case, offset_story, monkeypatch):
    search, start = search_of(offset_case), offset_story[0].steps[0]
    calls = fits_replaced(monkeypatch, start.fit)
    monkeypatch.setattr(_Search, "criterion", lambda self, fit, _: 3.0)
    soft = JointElasticity(joint=2, compliance=0.02, rotor=0.03)
    leading = Contender(
        "joint_elasticity", 2, dataclasses.replace(start.fit, loop=start.fit.loop.add(soft)), 5.0
    )
    found = search.with_siblings([leading], start, silent)
    assert [(c.name, c.joint) for c in found] == [("backlash", 2), ("joint_elasticity", 2)]
    loop, _ = calls[0]
    gap = loop.effects[-1]
    load = np.std(np.concatenate([r.tau[:, 1] for r in search.recordings]))
    assert float(gap.gap) == pytest.approx(2 * 0.02 * load)
    assert float(gap.rotor) == 0.03
    assert float(gap.stiffness) == pytest.approx(50.0)
    assert "kc2" in loop.names
    # Not of a backlash, and not of what is no transmission.
    of = {v.key: v.hypothesis.effect for v in start.diagnosis.ranking}
    for name in ("backlash", "spring"):
        loop = start.fit.loop.add(of[name, 2])
        other = Contender(name, 2, dataclasses.replace(start.fit, loop=loop), 5.0)
        assert search.with_siblings([other], start, silent) == [other]


@pytest.mark.xdist_group("offset")
def test_effect_is_added_twice_at_the_most(offset_story):
    start = offset_story[0].steps[0]
    top = next(v for v in start.diagnosis.ranking if v.possible and v.evidence > 0)
    step = dataclasses.replace(start, added=start.diagnosis.predicted(top))
    for often in (0, 1):
        found = _entries([start] + often * [step], lambda v: True)
        assert top.key in [v.key for v in found]
    assert top.key not in [v.key for v in _entries([start, step, step], lambda v: True)]


@pytest.mark.xdist_group("bump")
def test_chain_that_a_curve_outdoes_is_a_series(bump_case, bump_story):
    search, start = search_of(bump_case), bump_story.steps[0]
    poor = [QuadraticDrag(joint=2), TorqueOffset(joint=2), QuadraticDrag(joint=1)]
    assert search.is_series(with_chain(search, start, *poor), silent)
    true = [Bump(joint=2, height=0.05, place=0.5, width=0.25), *poor[:2]]
    assert not search.is_series(with_chain(search, start, *true), silent)
    assert not search.is_series(with_chain(search, start, *poor[:2]), silent)


@pytest.mark.xdist_group("offset")
def test_next_experiment_keeps_its_limits_and_separates(offset_story):
    story, _ = offset_story
    diagnosis = story.steps[0].diagnosis
    pair = [v for v in diagnosis.ranking if v.key in (("torque_offset", 2), ("spring", 2))]
    proposed = diagnosis.next_experiment(effects=pair, tries=6, duration=6.0)
    limits = jaxid.Limits.of(diagnosis.fit.recordings)
    assert np.all(proposed.recording.q_ref >= limits.low - 1e-9)
    assert np.all(proposed.recording.q_ref <= limits.high + 1e-9)
    assert np.all(np.abs(proposed.recording.tau) <= 1.05 * limits.torque)
    assert proposed.then > 0
    torque = dataclasses.replace(diagnosis.fit.loop, controller=jaxid.control.OpenLoop())
    driven = dataclasses.replace(diagnosis, fit=dataclasses.replace(diagnosis.fit, loop=torque))
    with pytest.raises(jaxid.errors.FitError, match="it follows no reference"):
        driven.next_experiment()


def test_limits_without_a_reference_are_not_those_of_the_noise():
    time = np.arange(0, 20, 1e-3)
    q = np.sin(time)[:, None]
    noise = 2e-4 * np.random.default_rng(0).standard_normal(q.shape)
    reached = jaxid.Limits.of([jaxid.Recording(time, q + noise, q)])
    assert 0.9 < reached.acceleration[0] < 1.5


def test_recordings_of_different_rates_share_no_noise_filter():
    def at(rate):
        time = np.arange(0, 4, 1 / rate)
        q = np.stack([np.sin(2 * time), np.sin(3 * time)], axis=1)
        return jaxid.Recording(time, q, q, q_ref=q, name=f"at {rate}")

    both = [at(100), at(200)]
    for method in (jaxid.SeparablePEM(), jaxid.JointPEM()):
        with pytest.raises(jaxid.errors.RecordingError, match="a noise filter is of one rate"):
            jaxid.fit(jaxid.scara(), both, method)
    with pytest.raises(jaxid.errors.RecordingError, match="200 samples a second"):
        jaxid.discover(jaxid.scara(), both[0], both[1], progress=False)
    with pytest.raises(jaxid.errors.RecordingError, match="200 samples a second"):
        jaxid.diagnose(jaxid.compare(jaxid.scara(), both), progress=False)


def test_a_search_that_was_told_to_stop_says_so(offset_story):
    story, _ = offset_story
    assert "nothing is left" in story.sentence
    assert "told to stop" in dataclasses.replace(story, unfinished=True).sentence


@pytest.mark.xdist_group("offset")
def test_the_recording_that_an_effect_is_on_is_named(offset_case, offset_story):
    start = offset_story[0].steps[0]
    verdict = next(v for v in start.diagnosis.ranking if v.key == ("payload", None))
    payload = start.diagnosis.predicted(verdict)
    (name,) = payload.recordings
    shown = start.diagnosis.table().set_index("effect").loc["payload", "amplitude"]
    assert shown.endswith(f" kg in {name}")
    steps = with_chain(search_of(offset_case), start, payload)
    story = jaxid.Discovery("explained", tuple(steps))
    assert f"The model lacked payload in {name};" in story.sentence
    assert f"payload in {name}: mass" in repr(story)
    assert story.to_dict()["added"][0]["recordings"] == [name]


def test_clean_recordings_are_adequate():
    fit, held_out = recordings_of(sim.make_case(12, effects=[], noise="moderate", duration=12.0))
    story = jaxid.discover(jaxid.scara(), fit, held_out, progress=False)
    assert story.verdict == "adequate"
    assert not story.to_dict()["added"]


def test_effective_tests_are_honest():
    """Of tests that are one and the same there is one; of independent ones, their number."""
    rng = np.random.default_rng(0)
    from jaxid.discovery.score import Gram

    ones = np.ones((40, 40)) + 1e-9 * np.eye(40)
    same = Gram(ones, np.zeros(40), np.ones(40), 1.0, 1000.0)
    apart = Gram(np.eye(40), rng.normal(size=40), np.ones(40), 1.0, 1000.0)
    blocks = [[k] for k in range(40)]
    # 400 draws give the mean of an exponential to 5 %; three of those.
    assert effective_tests(same, blocks) == pytest.approx(1.0, rel=0.15)
    assert effective_tests(apart, blocks) == pytest.approx(40.0, rel=0.15)
    assert corrected(0.01, 10) == pytest.approx(1 - 0.99**10)


def test_a_discovery_compares_what_the_loop_is_judged_by():
    time = np.arange(100) * 0.01
    q = np.stack([np.sin(time), np.cos(time)], axis=1)
    record = jaxid.Recording(time, q, q, q_ref=q)
    for output in ("position", "both"):
        with pytest.raises(jaxid.errors.FitError, match="leave out output"):
            jaxid.discover(jaxid.scara(), record, method=jaxid.OEM(output=output), progress=False)


def test_a_joint_that_is_held_still_has_shapes_to_screen():
    time = np.arange(50) * 0.01
    q = np.stack([np.sin(time), np.full(50, 0.3)], axis=1)
    record = jaxid.Recording(time, q, q, q_ref=q)
    rows, zero, v = jnp.asarray(q), jnp.asarray(0 * q), jnp.gradient(jnp.asarray(q), 0.01, axis=0)
    state, label = jnp.zeros((50, 0)), jnp.zeros(50, int)
    motion = jax.vmap(Motion)(jnp.asarray(time), rows, v, zero, rows, state, label)
    motion = jax.tree.map(lambda leaf: leaf[None], motion)
    scene = survey(jaxid.scara(), jaxid.Recordings.of(record), motion, [[1.0], [1.0]])
    settings = [effect for effect, _ in candidates(jaxid.catalogue, scene, 1.0)]
    assert {getattr(e, "joint", 2) for e in settings} == {1, 2}
    for effect in settings:
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(effect)), effect


def test_a_diagnosis_begins_where_its_fit_did():
    """At a first velocity that a parabola through noisy samples tells badly."""
    loop = jaxid.emps(jaxid.control.PD(Kp=[9e3], Kv=[600.0])).with_values(M=90.0, gamma1=100.0)
    loop = dataclasses.replace(loop, freed=frozenset())
    time = np.arange(0, 3, 0.01)
    q_ref = 0.1 * np.sin(3 * time[:, None] + 1.0)
    run = jaxid.simulate(loop, jaxid.Recording(time, q_ref, q_ref, q_ref=q_ref))[0]
    noise = np.random.default_rng(0).standard_normal((2, len(time), 1))
    q, tau = np.asarray(run.q) + 2e-4 * noise[0], np.asarray(run.tau) + 0.1 * noise[1]
    fit = jaxid.fit(loop, jaxid.Recording(time, q, tau, q_ref=q_ref), jaxid.OEM(progress=False))
    for judged in (fit, jaxid.compare(fit, fit.recordings)):
        found = jaxid.diagnose(judged, catalogue=(TorqueOffset,), progress=False)
        left = found.data.residual[0, : len(time)]
        np.testing.assert_allclose(left, fit.residuals[0], atol=1e-3 * np.abs(left).max())


def test_a_transmission_is_no_second_one():
    loop = jaxid.scara().add(Backlash(joint=1, gap=0.01), TorqueOffset(joint=1))
    shaft = JointElasticity(joint=1, compliance=0.01)
    assert _doubled(loop, 1, shaft)
    assert not _doubled(loop, 2, shaft)
    assert not _doubled(loop, 1, TorqueOffset(joint=1))


@pytest.mark.xdist_group("offset")
def test_an_experiment_for_a_transmission_is_refused(offset_story):
    story, _ = offset_story
    diagnosis = story.steps[0].diagnosis
    shaft = next(v for v in diagnosis.ranking if v.key == ("joint_elasticity", 1))
    with pytest.raises(jaxid.errors.FitError, match="joint_elasticity on joint 1 is a simulation"):
        diagnosis.next_experiment(effects=[diagnosis.ranking[0], shaft])


@pytest.mark.xdist_group("offset")
def test_unknown_catalogue_entry_is_refused(offset_story):
    story, _ = offset_story
    with pytest.raises(jaxid.errors.ModelError, match="cannot be screened"):
        jaxid.diagnose(story.steps[0].fit, catalogue=("stribeck",), progress=False)


@pytest.mark.xdist_group("offset")
def test_effect_given_as_an_object_is_screened(offset_story):
    story, _ = offset_story
    diagnosis = jaxid.diagnose(
        story.steps[0].fit, catalogue=(TorqueOffset(joint=2),), progress=False
    )
    assert [v.key for v in diagnosis.ranking] == [("torque_offset", 2)]
    assert diagnosis.ranking[0].p_value < 0.01
    assert not isinstance(diagnosis.best, Curve)


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


def test_effects_share_the_sharpness_that_is_estimated_for_their_joint():
    worn = Stribeck(1, 0.0, 0.02, gamma=5.0)
    loop = jaxid.emps().with_values(gamma1=1.2e4).add(worn)
    assert float(_of_one_sign(loop).effects[-1].gamma) == 1.2e4
    # What a user has freed, or never asked to estimate, is the user's.
    freed = loop.free("gamma1_2")
    assert float(_of_one_sign(freed).effects[-1].gamma) == 5.0
    held = jaxid.scara().add(worn)
    assert float(_of_one_sign(held).effects[-1].gamma) == 5.0


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
    (best,) = search.refit(start, [verdict], silent)
    place = best.fit.names.index("payload")
    assert abs(best.fit.theta[place] - load.mass) < 4 * best.fit.std[place]
    assert best.fit.loop.effects[-1].recordings == load.recordings
