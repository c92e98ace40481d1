"""Noise filters and tests of whiteness, against closed forms and drawn noise."""

import warnings

import numpy as np
import pytest
from scipy import linalg, signal, stats

from jaxid.errors import NoiseError
from jaxid.noise import (
    ARFilter,
    VectorAR,
    autocorrelation,
    check_series,
    fit_ar,
    fit_var,
    innovations,
    ljung_box,
    orders,
)
from jaxid.noise.whiteness import levels

FOURTH = ARFilter.from_reflection(np.array([-0.9, 0.8, 0.1, -0.3]), 2.0)
SECOND = VectorAR(
    np.array([[[-1.2, 0.3], [0.1, -0.5]], [[0.6, 0.0], [0.0, 0.2]]]),
    np.array([[1.0, 0.5], [0.5, 2.0]]),
)


SECOND_ORDER = ARFilter.from_reflection(np.array([-0.8, 0.5]))


def spectrum_of(filt, size=512):
    """Power spectrum by SciPy, from the poles alone."""
    _, response = signal.freqz([1.0], filt.polynomial, worN=size, whole=True)
    return filt.variance * np.abs(response) ** 2


def test_reflection_coefficients_there_and_back():
    assert np.allclose(FOURTH.reflection, [-0.9, 0.8, 0.1, -0.3])
    assert np.allclose(FOURTH.spectrum(512), spectrum_of(FOURTH))
    # The variance is the mean of the spectrum (Wiener, Khinchin).
    assert np.isclose(FOURTH.gain * FOURTH.variance, spectrum_of(FOURTH, 8192).mean(), rtol=1e-6)
    with pytest.raises(NoiseError, match="between -1 and 1"):
        ARFilter.from_reflection(np.array([0.2, -1.0]))


def test_an_unstable_filter_is_seen_and_turned_stable_with_its_spectrum():
    poles = np.array([1.05 * np.exp(0.6j), 1.05 * np.exp(-0.6j), 0.5])
    wild = ARFilter(np.real(np.poly(poles))[1:], 1.5)
    assert not wild.stable
    assert wild.gain == np.inf
    calm = wild.stabilised()
    assert calm.stable
    assert np.allclose(spectrum_of(wild), spectrum_of(calm))
    drawn = wild.simulate((4, 3000), np.random.default_rng(0))
    assert np.isclose(drawn.var(), calm.gain * calm.variance, rtol=0.2)


def test_noise_is_stationary_from_the_first_sample_on():
    drawn = FOURTH.simulate((20_000, 3), np.random.default_rng(1))
    wanted = FOURTH.gain * FOURTH.variance
    # Variances of normal numbers: deviation sqrt(2 / draws), four of them.
    assert np.all(np.abs(drawn.var(axis=0) / wanted - 1) < 4 * np.sqrt(2 / 20_000))


@pytest.mark.parametrize("samples", [150, 700])
def test_burg_finds_the_filter_within_its_deviations_over_recordings(samples):
    rng = np.random.default_rng(2)
    estimates = [
        fit_ar(list(FOURTH.simulate((3, samples), rng)), 4).coefficients for _ in range(100)
    ]
    # Cramér and Rao: variance · inverse autocovariance matrix / samples.
    lags = np.fft.ifft(spectrum_of(FOURTH, 4096)).real[:4]
    bound = np.sqrt(np.diag(np.linalg.inv(linalg.toeplitz(lags))) * FOURTH.variance / (3 * samples))
    ratio = np.std(estimates, axis=0) / bound
    assert np.all((ratio > 0.75) & (ratio < 1.3))
    bias = (np.mean(estimates, axis=0) - FOURTH.coefficients) / bound
    assert np.abs(bias).max() < 0.6


def test_a_filter_does_not_run_across_the_ends_of_recordings():
    x = FOURTH.simulate((400,), np.random.default_rng(3))
    apart = fit_ar([x[:200], x[200:] + 1e3 * np.sign(x[200])], 4)
    whole = fit_ar([x[:200], x[:200]], 4)
    alone = fit_ar([x[:200]], 4)
    assert np.allclose(whole.coefficients, alone.coefficients)
    assert apart.stable


@pytest.mark.parametrize("criterion", ["aic", "aicc", "bic"])
def test_the_order_is_found(criterion):
    rng = np.random.default_rng(4)
    chosen = [
        fit_ar(list(FOURTH.simulate((2, 600), rng)), criterion=criterion, white=0.05).order
        for _ in range(60)
    ]
    # Shibata 1976: AIC takes the right order in about 71 % and otherwise more; BIC nearly always.
    right = np.mean(np.array(chosen) == 4)
    assert min(chosen) >= 4
    assert right > (0.9 if criterion == "bic" else 0.5)


def test_whiteness_is_a_condition_of_the_order():
    far = ARFilter.from_reflection(np.r_[np.zeros(11), 0.2])
    x = list(far.simulate((2, 700), np.random.default_rng(5)))
    table = orders(x)
    # A single far lag costs BIC more than it explains, but is not white.
    cheap = fit_ar(x, criterion="bic")
    asked = fit_ar(x, criterion="bic", white=0.05)
    assert asked.order >= cheap.order
    assert table["ljung_box_p"][asked.order] > 0.05
    assert list(table.columns) == ["variance", "aic", "aicc", "bic", "ljung_box_p"]
    assert np.all(np.diff(table["variance"]) <= 0)


def test_ljung_box_is_the_published_formula():
    x = np.random.default_rng(6).standard_normal(300)
    rho = np.array([x[k:] @ x[: 300 - k] / (x @ x) for k in range(1, 11)])
    wanted = 300 * 302 * np.sum(rho**2 / (300 - np.arange(1, 11)))
    test = ljung_box([x], 10, 3)
    assert np.isclose(test.statistic, wanted)
    assert test.freedom == 7
    assert np.isclose(test.p_value, stats.chi2.sf(wanted, 7))


def test_ljung_box_p_values_are_true_on_filtered_recordings():
    rng = np.random.default_rng(7)
    p = []
    for _ in range(400):
        series = list(FOURTH.simulate((2, 1000), rng))
        filt = fit_ar(series, 4)
        p.append(ljung_box([filt.whiten(x)[4:] for x in series], 38, 4).p_value)
    # Binomial deviations: 1.1 % at 5 %, 2.5 % at 50 %; three and a half of them.
    assert 0.012 < np.mean(np.array(p) < 0.05) < 0.09
    assert 0.41 < np.mean(np.array(p) < 0.5) < 0.59


def test_a_loud_recording_does_not_stand_for_all():
    rng = np.random.default_rng(8)
    loudness = np.array([1.0, 1.0, 1.0, 10.0])[:, None]
    drawn = [list(loudness * rng.standard_normal((4, 600))) for _ in range(400)]
    rejected = np.mean([ljung_box(series).p_value < 0.05 for series in drawn])
    # 400 tests at 5 %: deviation 1.1 %.
    assert 0.015 < rejected < 0.085
    coloured = [list(loudness * SECOND_ORDER.simulate((4, 600), rng)) for _ in range(60)]
    assert np.median([fit_ar(series, white=0.05).order for series in coloured]) <= 3
    pooled = fit_ar(coloured[0], 2)
    assert np.isclose(pooled.gain * pooled.variance, np.var(coloured[0]), rtol=0.1)
    both = [np.stack([x, 5 * x[::-1]], axis=1) for x in drawn[0]]
    assert np.allclose(np.diag(fit_var(both, 0).covariance), np.mean(np.square(both), (0, 1)))


def test_two_sigma_bounds_hold_for_white_series():
    rng = np.random.default_rng(8)
    outside = []
    for _ in range(100):
        acf, bound = autocorrelation(list(rng.standard_normal((2, 500))), 38)
        outside.append(np.mean(np.abs(acf[1:]) > bound))
    assert 0.03 < np.mean(outside) < 0.06


def test_a_vector_filter_is_found_and_stable():
    drawn = SECOND.simulate((6, 1500), np.random.default_rng(9))
    # The covariance of the process solves Lyapunov's equation.
    q = np.zeros((4, 4))
    q[:2, :2] = SECOND.covariance
    wanted = linalg.solve_discrete_lyapunov(SECOND.companion, q)[:2, :2]
    assert np.allclose(np.cov(drawn.reshape(-1, 2).T), wanted, rtol=0.15, atol=0.1)
    found = fit_var(list(drawn), 2)
    assert found.stable
    assert np.abs(found.coefficients - SECOND.coefficients).max() < 0.05
    assert np.allclose(found.covariance, SECOND.covariance, rtol=0.06)
    assert 2 <= fit_var(list(drawn), criterion="bic").order <= 3
    e = np.concatenate([innovations(x, SECOND)[2:] for x in drawn])
    assert np.allclose(np.cov(e.T), SECOND.covariance, rtol=0.06)


def test_one_output_alone_is_burg():
    series = list(FOURTH.simulate((2, 300), np.random.default_rng(10)))
    one, many = fit_ar(series, 4), fit_var([x[:, None] for x in series], 4)
    assert np.allclose(many.coefficients[:, 0, 0], one.coefficients)
    assert np.isclose(many.covariance[0, 0], one.variance)


@pytest.mark.parametrize(
    ("series", "order", "says"),
    [
        ([np.ones(100)], 2, "constant"),
        ([np.random.default_rng(0).standard_normal(40)], 60, "too few for the noise filter"),
        ([np.random.default_rng(0).standard_normal(40)], 20, "lower the order"),
        ([np.array([1.0, np.nan, 2.0] * 20)], 2, "not finite"),
        ([np.random.default_rng(0).standard_normal(40)], -1, "0 or more"),
    ],
)
def test_what_has_no_filter_is_refused(series, order, says):
    with pytest.raises(NoiseError, match=says):
        check_series(series, order, "joint 1's torque")
    with pytest.raises(NoiseError, match=says):
        fit_ar(series, order)


def test_the_level_of_a_residual_that_overflows_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        huge, usual = levels([np.full((5, 1), 1e200), np.ones((5, 1))])
    assert not np.isfinite(huge).any()
    assert usual == 0.0


def in_stretches(x, every=60, absent=17):
    """A series of which pieces are not compared, and the samples that are."""
    there = np.arange(len(x)) % every >= absent
    return np.where(there, x, 0.0), there


def test_innovations_in_stretches_give_the_likelihood_of_each():
    x, there = in_stretches(FOURTH.simulate((2000,), np.random.default_rng(20)))
    e = FOURTH.innovations(x, there)
    assert np.all(e[~there] == 0.0)
    lags = np.fft.ifft(spectrum_of(FOURTH, 1 << 14)).real
    expected, at = 0.0, np.flatnonzero(there)
    for one in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
        covariance = linalg.toeplitz(lags[: len(one)])
        expected += np.linalg.slogdet(covariance)[1]
        expected += x[one] @ np.linalg.solve(covariance, x[one])
    found = there.sum() * np.log(FOURTH.variance) + FOURTH.starts(there)
    assert found + np.sum(e**2) / FOURTH.variance == pytest.approx(expected, rel=1e-6)
    both = FOURTH.innovations(np.stack([x, 2 * x], axis=1), there)
    np.testing.assert_allclose(both, np.stack([e, 2 * e], axis=1))


def test_burg_leaves_out_samples_that_are_not_compared():
    rng = np.random.default_rng(21)
    runs = [in_stretches(x)[0] for x in FOURTH.simulate((20, 3000), rng)]
    found = [fit_ar([x], criterion="bic") for x in runs]
    assert np.mean([f.order == 4 for f in found]) > 0.8
    at_fourth = np.array([fit_ar([x], 4).coefficients for x in runs])
    error = at_fourth.std(axis=0) / np.sqrt(len(runs))
    assert np.all(np.abs(at_fourth.mean(axis=0) - FOURTH.coefficients) < 4 * error)
    assert np.mean([f.variance for f in found]) == pytest.approx(FOURTH.variance, rel=0.05)
    # Stretches that are too short do not determine a long filter.
    assert fit_ar([in_stretches(runs[0], every=6, absent=2)[0]], criterion="aic").order <= 1
