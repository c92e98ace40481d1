"""Searches along the recorded motion although the law is known."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import independent as sim
import numpy as np
import pytest
from independent import effects as fx
from loops import four_joints, scara
from stories import recordings_of, search_of, silent

import jaxid
from jaxid import Stepping
from jaxid.control import PD, OpenLoop, Sampled, Tracking
from jaxid.discovery import _discover, alongside, started
from jaxid.discovery.alongside import (
    along_recorded,
    approximating,
    delays_of_drives,
    in_the_loop,
    late_drives,
    one_late_drive,
)
from jaxid.discovery.ranking import judge
from jaxid.discovery.screening import screen
from jaxid.discovery.step import Step
from jaxid.effects import Coulomb, JointElasticity, Stribeck, TimeDelay, TorqueOffset, Viscous

LAW = PD(Kp=[800.0, 600.0, 3000.0, 90.0], Kv=[80.0, 60.0, 300.0, 9.0])


def test_many_joints_are_searched_along_the_recorded_motion():
    loop = jaxid.serial(four_joints(), Sampled(LAW, every=1e-3, delay=2))
    along = along_recorded(loop)
    assert isinstance(along.controller, Tracking)
    # The torque of a tick is held for one period, after two more.
    assert float(along.controller.delay) == pytest.approx(2.5e-3)
    assert set(along.names) == {*loop.names, "delay"}
    continuous = along_recorded(dataclasses.replace(loop, controller=LAW)).controller
    assert isinstance(continuous, Tracking)
    assert float(continuous.delay) == 0.0


def test_loops_with_a_sampled_law_are_searched_along_the_recorded_motion():
    sampled = dataclasses.replace(scara(), controller=Sampled(scara().controller, every=1e-3))
    along = along_recorded(sampled)
    assert isinstance(along.controller, Tracking)
    assert float(along.controller.delay) == pytest.approx(0.5e-3)


OFFSET = fx.TorqueOffset(joint=1, torque=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("substeps", "law", "why"),
    [
        (17, sim.PD(), "needs more than 16 steps"),
        (None, sim.PD(Kv=(2.0, 10.0)), "check the law, its gains"),
        (None, sim.SampledPD(period=0.01), "like a law that is sampled"),
    ],
)
def test_a_search_continues_along_the_recorded_motion_after_the_first_fit(substeps, law, why):
    case = sim.make_case(5, effects=[OFFSET], duration=8.0, controller=law)
    fit, held_out = recordings_of(case)
    loop = dataclasses.replace(jaxid.scara(), stepping=Stepping(substeps=substeps))
    found = jaxid.discover(loop, fit, held_out, catalogue=[TorqueOffset], progress=False)
    assert [s.label for s in found.steps] == ["start", "+ torque_offset on joint 1"]
    assert all(isinstance(s.fit.loop.controller, Tracking) for s in found.steps)
    assert any(why in said for said in (found.reason, *found.notes))
    # Effects are not sure if the law contradicts the torque.
    assert (found.verdict == "undetermined") == ("the law" in why)
    assert any("in the simulated loop the error" in note for note in found.notes)


@pytest.mark.slow
def test_a_search_that_has_made_all_drives_late_begins_again_without_the_law(monkeypatch, tmp_path):
    # As if other effects explained what the delays leave in the first fit.
    monkeypatch.setattr(started, "sampled", lambda *_: "")
    law = sim.SampledPD(period=0.01)
    fit, held_out = recordings_of(sim.make_case(5, effects=[OFFSET], duration=8.0, controller=law))
    given = {"catalogue": [TorqueOffset, TimeDelay], "progress": False, "resume": tmp_path}
    found = jaxid.discover(jaxid.scara(), fit, held_out, **given)
    assert [s.label for s in found.steps] == ["start", "+ torque_offset on joint 1"]
    assert all(isinstance(s.fit.loop.controller, Tracking) for s in found.steps)
    assert "time_delay" not in "".join(m.label for m in found.considered)
    assert any("like a law that is sampled" in note for note in found.notes)
    again = jaxid.discover(jaxid.scara(), fit, held_out, **given)
    np.testing.assert_array_equal(again.fit.theta, found.fit.theta)


@pytest.mark.parametrize(
    ("delays", "sampled"),
    [((1e-3, 1.2e-3), True), ((1e-3, 2.5e-3), False), ((1e-3,), False), ((9e-3, 9e-3), False)],
)
def test_drives_that_are_late_alike_are_a_sampled_law(delays, sampled):
    late = [TimeDelay(joint=j, delay=delay) for j, delay in enumerate(delays, start=1)]
    said = late_drives(scara(), [TorqueOffset(joint=1), *late], period=2e-3)
    assert ("like a law that is sampled" in said) == sampled
    assert late_drives(jaxid.serial(four_joints()), late, period=2e-3) == ""


LATE = TimeDelay(joint=1, delay=1e-3)


def slide() -> jaxid.ClosedLoop:
    friction = Viscous(1, 8.0), Coulomb(1, 2.0, smoothing=0.01)
    law = PD(Kp=[800.0], Kv=[80.0])
    return jaxid.ClosedLoop(jaxid.arms.Axis(M=2.0), law, friction, name="slide")


@pytest.mark.parametrize(
    ("loop", "effects", "doubtful"),
    [
        (slide(), [LATE, TorqueOffset(joint=1)], True),
        (slide(), [LATE], False),
        (slide(), [TorqueOffset(joint=1), Stribeck(joint=1)], False),
        (scara(), [LATE, TorqueOffset(joint=1), Stribeck(joint=2)], False),
    ],
)
def test_effects_beside_a_single_late_drive_may_approximate_a_sampled_law(loop, effects, doubtful):
    why = one_late_drive(loop, effects, period=2e-3)
    assert ("like a law that is sampled" in why) == doubtful


@pytest.mark.slow
@pytest.mark.parametrize("needless", [(Stribeck(joint=1),), ()])
def test_a_search_without_the_law_counts_if_effects_are_needless(monkeypatch, tmp_path, needless):
    monkeypatch.setattr(_discover, "one_late_drive", lambda *_: "the law is late, so")
    monkeypatch.setattr(_discover, "approximating", lambda *_: needless)
    fit, held_out = slides(seed=1), slides(seed=2)
    given = {"catalogue": [TorqueOffset], "progress": False, "resume": tmp_path}
    found = jaxid.discover(slide(), fit, held_out, **given)
    assert found.verdict == "explained"
    assert [s.label for s in found.steps] == ["start", "+ torque_offset on joint 1"]
    assert all(isinstance(s.fit.loop.controller, Tracking) == bool(needless) for s in found.steps)
    said = "the law is late, so sets of effects are compared along the recorded motion"
    assert any(said in note for note in found.notes) == bool(needless)


@pytest.fixture(scope="module")
def along() -> Sequence[Step]:
    """The start and a last step without the law that has the offset."""
    loop = dataclasses.replace(slide(), controller=Tracking())
    steps = []
    for added in (None, TorqueOffset(joint=1)):
        fit = jaxid.fit(loop if added is None else loop.add(added), slides(seed=1))
        steps.append(Step("", fit, None, jaxid.diagnose(fit, catalogue=[Stribeck]), added))
    return steps


PEAK = Stribeck(joint=1, level=0.5, velocity=0.05)
FAINT = dataclasses.replace(PEAK, level=1e-4)
STIFF = JointElasticity(joint=1, compliance=1e-6)


@pytest.mark.parametrize(
    ("beside", "unseen", "approximates"),
    [
        # A peak at low speed as large as the offset would be seen along the recorded motion.
        (PEAK, "lowers", True),
        # So small a peak would not, nor would a stiff transmission.
        (FAINT, "lowers", False),
        (FAINT, None, False),
        (STIFF, "lowers", False),
        # Held-out recordings do not confirm them.
        (FAINT, "unchanged", True),
        (STIFF, "unchanged", True),
    ],
)
def test_an_effect_for_which_nothing_else_speaks_approximates_the_law(
    along, beside, unseen, approximates
):
    last = along[-1]
    late = dataclasses.replace(last, added=LATE)
    more = dataclasses.replace(last, added=beside, unseen=unseen)
    found = approximating([*along, late, more], along)
    assert found == ((beside,) if approximates else ())


def test_no_effect_approximates_the_law_if_as_many_are_needed_without_it(along):
    late = dataclasses.replace(along[-1], added=LATE)
    assert approximating([*along, late], along) == ()


@pytest.mark.slow
def test_an_interrupted_search_without_the_law_leaves_the_answer_open(monkeypatch):
    searched, begun = _discover._searched, []

    def interrupted_again(*given):
        begun.append(given)
        if len(begun) > 1:
            raise KeyboardInterrupt
        return searched(*given)

    monkeypatch.setattr(_discover, "one_late_drive", lambda *_: "the law is late, so")
    monkeypatch.setattr(_discover, "_searched", interrupted_again)
    found = jaxid.discover(slide(), slides(seed=1), catalogue=[TorqueOffset], progress=False)
    assert found.interrupted
    assert found.verdict == "undetermined"
    assert [s.label for s in found.steps] == ["start", "+ torque_offset on joint 1"]


def slides(seed: int) -> list[jaxid.Recording]:
    """Two recordings of a slide with an offset of its torque."""
    rng, found = np.random.default_rng(seed), []
    plant = sim.Axis(M=2.0, Fv=8.0, Fc=2.0, offset=0.5, gamma=100.0)
    for k in range(2):
        phases = rng.uniform(0, 6, 3)
        lines = zip((0.2, 0.08, 0.02), (1.3, 3.1, 8.0), phases, strict=True)
        law = sim.PD(Kp=(800.0,), Kv=(80.0,), Kg=(1.0,))
        run = sim.simulate(plant, sim.MultiSine((tuple(lines),)), law, duration=8.0, sample=5e-3)
        tau = run.tau + 0.05 * rng.standard_normal(run.tau.shape)
        name = f"slide_{seed}_{k}"
        found.append(jaxid.Recording(run.time, run.q, tau, q_ref=run.q_ref, name=name))
    return found


def test_drives_are_late_under_a_sampled_law():
    found = delays(effects=[OFFSET], controller=sim.SampledPD(period=0.01))
    assert found == pytest.approx([5e-3, 5e-3], rel=0.3)


@pytest.mark.parametrize("effects", [[], [OFFSET], [fx.TimeDelay(joint=1, delay=5e-3)]])
def test_a_single_late_drive_is_no_sampled_law(effects):
    assert delays(effects=effects) == ()


def test_what_another_effect_leaves_is_no_sampled_law():
    # Delays of both drives also explain a part of what the bundled recordings lack.
    demo = Path(jaxid.__file__).parent / "demo" / "hidden"
    recordings = jaxid.Recordings.of(jaxid.read(demo / "fit_1.csv", demo / "fit_2.csv"))
    assert late(recordings, [Stribeck]) == ()


@pytest.mark.parametrize(
    ("controller", "late"), [(sim.SampledPD(period=0.01), True), (sim.PD(), False)]
)
def test_drives_are_late_beside_an_added_effect(controller, late):
    """The delay of one drive is part of the model, as that of the other one may be hidden."""
    case = sim.make_case(5, duration=8.0, effects=[OFFSET], controller=controller)
    search = search_of(case)
    search.asked = dataclasses.replace(search.asked, catalogue=(TorqueOffset,))
    search.given = jaxid.scara()
    start = jaxid.fit(search.given, recordings_of(case)[0])
    search.visit((), start)
    offset, delay = TorqueOffset(joint=1), TimeDelay(joint=1, delay=1e-3)
    both = jaxid.fit(start.loop.add(offset, delay), recordings_of(case)[0])
    at = search.visit(search.added(both), both)
    assert ("like a law that is sampled" in search._late_beside(at)) == late
    # What was already tested, and laws that are not simulated, are not tested again.
    for known in (at.effects[:1], at.effects[1:]):
        assert search._late_beside(dataclasses.replace(at, effects=known)) == ""
    search.given = along_recorded(jaxid.serial(four_joints(), LAW))
    assert search._late_beside(at) == ""


def delays(**case) -> tuple[float, ...]:
    """The delays of the drives in a fit of a simulated SCARA under a continuous law."""
    recordings, _ = recordings_of(sim.make_case(5, duration=8.0, **case))
    return late(recordings, [TorqueOffset])


def late(recordings: jaxid.Recordings, catalogue: Sequence[type]) -> tuple[float, ...]:
    fit = jaxid.fit(jaxid.scara(), recordings)
    screened = screen(fit, catalogue, silent)
    return delays_of_drives(judge(fit, screened, 0.01, lambda _: None), screened)


@pytest.mark.parametrize(
    "loop",
    [
        scara(),
        jaxid.serial(four_joints()),
        jaxid.serial(four_joints(), OpenLoop()),
        jaxid.serial(four_joints(), LAW).add(JointElasticity(2, compliance=1e-3)),
    ],
)
def test_other_loops_are_unchanged(loop):
    assert along_recorded(loop) is loop


def test_an_interrupted_simulation_does_not_lose_the_result(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(alongside, "compare", interrupted)
    monkeypatch.setattr(alongside, "needed_substeps", lambda *_: 1)
    loop = jaxid.serial(four_joints(), LAW)
    note = in_the_loop(loop, [along_recorded(loop)], moving())
    assert note.endswith("not known: the simulation was interrupted")


def moving() -> jaxid.Recordings:
    """A recording with a reference."""
    time = 0.004 * np.arange(300)
    q = 0.3 * np.sin(np.outer(time, [5.0, 7.0, 9.0, 11.0]) + np.array([0.1, 0.4, 0.9, 1.5]))
    return jaxid.Recordings.of(jaxid.Recording.from_arrays(time, q, q, q_ref=q, name="sines"))


@pytest.mark.slow
def test_the_note_has_the_errors_of_the_simulated_loop():
    loop = jaxid.serial(four_joints(), LAW)
    asked = moving()[0]
    heavy = loop.with_values(Fc1=3.0)
    run = jaxid.simulate(heavy, asked)[0]
    record = jaxid.Recordings.of(dataclasses.replace(asked, q=run.q, tau=run.tau))
    note = in_the_loop(loop, [along_recorded(loop), along_recorded(heavy)], record)
    assert "on sines" in note
    last, first = (float(x) for x in re.findall(r"([-.\de]+) %", note))
    assert last < 0.01
    # The missing torque of joint 1, as a share of its torque; the others lack nothing.
    missing = np.sqrt(np.mean(np.tanh(run.v[:, 0] / 1e-3) ** 2)) * 3.0
    share = 100 * missing / np.sqrt(np.mean(run.tau[:, 0] ** 2)) / 4
    assert first == pytest.approx(share, rel=0.2)
    # Along the recorded motion a sign may be as sharp as the samples can tell.
    sharp = heavy.with_values(eps1=1e-30)
    alone = in_the_loop(loop, [along_recorded(sharp)], record)
    assert "starting model" not in alone
    (error,) = (float(x) for x in re.findall(r"([-.\de]+) %", alone))
    assert error < 0.5
