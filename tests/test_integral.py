"""Integral, filtered, difference and Fourier least squares: filters, truth, encoders, errors."""

import dataclasses

import independent as sim
import numpy as np
import pytest
from scipy import integrate

import jaxid
from jaxid.effects import RotorInertia
from jaxid.errors import FitError
from jaxid.estimate._operators import Operator
from jaxid.signals.fourier import (
    FourierSeries,
    fourier_basis,
    period_of,
    repeated,
    settle_harmonics,
)

PERIOD, TICK, PERIODS = 4.0, 0.004, 4
LINES = (
    np.random.default_rng(0).uniform(0.1, 0.5, (2, 4)),
    np.random.default_rng(1).uniform(0, 6, (2, 4)),
)
GAINS = {"Kp": (200.0, 200.0), "Kv": (25.0, 25.0), "Kg": (0.5, 0.2)}
TRUE = sim.TwoLink(gamma=20.0)
TRUTH = {name: getattr(TRUE, name) for name in TRUE.base}


class Periodic:
    """Four harmonics a joint."""

    def position(self, t):
        size, phase = LINES
        rate = 2 * np.pi * np.arange(1, 5) / PERIOD
        return np.sum(size * np.sin(rate * t + phase), axis=1).tolist()


@pytest.fixture(scope="module")
def smooth():
    """Four periods after a first one, exact: DOP853 of the independent arm under a PD law."""
    run = sim.simulate(
        TRUE, Periodic(), sim.PD(**GAINS), (), (PERIODS + 1) * PERIOD, TICK, rtol=1e-8, atol=1e-10
    )
    part = slice(round(PERIOD / TICK), None)
    return {"time": run.time[part], "q": run.q[part], "tau": run.tau[part], "v": run.v[part]}


def loop():
    law = jaxid.control.PD(Kp=GAINS["Kp"], Kv=GAINS["Kv"], Kg=GAINS["Kg"])
    return jaxid.two_link(law).hold(eps1=0.05, eps2=0.05)


def recording(rows, q=None, resolution=None, part=slice(None)):
    q = rows["q"] if q is None else q
    return jaxid.Recording.from_arrays(
        rows["time"][part], q[part], rows["tau"][part], resolution=resolution
    )


def away(fit):
    return fit.theta - np.array([TRUTH[n] for n in fit.names])


def share(fit, names=("p1", "p2", "p3", "p4", "p5")):
    """Largest relative error of the inertial parameters."""
    relative = dict(zip(fit.names, away(fit) / [TRUTH[n] for n in fit.names], strict=True))
    return max(abs(relative[n]) for n in names)


# --- the filter -----------------------------------------------------------------------------------


@pytest.mark.parametrize("poles", [(30.0,), (30.0, 30.0), (30.0, 80.0)])
@pytest.mark.parametrize("held", [False, True])
def test_operator_integrates_as_an_ordinary_solver_does(poles, held):
    t = np.arange(0.0, 1.0, 0.01)
    x = np.sin(7 * t) + 0.3 * np.cos(11 * t) * t

    def u(at):
        k = min(int(at / 0.01 + 1e-9), len(t) - 1)
        return x[k] if held else np.sin(7 * at) + 0.3 * np.cos(11 * at) * at

    def rate(at, y):
        before = u(at)
        out = []
        for pole, state in zip(poles, y, strict=True):
            out.append(pole * (before - state))
            before = state
        return out

    y = [np.full(len(poles), x[0])]
    for start in t[:-1]:
        span = (start, start + 0.01)
        y.append(integrate.solve_ivp(rate, span, y[-1], "DOP853", rtol=1e-10, atol=1e-12).y[:, -1])
    y = np.array(y)
    found = Operator(poles, 0.01)(0, x[:, None], held)[:, 0]
    # A cubic spline through ten samples a radian is off by (0.11)⁴ / 384 of the curve.
    assert np.abs(found - y[:, -1]).max() < (1e-9 if held else 1e-5)
    if not held and len(poles) == 2:
        twice = Operator(poles, 0.01)(2, x[:, None])[:, 0]
        first = poles[0] * (x - y[:, 0])
        second = poles[1] * (y[:, 0] - y[:, 1])
        assert np.abs(twice - poles[1] * (first - second)).max() < 1e-2


def test_transient_columns_span_every_initial_state():
    t = np.arange(0.0, 1.0, 0.01)
    x = np.sin(5 * t + 1)[:, None]
    for poles in ((20.0, 20.0), (20.0, 50.0)):
        operator = Operator(poles, 0.01)
        # The same signal with a past: what differs is the answer to another initial state.
        longer = np.sin(5 * np.arange(-1.0, 1.0 - 1e-9, 0.01) + 1)[:, None]
        gap = (operator(1, longer)[100:] - operator(1, x))[:, 0]
        columns = operator.transient(t)
        left = gap - columns @ np.linalg.lstsq(columns, gap, rcond=None)[0]
        assert np.abs(gap).max() > 0.1
        # The spline through the longer signal is another near the shorter one's start.
        assert np.abs(left).max() < 1e-4


# --- truth ----------------------------------------------------------------------------------------

EXACT = {
    "integral": jaxid.IntegralLS(40.0, 40.0, states=jaxid.Differences("central")),
    "filtered": jaxid.FilteredLS(40.0, states=jaxid.Differences("central")),
    "difference": jaxid.DifferenceLS(jaxid.Differences("central")),
    "Fourier": jaxid.FourierLS(),
}


@pytest.mark.parametrize("name", EXACT)
def test_every_method_finds_the_truth_without_noise(name, smooth):
    fit = jaxid.fit(loop(), recording(smooth), EXACT[name])
    # Central differences are off by (ω T)²/6 at up to 2 Hz, 4e-4; a series ends at some harmonic.
    assert share(fit) < 3e-3
    assert fit.status is jaxid.Status.converged


@pytest.mark.parametrize("name", EXACT)
def test_samples_that_are_missing_here_and_there_move_nothing(name, smooth):
    kept = np.sort(np.random.default_rng(5).permutation(len(smooth["time"]))[:3200])
    thinned = recording(smooth, part=kept)
    steps = np.diff(thinned.time)
    assert steps.max() > 1.9 * steps.min()
    fit = jaxid.fit(loop(), thinned, EXACT[name])
    assert share(fit) < 5e-3


def test_a_known_link_length_and_held_parameters_go_through_the_split(smooth):
    arm = jaxid.arms.TwoLink(link_length=TRUE.p3 / TRUE.p5)
    known = dataclasses.replace(loop(), arm=arm).hold(p1=TRUE.p1)
    fit = jaxid.fit(known, recording(smooth), EXACT["integral"])
    assert "p1" not in fit.names
    assert share(fit, ("p2", "p4", "p5")) < 3e-3


def test_transient_of_a_moving_start_is_modelled_or_dropped(smooth):
    start = int(np.argmax(np.abs(smooth["v"][:1500]).sum(axis=1)))
    rows = recording(smooth, part=slice(start, None))
    found = {
        how: share(
            jaxid.fit(
                loop(),
                rows,
                jaxid.IntegralLS(2.0, 3.0, states=jaxid.Differences("central"), transient=how),
            )
        )
        for how in ("modelled", "dropped", "ignored")
    }
    assert found["modelled"] < 3e-3
    assert found["dropped"] < 3e-3
    assert found["ignored"] > 5 * found["modelled"]


# --- encoders -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "bits"),
    [
        (jaxid.IntegralLS(40.0, states=jaxid.Differences("central"), weights="encoder"), 16),
        (
            jaxid.IntegralLS(40.0, states=jaxid.LowPass(jaxid.Filtering(20.0)), weights="encoder"),
            16,
        ),
    ],
    ids=["differences", "low-passed"],
)
def test_encoder_weights_give_true_deviations(method, bits, smooth):
    rng = np.random.default_rng(3)
    step = 2 * np.pi / 2**bits
    scores = []
    clean = jaxid.fit(loop(), recording(smooth, resolution=step), method)
    for _ in range(15):
        # Errors of a quantiser's variance, white: how well that holds is another matter.
        q = smooth["q"] + step * rng.uniform(-0.5, 0.5, smooth["q"].shape)
        fit = jaxid.fit(loop(), recording(smooth, q=q, resolution=step), method)
        scores.append((fit.theta - clean.theta) / fit.std)
    spread = np.sqrt(np.mean(np.square(scores)))
    # 135 correlated scores; half of them independent give a standard error of 9 %.
    assert 0.75 < spread < 1.3


def test_integral_beats_filtered_and_difference_at_coarse_encoders(smooth):
    step = 2 * np.pi / 2**13
    methods = {
        "difference": jaxid.DifferenceLS(),
        "filtered": jaxid.FilteredLS(40.0, states=jaxid.Differences()),
        "integral": jaxid.IntegralLS(40.0, 40.0, states=jaxid.Differences()),
    }
    errors = {name: [] for name in methods}
    for offset in np.random.default_rng(4).uniform(size=(5, 2)):
        q = step * (np.round(smooth["q"] / step - offset) + offset)
        for name, method in methods.items():
            fit = jaxid.fit(loop(), recording(smooth, q=q, resolution=step), method)
            errors[name].append(share(fit))
    size = {name: np.sqrt(np.mean(np.square(e))) for name, e in errors.items()}
    # At 13 bits filtered and difference both fail; it does not matter which is worse.
    assert size["integral"] < 0.5 * min(size["filtered"], size["difference"])


# --- periodic motion ------------------------------------------------------------------------------


def test_series_derivatives_are_those_of_the_series():
    series = FourierSeries(np.random.default_rng(2).normal(size=(9, 2)), 3.0)
    t = np.linspace(0.0, 3.0, 50)
    h = 1e-4
    q, v, a = series(t)
    before, after = series(t - h), series(t + h)
    assert np.abs((after[0] - before[0]) / (2 * h) - v).max() < 1e-5
    assert np.abs((after[0] - 2 * q + before[0]) / h**2 - a).max() < 1e-4


def test_period_and_harmonics_are_found():
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 13.0, 0.01)
    series = FourierSeries(rng.normal(size=(13, 2)), 3.217)
    step = 1e-3
    q = step * np.round(series(t)[0] / step)
    r = jaxid.Recording.from_arrays(t, q, q, resolution=step)
    assert abs(period_of(r) / 3.217 - 1) < 1e-3
    assert settle_harmonics(r, 3.217, None).harmonics == 6


def test_repeated_periods_give_the_noise():
    rng = np.random.default_rng(7)
    t = np.arange(2400) * 0.005
    wave = fourier_basis(t, 3.0, 3)[0] @ rng.normal(size=(7, 2))
    found = []
    for _ in range(40):
        q = wave + rng.normal(size=wave.shape) * [0.01, 0.03]
        tau = 2 * wave + rng.normal(size=wave.shape) * [0.1, 0.2]
        r = repeated(jaxid.Recording.from_arrays(t, q, tau), 3.0)
        assert r.periods == 4
        found.append(np.concatenate([r.noise_q / [0.01, 0.03], r.noise_tau / [0.1, 0.2]]))
    # Of 1800 degrees of freedom each deviation is known to 1.7 %, their mean of 160 to 0.14 %.
    assert np.abs(np.mean(found) - 1) < 0.005
    assert np.std(found) < 0.025


# --- what cannot be done is said ------------------------------------------------------------------


def test_poles_are_checked(smooth):
    r = recording(smooth)
    for method in (jaxid.IntegralLS(2000.0), jaxid.FilteredLS(2000.0)):
        with pytest.raises(FitError, match="above the Nyquist rate"):
            jaxid.fit(loop(), r, method)
    with pytest.raises(FitError, match="not stable"):
        jaxid.fit(loop(), r, jaxid.IntegralLS(-3.0))
    with pytest.raises(FitError, match="ten time constants"):
        jaxid.fit(loop(), r, jaxid.IntegralLS(0.1))


def test_what_fourier_cannot_do_is_said(smooth):
    with pytest.raises(FitError, match=r"500 harmonics cannot be determined from 1000 samples"):
        jaxid.fit(loop(), recording(smooth), jaxid.FourierLS(harmonics=500))
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 10.0, 0.01)
    walk = np.cumsum(np.cumsum(rng.normal(size=(len(t), 2)), axis=0), axis=0) * 1e-4
    aperiodic = jaxid.Recording.from_arrays(t, walk, walk)
    with pytest.raises(FitError, match="does not repeat within half its length"):
        jaxid.fit(loop(), aperiodic, jaxid.FourierLS())
    with pytest.raises(FitError, match="does not repeat after 4 s"):
        jaxid.fit(loop(), aperiodic, jaxid.FourierLS(period=4.0))
    with pytest.raises(FitError, match="less than its period"):
        jaxid.fit(loop(), aperiodic, jaxid.FourierLS(period=40.0))
    with pytest.raises(FitError, match="noise needs two"):
        repeated(recording(smooth, part=slice(0, 1100)), PERIOD)


def test_weights_need_a_resolution_and_effects_no_acceleration(smooth):
    with pytest.raises(FitError, match="resolution="):
        jaxid.fit(loop(), recording(smooth), jaxid.IntegralLS(weights="encoder"))
    with pytest.raises(FitError, match="rotor_inertia needs an acceleration"):
        jaxid.fit(loop().add(RotorInertia(joint=2)), recording(smooth), jaxid.IntegralLS())
