"""Two models beside each other: their differences, and whether the intervals are true."""

import dataclasses

import independent as sim
import numpy as np
import pytest
import scipy

import jaxid
from jaxid.discovery.difference import changes
from jaxid.discovery.likelihood import score_of
from jaxid.errors import ModelError, RecordingError

SAMPLES, RECORDINGS, REPEATS = 400, 2, 100
# Of a hundred true intervals of 95 %, so many hold the truth at the least, but once in a thousand.
HOLDING = int(scipy.stats.binom.ppf(1e-3, REPEATS, 0.95))


def noises(rng: np.random.Generator, count: int) -> np.ndarray:
    """An autoregression of first order by SciPy, `(count, recordings, samples, 1)`."""
    white = rng.standard_normal((count, RECORDINGS, SAMPLES + 100))
    return scipy.signal.lfilter([1.0], [1.0, -0.7], white)[..., 100:, None]


def missed() -> list[np.ndarray]:
    """What the worse of two models leaves of the torque, by recording."""
    t = np.linspace(0, 1, SAMPLES)[:, None]
    return [0.5 * np.sin(2 * np.pi * k * t) ** 3 for k in (3, 5)]


def error(rows):
    sizes = [np.sqrt(np.mean([np.sum(r**2, axis=0) for r in part], axis=0)) for part in rows]
    return sizes[0] - sizes[1]


def power(rows):
    """The logarithm of the power that is left, which a score consists of."""
    left = [np.log(sum(np.sum(r**2) for r in part)) for part in rows]
    return np.array([left[0] - left[1]])


@pytest.mark.parametrize("statistic", [error, power])
@pytest.mark.parametrize(("better", "rest"), [("first", 0.0), ("second", 0.0), ("first", 0.5)])
def test_intervals_hold_the_mean_over_other_noise(statistic, better, rest):
    # Rows at which a joint rests are not compared.
    moves = (np.abs(np.linspace(-1, 1, SAMPLES)) >= rest)[:, None]

    def both(noise):
        pair = (
            [n * moves for n in noise],
            [(n + m) * moves for n, m in zip(noise, missed(), strict=True)],
        )
        return pair if better == "first" else pair[::-1]

    truth = np.mean([statistic(both(n)) for n in noises(np.random.default_rng(1), 2000)])
    drawn = noises(np.random.default_rng(2), REPEATS)
    found = [changes(both(n), statistic, draws=60, seed=k)[0] for k, n in enumerate(drawn)]
    held = sum(c.interval[0] < truth < c.interval[1] for c in found)
    assert held >= HOLDING
    # Nor are they wider than what they are for: the deviations are those over other noise.
    scatter = np.std([c.value for c in found], ddof=1)
    assert np.median([c.std for c in found]) == pytest.approx(scatter, rel=0.35)


@pytest.fixture(scope="module")
def case():
    return sim.make_case(51, duration=6.0)


@pytest.fixture(scope="module")
def loop(case):
    """The model with the true values."""
    return jaxid.scara().with_values(**{n: getattr(case.plant, n) for n in case.plant.base})


def recording(case, name, tau=None):
    r = case.recordings[name]
    tau = r["tau"] if tau is None else tau
    return jaxid.Recording.from_arrays(r["time"], r["q"], tau, q_ref=r["q_ref"], name=name)


def test_the_truth_is_surely_better_on_recordings_of_another_simulator(case, loop):
    worse = loop.with_values(Fc2=1.3 * float(case.plant.Fc2))
    found = jaxid.compare_models(loop, worse, recording(case, "held_out"))
    assert found.score is None
    assert found.errors[1].sure
    assert found.errors[1].value < 0
    one, other = found.first.error_percent, found.second.error_percent
    expected = (one - other).to_numpy()[0]
    assert [c.value for c in found.errors] == pytest.approx(expected.tolist())
    # The other way round all of it has the other sign.
    back = jaxid.compare_models(worse, loop, recording(case, "held_out"))
    assert [c.value for c in back.errors] == pytest.approx((-expected).tolist())
    assert [c.std for c in back.errors] == pytest.approx([c.std for c in found.errors])


def test_a_model_beside_itself_is_not_told_apart(case, loop):
    found = jaxid.compare_models(loop, loop, recording(case, "held_out"))
    assert found.names == ("scara (first)", "scara (second)")
    assert [(c.value, c.std, c.sure) for c in found.errors] == [(0.0, 0.0, False)] * 2


def test_two_fits_differ_by_their_scores(small_fit):
    more = small_fit.loop.add(jaxid.effects.QuadraticDrag(joint=1))
    other = jaxid.fit(more, small_fit.recordings, small_fit.method)
    found = jaxid.compare_models(small_fit, other)
    assert found.score is not None
    expected = score_of(small_fit).value - score_of(other).value
    assert found.score.value == pytest.approx(expected)
    assert found.names == ("emps", "emps + quadratic_drag on joint 1")
    assert "score, first minus second" in repr(found)
    assert max(map(len, repr(found).splitlines())) <= 80
    assert found.to_dict()["score"]["interval"] == list(found.score.interval)
    (bars,) = [t for t in found.plot().data if t.name]
    assert np.asarray(bars.x) == pytest.approx([c.value for c in found.errors])
    assert "<table" in found._repr_html_()


def test_what_cannot_be_compared_is_refused(case, loop, small_fit):
    with pytest.raises(RecordingError, match="give recordings for the comparison"):
        jaxid.compare_models(loop, loop)
    tracking = dataclasses.replace(loop, controller=jaxid.control.Tracking(cutoff=5.0))
    with pytest.raises(ModelError, match="same samples"):
        jaxid.compare_models(loop, tracking, recording(case, "held_out"))
