"""Comparisons: which signal is judged, over what, and what they show."""

import dataclasses

import independent as sim
import numpy as np
import pytest
import scipy

import jaxid
from jaxid.control import OpenLoop, Tracking
from jaxid.errors import FitError, RecordingError


@pytest.fixture(scope="session")
def case():
    """A SCARA's case from the independent simulator."""
    return sim.make_case(51, duration=8.0)


@pytest.fixture(scope="session")
def loop(case):
    """The model with the true values."""
    return jaxid.scara().with_values(**{n: getattr(case.plant, n) for n in case.plant.base})


@pytest.fixture(scope="session")
def recordings(case):
    """Two of its recordings, of different lengths."""
    rows = [(n, case.recordings[n]) for n in ("fit_1", "held_out")]
    both = [
        jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name=n)
        for n, r in rows
    ]
    return jaxid.Recordings.of([both[0], both[1].slice(0.0, 6.0)])


def test_at_the_truth_the_error_is_the_noise(case, loop, recordings):
    found = jaxid.compare(loop, recordings)
    floor = case.recordings["fit_1"]["noise_floor_percent"]
    # The floor is what a perfect model leaves; the integration adds 1e-4 of the torque at most.
    assert np.abs(found.error_percent.loc["fit_1"] / floor - 1).max() < 1e-2
    assert found.signal == "torque"
    assert list(found.error_percent.columns) == ["joint 1", "joint 2"]
    assert [len(r) for r in found.residuals] == [801, 600]


@pytest.mark.parametrize("held", [False, True], ids=["free", "nothing free"])
def test_a_recording_in_motion_is_held_against_the_best_start(case, loop, held):
    r = case.recordings["fit_1"]
    whole = jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name="x")
    moving = whole.slice(1.0, 6.0)
    # By the encoder alone, whose steps say little of a velocity.
    assert np.abs(r["v_true"][100]).max() > 0.1
    here = slice(100, 100 + moving.samples)
    noise = (r["tau"] - r["tau_true"])[here]
    floor = 100 * np.linalg.norm(noise, axis=0) / np.linalg.norm(r["tau"][here], axis=0)
    found = jaxid.compare(loop.hold(*loop.names) if held else loop, moving)
    assert np.abs(found.error_percent.to_numpy()[0] / floor - 1).max() < 1e-2


def test_a_fit_that_trusts_the_first_sample_is_compared_from_it(case, loop):
    r = case.recordings["fit_1"]
    whole = jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name="x")
    moving = whole.slice(1.0, 6.0)
    fit = jaxid.fit(loop, moving, jaxid.OEM(initial="rest", start="given", progress=False))
    (run,) = jaxid.simulate(fit.loop, moving)
    np.testing.assert_array_equal(jaxid.compare(fit, moving).runs[0].tau, run.tau)


def test_errors_are_the_papers_relative_ones(loop, recordings):
    found = jaxid.compare(loop.with_values(ZZ1r=4.5), recordings)
    for recording, run in zip(recordings, found.runs, strict=True):
        for signal, name in (("position", "q"), ("torque", "tau")):
            measured, simulated = getattr(recording, name), np.asarray(getattr(run, name))
            size = np.linalg.norm(measured, axis=0)
            expected = 100 * np.linalg.norm(measured - simulated, axis=0) / size
            assert np.allclose(found.errors.loc[(recording.name, signal)], expected)
    assert set(found.errors.index.unique("signal")) == {"position", "velocity", "torque"}


def test_a_measured_velocity_is_what_velocity_is_held_against(case, loop, recordings):
    r = case.recordings["fit_1"]
    with_v = dataclasses.replace(recordings[0], v=r["v_true"])
    derived, measured = (
        jaxid.compare(loop, x).errors.loc[("fit_1", "velocity")] for x in (recordings[0], with_v)
    )
    assert np.all(measured < 0.1 * derived)


def test_open_loop_is_judged_by_position_in_windows(loop, recordings):
    driven = dataclasses.replace(loop, controller=OpenLoop())
    short, long = (jaxid.compare(driven, recordings, window=w) for w in (0.4, 4.0))
    assert short.signal == "position"
    assert "torque" not in short.errors.index.unique("signal")
    assert [len(r) for r in short.residuals] == [801, 600]
    # Noise in the torque is integrated: an arm that is not held loses its way with time.
    assert np.all(short.error_percent.to_numpy() < long.error_percent.to_numpy())


@pytest.mark.parametrize("filtered", [False, True])
def test_a_fit_brings_its_window(loop, recordings, filtered):
    driven = dataclasses.replace(loop, controller=OpenLoop())
    plain = jaxid.OEM(window=1.0, start="given")
    method = jaxid.SeparablePEM(plain, orders=(2, 2)) if filtered else plain
    fit = jaxid.fit(driven, recordings, method)
    own, given = jaxid.compare(fit, recordings), jaxid.compare(fit.loop, recordings, window=1.0)
    assert own.errors.equals(given.errors)


def test_tracking_compares_torques_that_passed_the_same_low_pass(loop, recordings):
    every = jaxid.Standstill(still=0.0)
    tracking = dataclasses.replace(loop, controller=Tracking(cutoff=5.0), standstill=every)
    found = jaxid.compare(tracking, recordings)
    time, measured, simulated = found.judged(0)
    # Three periods of the cutoff are lost at each end.
    assert time[0] == pytest.approx(0.6, abs=0.011)
    assert np.diff(time) == pytest.approx(0.08)
    assert recordings[0].time[-1] - 0.6 - 0.08 < time[-1] < recordings[0].time[-1] - 0.6 + 0.011
    assert measured.shape == simulated.shape == (len(time), 2)
    rows = np.linalg.norm(measured - simulated, axis=0) / np.linalg.norm(measured, axis=0)
    assert np.allclose(100 * rows, found.error_percent.loc["fit_1"])
    # Well inside, the rows are those of SciPy's filter forward and backward.
    sections = scipy.signal.butter(4, 5.0, fs=100.0, output="sos")
    passed = scipy.signal.sosfiltfilt(sections, recordings[0].tau, axis=0)
    inner = (time > 2) & (time < 6)
    rows = np.searchsorted(recordings[0].time, time[inner] - 1e-6)
    assert np.allclose(measured[inner], passed[rows], atol=1e-3 * np.abs(passed).max())
    assert np.array_equal(found.residuals[0], measured - simulated)


def without(recording, *gaps):
    """The recording without the samples of some stretches, s."""
    kept = np.ones(recording.samples, bool)
    for begin, end in gaps:
        kept[(recording.time > begin) & (recording.time < end)] = False
    signals = (getattr(recording, name)[kept] for name in ("time", "q", "tau"))
    return jaxid.Recording.from_arrays(*signals, q_ref=recording.q_ref[kept], gaps="allow")


def test_tracking_compares_nothing_beside_a_gap(loop, recordings):
    tracking = dataclasses.replace(loop, controller=Tracking(cutoff=5.0))
    # Half a period of the cutoff is 0.1 s.
    short, long = ((3.0, 3.08), (3.0, 3.3))
    for gap, left_out in ((short, False), (long, True)):
        found = jaxid.compare(tracking, without(recordings[0], gap))
        time = found.judged(0)[0]
        beside = (time > gap[0] - 0.6) & (time < gap[1] + 0.6)
        assert beside.any() != left_out
        assert time[-1] > 6.0
    slow = dataclasses.replace(loop, controller=Tracking(cutoff=2.0))
    gaps = [(t, t + 0.3) for t in (2.5, 4.0, 5.5)]
    with pytest.raises(jaxid.errors.RecordingError, match="on both sides of a gap"):
        jaxid.compare(slow, without(recordings[0], *gaps))


def test_what_a_comparison_shows(loop, recordings):
    found = jaxid.compare(loop, recordings)
    assert "relative error in %" in repr(found)
    assert "held_out" in repr(found)
    assert "<table" in found._repr_html_()
    content = found.to_dict()
    assert content["error_percent"]["fit_1"] == found.error_percent.loc["fit_1"].tolist()
    assert set(content["errors"]) == {"position", "velocity", "torque"}
    by_name, by_number = found.plot("held_out"), found.plot(1)
    assert by_name == by_number
    assert {trace.name for trace in by_name.data} >= {"measured", "simulated", "residual"}
    assert len(found.plot_errors().data) > 0
    acf, bound = found.autocorrelation("fit_1", lags=20)
    assert acf.shape == (21, 2)
    assert np.allclose(acf[0], 1.0)
    assert bound == pytest.approx(2 / np.sqrt(801))


def test_a_recording_that_is_not_there_is_refused(loop, recordings):
    with pytest.raises(RecordingError, match="fit_1, held_out"):
        jaxid.compare(loop, recordings).plot("fit_9")


def test_a_loop_that_diverges_is_said(recordings):
    # Velocity fed back with the wrong sign, and strongly.
    law = jaxid.control.PD(Kp=[6.25, 156.25], Kv=[-2e3, -2e3], Kg=[3.5, 0.06])
    with pytest.raises(FitError, match="diverges when it is simulated along fit_1"):
        jaxid.compare(jaxid.scara(law), recordings)


def test_another_robots_recording_is_refused(loop, recordings):
    with pytest.raises(RecordingError, match="joint"):
        jaxid.compare(jaxid.emps(), recordings)
