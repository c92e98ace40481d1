"""Whether a residual depends on the motion, and coloured noise that a floor takes for an effect."""

import dataclasses

import numpy as np
import pytest
from scipy import signal
from stories import recordings_of

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.coloured_noise import above_floors, floor_with_coloured_noise
from jaxid.discovery.dependence import ComparedRows, among, depends_on_motion, on_others
from jaxid.discovery.regressions import AT_ONCE, WITH_MEMORY
from jaxid.discovery.remarks import remarks
from jaxid.discovery.step import Step
from jaxid.effects import Stribeck
from jaxid.noise import ARFilter

SLOW = ARFilter(np.array([-1.6, 0.62]), 1.0)
WORTH = 0.05


def motion_of(rng: np.random.Generator, samples: int = 600, joints: int = 1) -> np.ndarray:
    """Position, velocity, acceleration and direction of sums of sines, at 50 Hz."""
    time = np.arange(samples) / 50
    parts = np.zeros((3, samples, joints))
    for _ in range(4):
        w = 2 * np.pi * rng.uniform(0.2, 1.5, joints)
        phase = np.outer(time, w) + rng.uniform(0, 6, joints)
        parts += np.sin(phase), w * np.cos(phase), -(w**2) * np.sin(phase)
    q, v, a = parts
    return np.stack([q, v, a, np.sign(v)], axis=-1)


def friction(motion: np.ndarray) -> np.ndarray:
    """Dry friction of the first joint that grows with the distance from the centre."""
    return motion[:, 0, 3] * motion[:, 0, 0] ** 2


def ringing_at(frequency: float, rate: float, push: np.ndarray) -> np.ndarray:
    """The speed of a weakly damped oscillator, of a standard deviation of one."""
    w = 2 * np.pi * frequency
    step = signal.cont2discrete(([1.0, 0.0], [1.0, 0.1 * w, w**2]), 1 / rate)
    moved = signal.lfilter(step[0].ravel(), step[1], push)
    return moved / np.std(moved)


def resonance(motion: np.ndarray) -> np.ndarray:
    """A resonance at 7 Hz that each reversal of the first joint excites."""
    return ringing_at(7.0, 50.0, motion[:, 0, 3])


def drawn(
    seed: int, size: float = 0.0, louder: float = 1.0, joints: int = 1, torque=friction
) -> tuple[ComparedRows, ComparedRows]:
    """The rows of two recordings and of a third one: slow noise, and a torque of some size."""
    rng = np.random.default_rng(seed)
    motion = [motion_of(rng, joints=joints) for _ in range(3)]
    rest = [SLOW.simulate((joints, len(m)), rng).T for m in motion]
    level = np.sqrt(SLOW.gain)
    for m, r in zip(motion, rest, strict=True):
        r[:, 0] += size * level * torque(m) / np.std(torque(m))
    rest[2] = louder * rest[2]
    return ComparedRows(tuple(motion[:2]), tuple(rest[:2])), ComparedRows((motion[2],), (rest[2],))


@pytest.mark.parametrize("regressions", [AT_ONCE, WITH_MEMORY])
def test_deviations_of_coloured_noise_are_standard(regressions):
    found = []
    for seed in range(40):
        # Noise of the other recording is stronger than where the filter was estimated.
        rows, other = drawn(seed, louder=3.0)
        both = among(rows, 0, SLOW, regressions), on_others(rows, other, 0, SLOW, regressions)
        found.append([x.deviations for x in both])
    # The standard deviation of forty draws is known to a ninth.
    assert np.std(found, axis=0)[1] == pytest.approx(1.0, abs=0.3)
    # Predictions of two recordings from each other are not independent.
    assert 0.6 < np.std(found, axis=0)[0] < 1.3
    assert np.all(np.abs(np.mean(found, axis=0)) < 0.5)
    assert np.max(found) < 3.5


@pytest.mark.parametrize("regressions", [AT_ONCE, WITH_MEMORY])
def test_errors_of_parameters_are_not_a_missing_effect(regressions):
    """They come from the noise that the regression was trained on, so it predicts them."""
    alone, beside = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        motion = [motion_of(rng) for _ in range(3)]
        # The held-out motion is ten times as fast as the fitted ones.
        motion[2] *= np.array([1.0, 10.0, 100.0, 1.0])
        rest = [SLOW.simulate((1, len(m)), rng).T for m in motion]
        base = [m[:, :, 1:] for m in motion]
        x, y = np.concatenate(base[:2])[:, 0], np.concatenate(rest[:2])[:, 0]
        errors = np.linalg.lstsq(x, y, rcond=None)[0]
        rest = [r - b @ errors for r, b in zip(rest, base, strict=True)]
        rows = ComparedRows(tuple(motion[:2]), tuple(rest[:2]))
        other = ComparedRows((motion[2],), (rest[2],))
        alone.append(on_others(rows, other, 0, SLOW, regressions).deviations)
        known = dataclasses.replace(other, base=(base[2],))
        beside.append(on_others(rows, known, 0, SLOW, regressions).deviations)
    if regressions == WITH_MEMORY:
        assert np.median(alone) > 4
    # The standard deviation of twenty draws is known to a sixth.
    assert np.std(beside) == pytest.approx(1.0, abs=0.4)
    assert np.max(beside) < 3.5


def test_a_function_of_the_motion_is_seen_in_a_recording_that_it_was_not_trained_on():
    for seed in range(5):
        rows, other = drawn(seed, size=1.0)
        seen = on_others(rows, other, 0, SLOW)
        assert seen.deviations > 8
        # Half of the power; a regression reaches a part of it.
        assert 0.15 < seen.share < 0.65
        assert among(rows, 0, SLOW).deviations > 8


def test_a_resonance_is_seen_by_the_regression_with_a_memory():
    for seed in range(5):
        rows, other = drawn(seed, size=1.0, torque=resonance)
        seen = on_others(rows, other, 0, SLOW)
        assert seen.on == "the motion before and after"
        assert seen.sure
        # Half of the power; a regression reaches a part of it.
        assert 0.15 < seen.share < 0.65
        assert not on_others(rows, other, 0, SLOW, AT_ONCE).sure
        assert among(rows, 0, SLOW).sure


def test_friction_is_seen_among_the_motions_of_many_joints():
    rows, other = drawn(3, size=1.0, joints=5)
    assert on_others(rows, other, 0, SLOW).deviations > 8
    assert on_others(rows, other, 1, SLOW).deviations < 4


def test_one_recording_cannot_be_predicted_from_others():
    rows, _ = drawn(0)
    assert among(rows.only([0]), 0, SLOW) is None


def test_rows_that_are_not_compared_are_left_out():
    rows, other = drawn(4, size=1.0)
    seen = on_others(rows, other, 0, SLOW)
    kept = other.residual[0].copy()
    kept[::3] = 0
    fewer = on_others(rows, ComparedRows(other.motion, (kept,)), 0, SLOW)
    assert 3 < fewer.deviations < seen.deviations
    nothing = ComparedRows(rows.motion, tuple(np.zeros_like(r) for r in rows.residual))
    assert on_others(nothing, other, 0, SLOW).deviations == 0
    assert on_others(nothing, other, 0, SLOW).share == 0


def recorded(
    name: str,
    seed: int,
    missing: float = 0.0,
    drift: float = 0.0,
    ringing: float = 0.0,
    resonance: float = 0.0,
    offset: float = 0.0,
) -> jaxid.Recording:
    """A slide with dry friction in closed form, 20 s at 200 Hz, its torque with noise.

    **Arguments:**

    - `missing`: size of a friction force that depends on position and velocity, N.
    - `drift`: standard deviation of a slow random walk after a second, N.
    - `ringing`: standard deviation of noise around 8 Hz, N.
    - `resonance`: size of a resonance at 8 Hz that dry friction excites, N.
    - `offset`: of the torque, N; of the other sign in every second recording.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(4000) / 200
    q, v, a = np.zeros((3, len(time)))
    for w in 2 * np.pi * rng.uniform(0.2, 1.2, 4):
        phase, size = w * time + rng.uniform(0, 6), 0.3 / w
        q += size * np.sin(phase)
        v += size * w * np.cos(phase)
        a -= size * w**2 * np.sin(phase)
    tau = 2.0 * a + 0.8 * v + 1.5 * np.tanh(v / 0.005)
    tau += missing * np.sign(v) * np.sin(25 * q) * np.tanh((v / 0.15) ** 2)
    tau += 0.02 * rng.standard_normal(len(time))
    around = signal.butter(2, (7.0, 9.0), "bandpass", fs=200, output="sos")
    tau += ringing * signal.sosfilt(around, rng.standard_normal(len(time))) * 7
    tau += resonance * ringing_at(8.0, 200.0, np.sign(v))
    tau += offset * (-1) ** seed
    tau += drift * np.cumsum(rng.standard_normal(len(time))) / np.sqrt(200)
    return jaxid.Recording.from_arrays(time, q[:, None], tau[:, None], name=name)


def diagnosed(**made: float):
    """Fit, diagnosis and held-out comparison of a slide with an unknown law."""
    one, two, three = (recorded(f"r{k}", 10 + k, **made) for k in range(3))
    fit = jaxid.fit(jaxid.robots.emps(Tracking(cutoff=20.0)), [one, two])
    return fit, jaxid.diagnose(fit, progress=False), jaxid.compare(fit, three)


@pytest.fixture(scope="module")
def drifting():
    return diagnosed(drift=0.1)


@pytest.fixture(scope="module")
def lacking():
    return diagnosed(missing=0.3)


def test_the_floor_of_torque_that_drifts_is_its_error(drifting):
    fit, diagnosis, held_out = drifting
    before, left = diagnosis.measured, fit.error_percent.to_numpy()
    # White noise above the motion is a small part of the error.
    assert above_floors(fit, diagnosis, WORTH).all()
    there = np.isfinite(before.high)
    assert there.any()
    assert np.all(left[there] > 10 * before.high[there])
    after = floor_with_coloured_noise(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert after.coloured.all()
    assert not before.coloured.any()
    np.testing.assert_allclose(after.percent, left)
    np.testing.assert_array_equal(after.low[there], before.low[there])
    assert np.all(after.low < left)
    assert depends_on_motion(fit, diagnosis, diagnosis.noise, held_out, WORTH) == ""
    changed = dataclasses.replace(diagnosis, measured=after)
    assert changed.floor_sources() == (("unpredicted",),)
    assert not above_floors(fit, changed, WORTH).any()
    notes = remarks([Step("start", fit, held_out, changed)], fit.loop, {})
    said = f"the error of joint 1 ({left.mean():.3g} %, and "
    assert any(n.startswith(said) and "counts as noise" in n for n in notes)


def test_a_missing_effect_is_not_coloured_noise(lacking):
    fit, diagnosis, held_out = lacking
    assert above_floors(fit, diagnosis, WORTH).all()
    after = floor_with_coloured_noise(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert after is diagnosis.measured


def test_an_offset_that_differs_between_recordings_is_not_coloured_noise():
    fit, diagnosis, held_out = diagnosed(offset=0.1)
    assert above_floors(fit, diagnosis, WORTH).all()
    after = floor_with_coloured_noise(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert after is diagnosis.measured


def test_noise_above_the_frequencies_of_the_motion_is_noise():
    fit, diagnosis, held_out = diagnosed(ringing=0.1)
    assert above_floors(fit, diagnosis, WORTH).all()
    after = floor_with_coloured_noise(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert after.coloured.all()


def test_a_resonance_that_the_motion_excites_is_not_noise():
    fit, diagnosis, held_out = diagnosed(resonance=0.1)
    assert above_floors(fit, diagnosis, WORTH).all()
    after = floor_with_coloured_noise(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert after is diagnosis.measured
    said = depends_on_motion(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert "a regression on the motion before and after" in said


def test_an_effect_of_no_known_formula_is_told_from_other_recordings(lacking):
    fit, diagnosis, held_out = lacking
    said = depends_on_motion(fit, diagnosis, diagnosis.noise, held_out, WORTH)
    assert said.startswith("on the held-out recordings the error of joint 1 is")
    assert "an effect is missing" in said
    alone = depends_on_motion(fit, diagnosis, diagnosis.noise, None, WORTH)
    assert alone.startswith("on the fitted recordings")
    # What the user does not find worth knowing is not told.
    assert depends_on_motion(fit, diagnosis, diagnosis.noise, held_out, 50.0) == ""


@pytest.mark.xdist_group("offset")
def test_windows_of_a_fit_are_tested_like_recordings(offset_case):
    fitted, unseen = recordings_of(offset_case)
    fit = jaxid.fit(jaxid.scara(), fitted, jaxid.OEM(window=4.0, progress=False))
    diagnosis = jaxid.diagnose(fit, catalogue=[Stribeck], progress=False)
    rows = ComparedRows.of_fit(fit, diagnosis)
    assert len(rows.residual) > len(fit.residuals)
    assert [len(x) for x in rows.motion] == [len(x) for x in rows.residual]
    total = sum(np.sum(r**2) for r in rows.residual)
    assert total == pytest.approx(sum(np.sum(r**2) for r in fit.residuals), rel=0.02)
    for held_out in (None, jaxid.compare(fit, unseen)):
        said = depends_on_motion(fit, diagnosis, diagnosis.noise, held_out, WORTH)
        assert isinstance(said, str)
        floor_with_coloured_noise(fit, diagnosis, diagnosis.noise, held_out, WORTH)
