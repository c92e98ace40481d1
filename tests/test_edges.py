"""Extreme numbers: a right answer or a named reason, never NaN."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.effects import TorqueOffset
from jaxid.errors import FitError, RecordingError
from jaxid.estimate.result import relative_errors

pytestmark = pytest.mark.xdist_group("edges")

# Long enough for every parameter, and of one shape: compiled once for all tests here.
SECONDS = 4.0
QUIET = jaxid.OEM(progress=False)


@pytest.fixture(scope="session")
def case() -> Any:
    """A SCARA with encoders and coloured noise."""
    return sim.make_case(41, duration=SECONDS)


def record(case: Any, name: str, *, true: bool = False, **changed: Any) -> jaxid.Recording:
    rows = case.recordings[name]
    q, tau = ("q_true", "tau_true") if true else ("q", "tau")
    signals = {"time": rows["time"], "q": rows[q], "tau": rows[tau], "q_ref": rows["q_ref"]}
    return jaxid.Recording.from_arrays(**signals | changed, name=name)


def pair(case: Any, **settings: Any) -> list[jaxid.Recording]:
    return [record(case, name, **settings) for name in ("fit_1", "fit_2")]


@pytest.fixture(scope="session")
def plain(case: Any) -> jaxid.Fit:
    """The fit with which the others are compared."""
    return jaxid.fit(jaxid.scara(), pair(case), QUIET)


def sound(fit: jaxid.Fit) -> None:
    """Asserts that a successful fit contains no NaN."""
    assert np.isfinite(fit.theta).all()
    assert not np.isnan(fit.std).any()
    assert not np.isnan(fit.error_percent.to_numpy()).any()


# --- recordings -----------------------------------------------------------------------------------


def test_identical_recordings_say_nothing_new(case: Any, plain: jaxid.Fit) -> None:
    one = record(case, "fit_1")
    twice = jaxid.fit(jaxid.scara(), [one, dataclasses.replace(one, name="again")], QUIET)
    assert twice.succeeded
    sound(twice)
    # Its own coloured noise is counted twice: deviations shrink by at most the square root of two.
    assert np.all(twice.std < 3 * plain.std)


def test_without_noise_the_deviations_are_finite(case: Any) -> None:
    fit = jaxid.fit(jaxid.scara(), pair(case, true=True), QUIET)
    truth = np.array([getattr(case.plant, n) for n in fit.names])
    assert fit.succeeded
    sound(fit)
    assert np.abs(fit.theta / truth - 1).max() < 5e-3


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_torque_in_a_wrong_unit_is_said(case: Any, scale: float) -> None:
    wrong = [record(case, n, tau=scale * case.recordings[n]["tau"]) for n in ("fit_1", "fit_2")]
    loop = dataclasses.replace(jaxid.scara(), stepping=jaxid.Stepping(substeps=4))
    fit = jaxid.fit(loop, wrong, dataclasses.replace(QUIET, start="given"))
    sound(fit)
    # Its values are meaningless, so finer steps are not worth their time.
    assert fit.loop.stepping.substeps == 4
    assert any("does not describe these recordings" in note for note in fit.notes)
    assert any("check units" in note for note in fit.notes)


@pytest.mark.parametrize("signal", ["time", "q", "tau", "q_ref"])
def test_what_no_robot_reaches_is_refused(case: Any, signal: str) -> None:
    with pytest.raises(RecordingError, match=r"reaches .* in SI units|spans more"):
        record(case, "fit_1", **{signal: 1e200 * case.recordings["fit_1"][signal]})


def seen(case: Any, counts: int) -> list[jaxid.Recording]:
    """The pair, its joints read by encoders of so many counts a turn."""
    step = 2 * np.pi / counts
    return [
        record(case, n, q=np.round(case.recordings[n]["q_true"] / step) * step)
        for n in ("fit_1", "fit_2")
    ]


@pytest.mark.parametrize(
    ("counts", "cutoff", "ends"),
    [
        (40_000, None, jaxid.Status.converged),
        (1000, 40.0, jaxid.Status.misfit),
        (100, 20.0, jaxid.Status.unphysical),
    ],
)
def test_settled_is_not_enough_for_success(
    case: Any, counts: int, cutoff: float | None, ends: jaxid.Status
) -> None:
    # An acceleration drowned in encoder steps: the values settle, and explain nothing.
    fit = jaxid.fit(jaxid.scara(), seen(case, counts), jaxid.IDIMIV(jaxid.Filtering(cutoff)))
    assert fit.status is ends
    assert bool(fit.notes) != fit.succeeded
    sound(fit)


def test_a_motor_wired_the_other_way_round_is_no_success(case: Any) -> None:
    wrong = [record(case, n, tau=-case.recordings[n]["tau"]) for n in ("fit_1", "fit_2")]
    for method in (jaxid.IDIM(), jaxid.IDIMIV(), jaxid.DIDIM()):
        fit = jaxid.fit(jaxid.scara(), wrong, method)
        assert fit.status is jaxid.Status.unphysical
        sound(fit)


# --- models ---------------------------------------------------------------------------------------


class Runaway(jaxid.effects.AbstractEffect):
    """Drives itself without bound, along one recording."""

    joint: int = eqx.field(static=True)
    rate: jax.Array = jaxid.parameter(1e6, symbol="run", unit="N·m", free=False)

    def torque(self, motion: jaxid.effects.Motion) -> jax.Array:
        here = motion.label == jaxid.effects.recording_label("fit_2")
        push = jnp.where(here, self.rate * motion.v[self.joint - 1] ** 3, 0.0)
        return jaxid.effects.on_joint(self.joint, -push, motion)


def test_a_recording_that_diverges_is_left_out_and_named(case: Any) -> None:
    loop = jaxid.scara().add(Runaway(joint=2))
    given = dataclasses.replace(QUIET, start="given")
    fit = jaxid.fit(loop, pair(case), given)
    assert fit.recordings.names == ("fit_1",)
    assert any("1 of 2 recordings left out" in n and "fit_2" in n for n in fit.notes)
    sound(fit)
    alone = jaxid.fit(loop, record(case, "fit_2"), given)
    assert alone.status is jaxid.Status.diverged


def test_a_search_names_recordings_along_which_its_model_diverges(case: Any) -> None:
    """One is left out of the fits; a held-out one leaves the model untested."""
    loop = jaxid.scara().add(Runaway(joint=2))
    unseen = dataclasses.replace(record(case, "held_out"), name="fit_2")
    given = dataclasses.replace(QUIET, start="given")
    story = jaxid.discover(
        loop, pair(case), unseen, method=given, catalogue=[TorqueOffset], progress=False
    )
    assert story.verdict == "undetermined"
    assert "diverges when it is simulated along a held-out recording" in story.reason
    assert any("all fits leave out fit_2" in note for note in story.notes)
    assert any("diverges when it is simulated along fit_2" in note for note in story.notes)


def test_a_held_out_recording_is_checked_before_the_search(
    case: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = case.recordings["held_out"]
    without = jaxid.Recording.from_arrays(rows["time"], rows["q"], rows["tau"], name="held_out")
    monkeypatch.setattr(jaxid.estimate.OEM, "fit", lambda *_: pytest.fail("a fit came first"))
    with pytest.raises(jaxid.errors.JaxidError, match="held_out"):
        jaxid.discover(jaxid.scara(), pair(case), without, progress=False)


def test_a_joint_that_is_not_compared_in_a_recording_has_no_error() -> None:
    measured = np.column_stack([np.ones(4), np.zeros(4), np.zeros(4)])
    left = np.column_stack([0.1 * np.ones(4), np.zeros(4), np.ones(4)])
    rest = jaxid.Recording(np.arange(4.0), measured, measured, name="a")
    (row,) = relative_errors([rest], [measured], [left]).to_numpy()
    assert row[:2] == pytest.approx([10.0, 0.0])
    assert np.isinf(row[2])


def test_time_is_bounded(case: Any, plain: jaxid.Fit) -> None:
    method = dataclasses.replace(QUIET, max_seconds=0.0)
    fit = jaxid.fit(jaxid.scara(), pair(case), method)
    assert fit.status is jaxid.Status.max_seconds
    assert not fit.succeeded
    sound(fit)
    assert fit.iterations <= 2 < plain.iterations
    assert math.isinf(jaxid.OEM().max_seconds)


class Wrong(jaxid.estimate.AbstractMethod):
    """A method that calls nonsense a success."""

    fit_as: jaxid.Fit

    def fit(self, loop: jaxid.ClosedLoop, recordings: jaxid.Recordings) -> jaxid.Fit:
        return self.fit_as


def test_no_success_with_a_number_that_is_none(plain: jaxid.Fit) -> None:
    negative = -np.eye(len(plain.names))
    lost = plain.loop.with_theta(jnp.full(len(plain.names), jnp.inf))
    for wrong in (
        dataclasses.replace(plain, covariance=negative),
        dataclasses.replace(plain, loop=lost),
        dataclasses.replace(plain, error_percent=plain.error_percent * np.nan),
    ):
        with np.errstate(invalid="ignore"):
            fit = jaxid.fit(plain.loop, plain.recordings, Wrong(wrong))
        assert fit.status is jaxid.Status.overflowed
        assert "not numbers (NaN)" in fit.notes[-1]
    # What is infinitely uncertain is an answer.
    infinite = dataclasses.replace(plain, covariance=np.full_like(plain.covariance, np.inf))
    assert jaxid.fit(plain.loop, plain.recordings, Wrong(infinite)).succeeded


def rescaled(loop: jaxid.ClosedLoop, by: float) -> jaxid.ClosedLoop:
    """The loop of a robot so many times as heavy, with gains and friction to match."""
    law = dataclasses.replace(loop.controller, Kg=by * loop.controller.Kg)
    return dataclasses.replace(loop, controller=law).with_theta(by * loop.theta)


@pytest.mark.parametrize("mass", [1e-3, 1e3])
@pytest.mark.parametrize("method", [QUIET, jaxid.DIDIM()])
def test_light_and_heavy_robots_are_fitted_alike(
    case: Any, plain: jaxid.Fit, mass: float, method: Any
) -> None:
    recordings = [record(case, n, tau=mass * case.recordings[n]["tau"]) for n in ("fit_1", "fit_2")]
    fit = jaxid.fit(rescaled(jaxid.scara(), mass), recordings, method)
    assert fit.succeeded
    assert fit.notes == ()
    # DIDIM stops within a fortieth of a value, and knows less of what happened than OEM does.
    away = 0.05 if method is QUIET else 4.0
    assert np.all(np.abs(fit.theta / mass - plain.theta) < away * plain.std)


@pytest.mark.slow
def test_friction_as_steep_as_a_step(case: Any, plain: jaxid.Fit) -> None:
    loop = jaxid.scara().with_values(eps1=1e-5, eps2=1e-5)
    fit = jaxid.fit(loop, pair(case), QUIET)
    assert fit.succeeded
    sound(fit)
    # The real friction is less steep, which the model cannot say: a per cent of the torque.
    assert fit.error_percent.to_numpy().max() < 2 * plain.error_percent.to_numpy().max()
    assert all(np.isfinite(jaxid.diagnose(fit, progress=False).floor_percent()))


def test_its_own_simulation_is_fitted_to_rounding(case: Any, plain: jaxid.Fit) -> None:
    loop = plain.loop
    runs = jaxid.simulate(loop, pair(case))
    exact = [
        record(case, n, q=np.asarray(run.q), tau=np.asarray(run.tau))
        for n, run in zip(("fit_1", "fit_2"), runs, strict=True)
    ]
    fit = jaxid.fit(loop, exact, QUIET)
    assert fit.succeeded
    sound(fit)
    assert np.abs(fit.theta / np.asarray(loop.theta) - 1).max() < 1e-6
    with pytest.raises(FitError, match="a diagnosis is not possible"):
        jaxid.diagnose(fit, progress=False)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_references_in_a_wrong_unit_are_said(case: Any, scale: float) -> None:
    names = ("fit_1", "fit_2")
    wrong = [record(case, n, q_ref=scale * case.recordings[n]["q_ref"]) for n in names]
    fit = jaxid.fit(jaxid.scara(), wrong, QUIET)
    assert not fit.succeeded
    assert any("q does not follow q_ref on joint 1, 2" in note for note in fit.notes)
    # The torque alone does not see the position, and is right.
    wrong = [record(case, n, q=scale * case.recordings[n]["q"]) for n in names]
    fit = jaxid.fit(jaxid.scara(), wrong, QUIET)
    assert any("q does not follow q_ref on joint 1, 2" in note for note in fit.notes)
    sound(fit)


@pytest.mark.slow
def test_what_explains_nothing_is_undetermined(case: Any) -> None:
    wrong = [record(case, n, tau=1e6 * case.recordings[n]["tau"]) for n in ("fit_1", "fit_2")]
    found = jaxid.discover(jaxid.scara(), wrong, progress=False)
    assert found.verdict == "undetermined"
    assert "check the units" in found.reason
    assert found.reason in found.sentence


def test_gaps_of_a_sample_change_little(case: Any, plain: jaxid.Fit) -> None:
    whole = pair(case)
    kept = np.setdiff1d(np.arange(whole[0].samples), [50, 133, 200])
    holes = [
        record(case, r.name, time=r.time[kept], q=r.q[kept], tau=r.tau[kept], q_ref=r.q_ref[kept])
        for r in whole
        if r.q_ref is not None
    ]
    fit = jaxid.fit(jaxid.scara(), holes, QUIET)
    assert fit.succeeded
    assert np.all(np.abs(fit.theta - plain.theta) < 0.5 * plain.std)


# --- what physics says of changed recordings ------------------------------------------------------


def test_shifted_in_time_the_same(case: Any, plain: jaxid.Fit) -> None:
    later = [record(case, n, time=case.recordings[n]["time"] + 1000.0) for n in ("fit_1", "fit_2")]
    fit = jaxid.fit(jaxid.scara(), later, QUIET)
    # Times near 1000 s are rounded to 1e-13 s.
    assert np.abs(fit.theta - plain.theta).max() < 1e-6 * np.abs(plain.theta).max()


def test_in_another_order_the_same(case: Any, plain: jaxid.Fit) -> None:
    fit = jaxid.fit(jaxid.scara(), pair(case)[::-1], QUIET)
    # It stops within a hundredth of a deviation, from either side.
    assert np.all(np.abs(fit.theta - plain.theta) < 0.03 * plain.std)


def test_twice_the_same_to_the_bit(case: Any, plain: jaxid.Fit) -> None:
    fit = jaxid.fit(jaxid.scara(), pair(case), QUIET)
    assert fit.theta.tobytes() == plain.theta.tobytes()
    assert fit.covariance.tobytes() == plain.covariance.tobytes()


def test_mirrored_joints_mirror_what_is_odd(case: Any, plain: jaxid.Fit) -> None:
    # Both angles and torques negated: inertia and friction stay, MY2 (odd in q2) changes its sign.
    turned = [
        record(case, n, **{s: -case.recordings[n][s] for s in ("q", "tau", "q_ref")})
        for n in ("fit_1", "fit_2")
    ]
    fit = jaxid.fit(jaxid.scara(), turned, QUIET)
    sign = np.where(np.array(fit.names) == "MY2", -1.0, 1.0)
    assert np.all(np.abs(sign * fit.theta - plain.theta) < 0.03 * plain.std)


def test_torque_and_gains_in_another_unit_scale_the_parameters(case: Any, plain: jaxid.Fit) -> None:
    # Everything in units of ten newton metres: parameters are a tenth, deviations too.
    scaled = [record(case, n, tau=0.1 * case.recordings[n]["tau"]) for n in ("fit_1", "fit_2")]
    loop = jaxid.scara()
    law = dataclasses.replace(loop.controller, Kg=0.1 * loop.controller.Kg)
    loop = dataclasses.replace(loop, controller=law).with_theta(0.1 * loop.theta)
    fit = jaxid.fit(loop, scaled, QUIET)
    assert np.all(np.abs(10 * fit.theta - plain.theta) < 0.05 * plain.std)
    assert np.allclose(10 * fit.std, plain.std, rtol=0.02)


def test_split_in_two_nearly_the_same(case: Any, plain: jaxid.Fit) -> None:
    # The second halves start in motion, from states that are estimated: a little is lost.
    halves = [r.slice(*ends) for r in pair(case) for ends in ((None, 2.0), (2.0, None))]
    named = [dataclasses.replace(r, name=f"half {k}") for k, r in enumerate(halves)]
    fit = jaxid.fit(jaxid.scara(), named, QUIET)
    # A second in two is little to know a state by; whole ones are of four seconds.
    assert np.all(np.abs(fit.theta - plain.theta) < 1.5 * plain.std)
    # Where each starts as it is seen to, smoothed, nothing is spent on it.
    seen = jaxid.fit(jaxid.scara(), named, dataclasses.replace(QUIET, initial="rest"))
    assert np.all(np.abs(seen.theta - plain.theta) < 0.5 * plain.std)
    # With the halves' references out of step by a sample it is another robot.
    wrong = [dataclasses.replace(r, q_ref=np.roll(r.q_ref, 1, axis=0)) for r in named]
    late = jaxid.fit(jaxid.scara(), wrong, dataclasses.replace(QUIET, initial="rest"))
    assert np.any(np.abs(late.theta - plain.theta) > 5 * plain.std)


def white(case: Any, every: int) -> jaxid.Fit:
    """A fit to each so-manieth sample of recordings with white noise."""
    rng = np.random.default_rng(5)
    recordings = []
    for n in ("fit_1", "fit_2"):
        rows = case.recordings[n]
        tau = rows["tau_true"]
        tau = tau + 0.02 * tau.std(axis=0) * rng.normal(size=tau.shape)
        kept = {s: rows[s][::every] for s in ("time", "q", "q_ref")}
        recordings.append(record(case, n, tau=tau[::every], **kept))
    return jaxid.fit(jaxid.scara(), recordings, QUIET)


def test_half_the_samples_know_half_as_much(case: Any) -> None:
    all_, half = white(case, 1), white(case, 2)
    # What half the samples add is as large as what they know.
    assert np.all(np.abs(half.theta - all_.theta) < 3 * np.sqrt(half.std**2 - all_.std**2))
    ratio = half.std / all_.std
    assert np.median(ratio) == pytest.approx(np.sqrt(2), rel=0.1)
    assert np.all((ratio > 1.1) & (ratio < 1.8))


def test_recordings_without_torque_leave_no_inertia() -> None:
    rng, time = np.random.default_rng(0), np.arange(0.0, 3.0, 0.005)
    runs = []
    for name in ("one", "two"):
        q = 0.1 * np.sin(2 * np.pi * time[:, None] * rng.uniform(0.3, 1.0))
        noise = 1e-9 * rng.standard_normal(q.shape)
        runs.append(jaxid.Recording.from_arrays(time, q, noise, name=name))
    tracking = jaxid.control.Tracking(cutoff=20.0)
    loop = jaxid.ClosedLoop(jaxid.arms.Axis(M=5.0), tracking, name="axis")
    with pytest.raises(FitError, match="axis has no inertia: check that tau is the recorded"):
        jaxid.discover(loop, runs[:1], validate=runs[1:], progress=False)
