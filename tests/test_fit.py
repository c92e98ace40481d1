"""Output error on a robot that jaxid did not simulate: truth, deviations, and failing fits."""

import dataclasses
import subprocess
import sys
from typing import Literal

import independent as sim
import numpy as np
import pytest

import jaxid
from jaxid.control import OpenLoop, Tracking
from jaxid.effects import EncoderEccentricity, Hysteresis, JointElasticity, TorqueOffset, Viscous
from jaxid.errors import FitError, RecordingError, _words, check_words
from jaxid.estimate.minimise import linearising
from jaxid.estimate.result import determined_covariance

# What one worker has fitted serves all of them.
pytestmark = pytest.mark.xdist_group("fit")


SEEDS = (41, 42)


def to_recording(rows, name, *, true=False):
    """A recording of the independent simulator's signals; `true` ones have no noise."""
    q, tau = ("q_true", "tau_true") if true else ("q", "tau")
    return jaxid.Recording.from_arrays(
        rows["time"], rows[q], rows[tau], q_ref=rows["q_ref"], name=name
    )


def both(case, *, true=False):
    """The two recordings of a case that are there to be fitted."""
    return [to_recording(case.recordings[n], n, true=true) for n in ("fit_1", "fit_2")]


def away(fit, case):
    """Distance from the truth in the fit's own standard deviations, `(parameters,)`."""
    # The law of the cases is continuous, so the delay of a virtual law is zero.
    truth = {**vars(case.plant), "delay": 0.0}
    return (fit.theta - np.array([truth[n] for n in fit.names])) / fit.std


@pytest.fixture(scope="session")
def cases():
    """SCARAs with other parameters and motions each, with encoders and coloured noise."""
    return [sim.make_case(seed) for seed in SEEDS]


@pytest.fixture(scope="session")
def fits(cases):
    """Their fits from the CAD start."""
    return [jaxid.fit(jaxid.scara(), both(case)) for case in cases]


@pytest.fixture(scope="session")
def lacking():
    """A case whose Stribeck friction drives the viscous friction of the model to its bound."""
    return sim.make_case(2016, [sim.effects.Stribeck(joint=2, torque=0.08, velocity=0.4)])


# --- the truth ------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", range(len(SEEDS)))
def test_from_cad_to_the_truth_within_own_deviations(cases, fits, k):
    fit = fits[k]
    assert fit.status is jaxid.Status.converged
    assert np.abs(away(fit, cases[k])).max() < 4
    # Newton's steps near a minimum: many more mean that something crawls.
    assert fit.iterations <= 20
    # The fit takes p of N degrees of freedom; the floor is the noise's own norm.
    floor = [cases[k].recordings[n]["noise_floor_percent"] for n in ("fit_1", "fit_2")]
    assert np.abs(fit.error_percent.to_numpy() / np.array(floor) - 1).max() < 0.02


def test_without_noise_the_truth_to_the_integration_error(cases):
    fit = jaxid.fit(jaxid.scara(), both(cases[0], true=True))
    truth = np.array([getattr(cases[0].plant, n) for n in fit.names])
    assert fit.status is jaxid.Status.converged
    # Steps are refined until the torque is within 1e-4 of that of half the step.
    assert np.abs(fit.theta / truth - 1).max() < 1e-3
    assert fit.error_percent.to_numpy().max() < 0.01


def test_a_virtual_controller_finds_what_the_known_one_finds(cases, fits):
    fit = jaxid.fit(jaxid.scara(Tracking()), both(cases[0]))
    assert fit.status is jaxid.Status.converged
    assert np.abs(away(fit, cases[0])).max() < 4
    mine, known = fit.table().loc[list(fits[0].names)], fits[0]
    apart = (mine["value"] - known.theta) / np.hypot(mine["std"], known.std)
    assert np.abs(apart).max() < 3
    # Both torques pass its low-pass: what is left is the noise below the cutoff, and the encoder's.
    assert fit.error_percent.to_numpy().max() < 6
    # Without that filter the raw torque's noise would be weighed against a smooth simulation.
    assert fit.residuals[0].shape[0] < cases[0].recordings["fit_1"]["time"].size


def test_fits_do_not_depend_on_the_order_of_recordings(cases, fits):
    turned = jaxid.fit(jaxid.scara(), both(cases[0])[::-1])
    # It stops within a hundredth of a deviation, from either side.
    assert np.all(np.abs(turned.theta - fits[0].theta) < 0.03 * fits[0].std)


# --- what recordings are like ---------------------------------------------------------------------


def test_different_lengths_and_uneven_sampling_in_one_fit(cases):
    one, two = both(cases[0])
    rng = np.random.default_rng(4)
    kept = np.sort(rng.permutation(two.samples)[: int(0.7 * two.samples)])
    thinned = jaxid.Recording.from_arrays(
        two.time[kept], two.q[kept], two.tau[kept], q_ref=two.q_ref[kept], name="thinned"
    )
    fit = jaxid.fit(jaxid.scara(), [one.slice(0.0, 12.0), thinned])
    assert fit.status is jaxid.Status.converged
    assert [len(r) for r in fit.residuals] == [1200, len(kept)]
    assert np.abs(away(fit, cases[0])).max() < 4


def test_a_recording_that_starts_in_motion(cases):
    late = both(cases[0])[0].slice(7.3, None)
    assert not np.allclose(late.q_ref[0], late.q[0], atol=0.02)
    fit = jaxid.fit(jaxid.scara(), late)
    assert fit.status is jaxid.Status.converged
    assert np.abs(away(fit, cases[0])).max() < 4
    # States that are estimated leave less than those read off the first samples.
    rest = jaxid.fit(jaxid.scara(), late, jaxid.OEM(initial="rest"))
    assert np.all(rest.error_percent.to_numpy() > fit.error_percent.to_numpy())


def test_windows_each_from_their_own_state(cases):
    fit = jaxid.fit(jaxid.scara(), both(cases[0])[0], jaxid.OEM(window=5.0))
    assert fit.status is jaxid.Status.converged
    assert np.abs(away(fit, cases[0])).max() < 4
    assert len(fit.residuals) == 1


@pytest.mark.parametrize("output", ["position", "both"])
def test_position_as_output(cases, output):
    fit = jaxid.fit(jaxid.scara(), both(cases[0]), jaxid.OEM(output=output))
    truth = np.array([getattr(cases[0].plant, n) for n in fit.names])
    assert fit.status is jaxid.Status.converged
    # Encoder steps are not noise at standstill, so deviations are not compared with the truth here.
    assert np.abs(fit.theta / truth - 1)[:2].max() < 0.02


# --- bounds and what is physical ------------------------------------------------------------------


def test_bounds_hold_in_every_iterate(lacking, monkeypatch):
    seen = []
    original = linearising.point_around

    def spy(problem, theta, start):
        seen.append((np.asarray(theta), np.asarray(problem.lower), np.asarray(problem.upper)))
        return original(problem, theta, start)

    monkeypatch.setattr(linearising, "point_around", spy)
    fit = jaxid.fit(jaxid.scara(), both(lacking))
    assert len(seen) > 3
    assert all(np.all((low <= x) & (x <= high)) for x, low, high in seen)
    assert fit.status is jaxid.Status.converged
    assert fit.iterations <= 30
    k = fit.names.index("Fv2")
    assert fit.theta[k] == 0
    assert any("Fv2 is at its lower bound" in note for note in fit.notes)
    # It is the best there: held a little inside, the rest refitted, the error is larger.
    inside = jaxid.fit(fit.loop.hold(Fv2=0.002), both(lacking), jaxid.OEM(start="given"))
    assert np.all(inside.error_percent["joint 2"] > fit.error_percent["joint 2"])


def test_an_unphysical_start_is_mended_by_inverse_dynamics(cases, fits):
    loop = jaxid.scara().with_values(MX2=9.0)
    assert float(loop.arm.smallest_inertia()) < 0
    fit = jaxid.fit(loop, both(cases[0]))
    assert fit.status is jaxid.Status.converged
    assert np.all(np.abs(fit.theta - fits[0].theta) < 0.03 * fits[0].std)


# --- failing --------------------------------------------------------------------------------------


def test_a_start_that_cannot_be_simulated_is_a_result_with_a_reason(cases):
    loop = jaxid.scara().with_values(MX2=9.0)
    fit = jaxid.fit(loop, both(cases[0]), jaxid.OEM(start="given"))
    assert fit.status is jaxid.Status.diverged
    assert not fit.succeeded
    assert np.isinf(fit.std).all()
    assert "no parameter values were found" in repr(fit)
    assert fit.to_dict()["status"] == "diverged"
    assert fit.to_dict()["parameters"]["ZZ1r"]["std"] is None


def test_too_few_steps_say_so(cases):
    fit = jaxid.fit(jaxid.scara(), both(cases[0]), jaxid.OEM(start="given", max_steps=2))
    assert fit.status is jaxid.Status.max_steps
    assert "max_steps" in repr(fit)


def test_an_undetermined_direction_is_named_and_the_rest_found(cases):
    loop = jaxid.scara().add(TorqueOffset(joint=2), TorqueOffset(joint=2))
    fit = jaxid.fit(loop, both(cases[0]))
    assert fit.status is jaxid.Status.converged
    names = list(fit.names)
    assert len(fit.undetermined) == 1
    assert "offset2, offset2_2" in fit.undetermined[0]
    # All that is known of it is that offsets are a tenth of the torque.
    torque = np.concatenate([r.tau[:, 1] for r in fit.recordings])
    likely = 0.1 * np.sqrt(np.mean(torque**2) / 2)
    assert fit.std[names.index("offset2")] == pytest.approx(likely, rel=1e-3)
    known = [k for k, n in enumerate(names) if not n.startswith("offset")]
    truth = np.array([getattr(cases[0].plant, names[k]) for k in known])
    assert np.all(np.abs(fit.theta[known] - truth) < 4 * fit.std[known])
    # Their sum is determined, and there was none.
    total = fit.theta[names.index("offset2")] + fit.theta[names.index("offset2_2")]
    assert abs(total) < 0.01


@pytest.mark.parametrize(
    ("change", "method", "error", "says"),
    [
        ({"controller": OpenLoop()}, jaxid.OEM(output="torque"), FitError, "output='position'"),
        ({}, jaxid.OEM(window=0.01), FitError, "make it longer"),
        ({"controller": Tracking()}, jaxid.OEM(window=0.3), RecordingError, "longer recordings"),
        ({"held": jaxid.scara().names}, jaxid.OEM(), FitError, "no free parameter"),
    ],
)
def test_what_cannot_be_fitted_is_refused_with_what_to_do(cases, change, method, error, says):
    loop = dataclasses.replace(jaxid.scara(), **change)
    with pytest.raises(error, match=says):
        jaxid.fit(loop, both(cases[0])[0], method)


OF_ANOTHER_KIND = """
import numpy as np, jaxid
t = np.linspace(0, 1, 50)
recording = jaxid.Recording.from_arrays(t, np.sin(t), np.cos(t), name="run")
loop = jaxid.emps()
for wrong in (
    lambda: jaxid.fit(recording, loop),
    lambda: jaxid.discover([recording], loop),
    lambda: loop.add("spring"),
    lambda: jaxid.fit(loop, "run_1.csv"),
):
    try:
        wrong()
    except jaxid.errors.JaxidError as error:
        print(type(error).__name__, error)
"""


def test_arguments_of_another_kind_are_refused_with_what_to_do():
    # Without the checks of types that the tests install.
    found = subprocess.run(
        [sys.executable, "-c", OF_ANOTHER_KIND], capture_output=True, text=True, check=True
    )
    one, other, effect, path = found.stdout.splitlines()
    assert one.startswith("ModelError the first argument is a Recording, not a loop: give")
    assert other.startswith("ModelError the first argument is a list, not a loop: give")
    assert effect.startswith("ModelError 'spring' is not an effect of emps: give an object")
    assert path.startswith("RecordingError Recordings: 'run_1.csv' is not a Recording; use")


def test_regressions_say_what_they_cannot_see(cases):
    one = both(cases[0])[0]
    for effect in (EncoderEccentricity(joint=1), JointElasticity(joint=1)):
        for method in (jaxid.IDIM(), jaxid.DIDIM(), jaxid.IDIMIV(), jaxid.IntegralLS()):
            with pytest.raises(FitError, match=f"which {effect.effect_name()} changes: use OEM"):
                jaxid.fit(jaxid.scara().add(effect), one, method)
    held = jaxid.scara().hold(*jaxid.scara().names)
    for method in (jaxid.IDIM(), jaxid.IntegralLS(), jaxid.SeparablePEM()):
        with pytest.raises(FitError, match="no free parameter to estimate"):
            jaxid.fit(held, one, method)
    with pytest.raises(FitError, match="no free parameter in which torque is linear"):
        jaxid.fit(held.free("eps1"), one, jaxid.IDIM())


def test_a_regression_says_which_values_are_outside_their_bounds(cases):
    one = both(cases[0])[0]
    pushed = one.tau - 2.0 * np.gradient(one.q, one.period, axis=0) * [1.0, 0.0]
    fit = jaxid.fit(jaxid.scara(), dataclasses.replace(one, tau=pushed), jaxid.IDIM())
    assert fit.theta[fit.names.index("Fv1")] < 0
    assert any(note.startswith("Fv1 outside the declared bounds") for note in fit.notes)


def test_a_word_that_a_setting_does_not_know_is_refused():
    @dataclasses.dataclass
    class Setting:
        output: Literal["torque", "position"] | None = None
        count: int = 3

    check_words(Setting())
    check_words(Setting("position"))
    with pytest.raises(FitError, match=r"output='torques' of Setting .* \(did you mean 'torque'"):
        check_words(Setting("torques"))
    assert _words(jaxid.OEM.__dataclass_fields__["initial"].type) == ("auto", "rest", "free")


def test_where_zero_is_on_an_axis_says_nothing_of_a_model():
    time = np.arange(2000) * 0.005
    q = 0.05 * np.sin(2 * np.pi * 0.7 * time) + 0.03 * np.sin(2 * np.pi * 1.9 * time)
    away = np.random.default_rng(3).standard_normal(2000).cumsum() * 0.1
    loop = jaxid.ClosedLoop(jaxid.arms.Axis(2.0), OpenLoop(), name="slide")
    for zero in (0.0, 3.0):
        recording = jaxid.Recording.from_arrays(time, q + zero, away - away.mean())
        fit = jaxid.fit(loop.add(Viscous(joint=1)), recording)
        assert not fit.succeeded
        assert any("does not describe these recordings" in note for note in fit.notes)


def test_a_gap_and_windows_that_forget_are_said(cases):
    one = both(cases[0])[0]
    kept = (one.time < 4.0) | (one.time > 5.0)
    gapped = jaxid.Recording.from_arrays(
        one.time[kept], one.q[kept], one.tau[kept], q_ref=one.q_ref[kept], gaps="allow"
    )
    fit = jaxid.fit(jaxid.scara(), gapped, jaxid.IDIM())
    assert any("has a gap of 1.0" in note for note in fit.notes)
    assert not any("gap" in note for note in jaxid.fit(jaxid.scara(), one, jaxid.IDIM()).notes)
    windows = jaxid.OEM(window=5.0, max_steps=2)
    fit = jaxid.fit(jaxid.scara().add(Hysteresis(joint=2, level=0.01)), one, windows)
    assert any("states of hysteresis start at rest" in note for note in fit.notes)
    # Windows share their end samples, which count once.
    assert len(fit.residuals[0]) == one.samples


def test_a_recording_of_another_robot_is_refused(cases):
    one = both(cases[0])[0]
    single = jaxid.Recording.from_arrays(one.time, one.q[:, 0], one.tau[:, 0], q_ref=one.q[:, 0])
    with pytest.raises(RecordingError, match="has 1 joint"):
        jaxid.fit(jaxid.scara(), single)


# --- the result -----------------------------------------------------------------------------------


def test_what_a_fit_shows(fits):
    fit = fits[0]
    table = fit.table()
    assert list(table.index) == list(fit.names)
    assert table.loc["Fv1", "unit"] == "N·m·s/rad"
    assert np.allclose(table["std_percent"], 100 * fit.std / np.abs(fit.theta))
    content = fit.to_dict()
    assert content["error_percent"]["fit_1"] == fit.error_percent.loc["fit_1"].tolist()
    assert content["parameters"]["ZZ2"]["value"] == fit.theta[1]
    assert len(fit.plot().data) > 0
    assert "OEM() of scara to fit_1, fit_2: converged" in repr(fit)
    assert "<table" in fit._repr_html_()


def test_white_deviations_are_the_papers_formula(cases, fits):
    fit = jaxid.fit(jaxid.scara(), both(cases[0]), jaxid.OEM(deviations="white"))
    assert np.allclose(fit.theta, fits[0].theta, atol=0.03 * fits[0].std.min())
    assert np.all(fit.std > 0)
    assert not np.allclose(fit.std, fits[0].std, rtol=0.05)


def test_derivatives_that_overflow_give_no_deviations():
    """A loop close to running away: said, not raised from inside a linear algebra library."""
    information = np.diag([1.0, np.inf])
    covariance, said = determined_covariance(information, ("a", "b"), np.ones(2))
    assert np.isinf(np.diag(covariance)).all()
    assert "deviations are unknown" in said[0]
