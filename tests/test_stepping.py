"""Batches of recordings, and how many steps their simulation takes."""

import dataclasses
import math

import diffrax
import independent as sim
import numpy as np
import pytest
from loops import (
    EMPS_VALUES,
    FINE,
    LINES,
    MOVES,
    SCARA_VALUES,
    TWO_LINK_GAINS,
    TWO_LINK_VALUES,
    plain,
    recorded,
    relative,
    scara,
    simulated,
)

import jaxid
from jaxid.control import PD, Sampled
from jaxid.errors import JaxidWarning, ModelError
from jaxid.simulation.stepping import RK4
from jaxid.simulation.steps import fastest_rate, set_substeps, sharpest, with_substeps

# Smoothing of a sign at the start of a fit, rad/s.
EPS = 0.02


@pytest.fixture(scope="module")
def rigid():
    """jaxid's run without any effect."""
    return simulated(scara())


@pytest.fixture(scope="module")
def lengths():
    """Two recordings, the second shorter and with uneven samples."""
    even, rng = plain(), np.random.default_rng(3)
    keep = np.unique(np.r_[0, rng.permutation(110)[:80], 110])
    cut = [getattr(even, signal)[keep] for signal in ("time", "q", "tau", "q_ref")]
    uneven = jaxid.Recording(*cut[:3], q_ref=cut[3], name="uneven")
    assert len(np.unique(np.diff(uneven.time).round(9))) > 2
    return recorded(even), uneven


@pytest.mark.parametrize("every", [None, 13e-3])
def test_recordings_in_a_batch_are_as_alone(lengths, every):
    law = PD(Kp=[6.25, 156.25], Kv=[2.0, 25.0], Kg=[3.5, 0.06])
    loop = scara(stepping=jaxid.Stepping(substeps=4))
    loop = dataclasses.replace(loop, controller=law if every is None else Sampled(law, every))
    together = jaxid.simulate(loop, lengths)
    for record, run in zip(lengths, together, strict=True):
        (alone,) = jaxid.simulate(loop, record)
        assert run.tau.shape == record.tau.shape
        np.testing.assert_array_equal(run.time, record.time)
        for signal in ("tau", "q", "v", "a", "delivered", "states"):
            # Programs of different size may round the last digit differently.
            here, there = getattr(run, signal), getattr(alone, signal)
            np.testing.assert_allclose(here, there, rtol=0, atol=1e-10)
    if every is not None:
        # Commands change at ticks alone, whenever the samples are.
        time, tau = lengths[1].time, together[1].tau
        same = np.diff(np.floor(time / every + 1e-9)) == 0
        assert same.any()
        np.testing.assert_array_equal(tau[1:][same], tau[:-1][same])
        np.testing.assert_allclose(together[1].tau[-1], together[0].tau[110], atol=1e-4)


def test_recording_of_a_few_samples():
    few = recorded(plain()).slice(0.0, 0.055)
    assert few.samples == 6
    assert simulated(scara(stepping=jaxid.Stepping(substeps=4)), few).tau.shape == (6, 2)


def test_uneven_samples_see_the_same_motion(lengths):
    even, uneven = jaxid.simulate(scara(stepping=jaxid.Stepping(substeps=8)), lengths)
    at = np.searchsorted(lengths[0].time, lengths[1].time - 1e-9)
    # The spline of the reference has gaps of up to 60 ms: its error, 1e-5 rad and less at
    # these rates, (60 ms)^4/384 · 6^4 · 0.2, times a gain of 22.
    np.testing.assert_allclose(uneven.tau, even.tau[at], atol=1e-3)


# --- integration ------------------------------------------------------------------------------


def test_adaptive_steps_agree_with_fixed_ones(rigid):
    stepping = jaxid.Stepping(
        solver=diffrax.Tsit5(), control=diffrax.PIDController(rtol=1e-9, atol=1e-11)
    )
    short = jaxid.Recording(*(getattr(recorded(plain()), s)[:61] for s in ("time", "q", "tau")))
    short = dataclasses.replace(short, q_ref=plain().q_ref[:61])
    run = simulated(scara(stepping=stepping), short)
    # Fixed steps of 1.25 ms; the two references are splines of different length.
    np.testing.assert_allclose(run.tau[:55], rigid.tau[:55], atol=1e-5)
    np.testing.assert_allclose(run.q[:55], rigid.q[:55], atol=1e-6)


def test_stages_in_a_loop_are_the_same_method():
    few = recorded(plain()).slice(0.0, 0.5)
    written, rolled = (
        simulated(scara(stepping=jaxid.Stepping(solver=RK4(rolled=way), substeps=4)), few)
        for way in (False, True)
    )
    np.testing.assert_allclose(rolled.tau, written.tau, rtol=1e-11)
    np.testing.assert_allclose(rolled.states, written.states, rtol=1e-11, atol=1e-14)


def default_error(loop, run):
    """What the default stepping leaves of the torque, relative, joint by joint."""
    assert loop.stepping.substeps is None
    return relative(simulated(loop, recorded(run)).tau, run.tau)


def test_default_steps_are_fine_enough_for_the_scara():
    assert np.all(default_error(scara(stepping=jaxid.Stepping()), plain()) < 1e-4)


def test_default_steps_are_fine_enough_for_the_two_link_arm():
    law = PD(**TWO_LINK_GAINS)
    loop = jaxid.two_link(law).with_values(**TWO_LINK_VALUES)
    run = sim.simulate(sim.TwoLink(), LINES, sim.PD(**TWO_LINK_GAINS), duration=1.5)
    assert np.all(default_error(loop, run) < 1e-4)


def emps_error(stepping):
    """What an axis of the EMPS's kind, under its cascade, leaves of the force, relative."""
    loop = dataclasses.replace(jaxid.emps().with_values(**EMPS_VALUES), stepping=stepping)
    law = sim.EmpsCascade(resolution=0.0)
    run = sim.simulate(sim.Axis(), MOVES, law, duration=0.9, sample=1e-3, step=2.5e-5)
    return relative(simulated(loop, recorded(run)).tau, run.tau)


def test_fine_steps_are_fine_enough_for_the_emps():
    assert np.all(emps_error(FINE) < 1e-4)


def test_default_steps_are_fine_enough_for_the_emps():
    assert np.all(emps_error(jaxid.Stepping()) < 1e-4)


def test_more_steps_where_the_loop_is_quicker(lengths):
    slow, recordings = jaxid.scara().with_values(**SCARA_VALUES), jaxid.Recordings.of(lengths)
    quick = slow.with_values(eps2=2e-4)
    # Coulomb friction at standstill: 2/pi Fc/eps over the inertia that joint 2 has on its own.
    lowest = 0.05 * 2 / math.pi * 5000 / 0.06
    assert lowest < fastest_rate(quick, recordings) < 2 * lowest
    assert with_substeps(slow, recordings).stepping.substeps == 4
    # A quarter of a time constant at most, in each 10 ms, however many that is.
    with pytest.warns(JaxidWarning, match="which are .* between two samples"):
        substeps = with_substeps(quick, recordings).stepping.substeps
    assert 64 < 0.01 * lowest / 0.25 <= substeps <= 2 * 0.01 * lowest / 0.25 + 1
    # Time constants do not bind an implicit method, and what is absurd is refused.
    implicit = dataclasses.replace(quick, stepping=jaxid.Stepping(solver=diffrax.Kvaerno3()))
    assert with_substeps(implicit, recordings).stepping.substeps == 4
    with pytest.raises(ModelError, match="more than 10000"):
        with_substeps(quick.with_values(eps2=1e-7), recordings)
    chosen = dataclasses.replace(slow, stepping=jaxid.Stepping(substeps=3))
    assert with_substeps(chosen, recordings).stepping.substeps == 3


def test_friction_that_starts_at_zero_limits_its_smoothing(lengths):
    """Otherwise a fit may reach a sign that no step resolves, along which derivatives diverge."""
    recordings = jaxid.Recordings.of(lengths)
    frictionless = jaxid.scara().with_values(**{**SCARA_VALUES, "Fc1": 0.0, "Fc2": 0.0})
    frictionless = frictionless.with_values(eps2=EPS).free("eps2")
    loop = with_substeps(frictionless, recordings)
    factor = sharpest(loop, recordings)
    level = 0.1 * np.sqrt(np.mean(np.concatenate([r.tau[:, 1] for r in recordings]) ** 2))
    least = factor * EPS
    step = 0.01 / loop.stepping.substeps
    # RK4 is stable up to 2.8 over the rate, 2/pi Fc/eps over the inertia of joint 2.
    assert step * level * 2 / math.pi / least / 0.06 < 2.8


def test_a_start_that_is_stiffer_than_the_optimum_costs_no_steps_afterwards():
    record = recorded(plain())
    start = jaxid.scara().with_values(**SCARA_VALUES, eps2=1e-3).free("eps2")
    before = with_substeps(start, jaxid.Recordings.of(record)).stepping.substeps
    fit = jaxid.fit(start, record, method=jaxid.OEM(start="given", progress=False))
    after = fit.loop.stepping.substeps
    assert fit.table()["value"]["eps2"] > 5e-3
    assert 2 * after <= before
    fine = set_substeps(fit.loop, 4 * before)
    (coarse,), (exact,) = jaxid.simulate(fit.loop, record), jaxid.simulate(fine, record)
    assert relative(coarse.tau, exact.tau).max() < 1.1e-4


def test_a_stiff_sign_that_is_estimated_needs_few_steps_afterwards():
    asked = recorded(plain())
    true = jaxid.scara().with_values(**SCARA_VALUES, eps1=1e-3, eps2=1e-3).free("eps1", "eps2")
    run = jaxid.simulate(true, asked)[0]
    record = dataclasses.replace(asked, q=run.q, tau=run.tau)
    before = with_substeps(true, jaxid.Recordings.of(record)).stepping.substeps
    method = jaxid.OEM(start="given", progress=False)
    fit = jaxid.fit(true, record, method=method)
    assert 2 * fit.loop.stepping.substeps <= before
    fine = set_substeps(fit.loop, 4 * before)
    (coarse,), (exact,) = jaxid.simulate(fit.loop, record), jaxid.simulate(fine, record)
    assert relative(coarse.tau, exact.tau).max() < 1.1e-4
    # A sign that is held may be released and become sharper, so its steps stay short.
    held = jaxid.fit(true.hold("eps1", "eps2"), record, method=method)
    assert held.loop.stepping.substeps == before


def test_long_intervals_are_filled_up():
    time = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 3.0, 0.01)])

    def at(time):
        q = np.stack([0.6 * np.sin(2 * time), 0.4 * np.sin(3 * time)], axis=1)
        return jaxid.Recording.from_arrays(time, q, np.cos(q), q_ref=q, gaps="allow")

    loop = jaxid.scara().with_values(**SCARA_VALUES)
    whole, gapped = at(np.arange(0, 3.0, 0.01)), at(time)
    expected, found = jaxid.simulate(loop, whole)[0], jaxid.simulate(loop, gapped)[0]
    assert len(found.time) == gapped.samples
    kept = np.searchsorted(whole.time, gapped.time - 1e-6)
    # A spline of the reference over half a second is not the reference itself.
    after = np.isin(gapped.time, gapped.time[gapped.time > 1.8])
    assert relative(found.tau[after], expected.tau[kept][after]).max() < 0.02
    fine = jaxid.simulate(dataclasses.replace(loop, stepping=jaxid.Stepping(substeps=32)), gapped)
    assert relative(found.tau, fine[0].tau).max() < 1e-3


def test_a_bristle_at_speed_asks_for_smaller_steps(lengths):
    recordings = jaxid.Recordings.of(lengths)
    stiff = jaxid.scara().add(jaxid.effects.Hysteresis(joint=2, level=0.1, slide=6e-4))
    speed = max(np.abs(np.diff(r.q[:, 1]) / np.diff(r.time)).max() for r in recordings)
    substeps = with_substeps(stiff, recordings).stepping.substeps
    # RK4 becomes unstable at 2.8 over the rate, which is speed over slide.
    assert 0.01 * speed / 6e-4 / substeps < 2.8
    # What was settled for a loop without it counts no longer; what a user has set does.
    before = with_substeps(jaxid.scara(), recordings)
    effect = stiff.effects[-1]
    assert with_substeps(before.add(effect), recordings).stepping.substeps > 4
    assert with_substeps(before, recordings).stepping == before.stepping
    set_by_user = dataclasses.replace(stiff, stepping=jaxid.Stepping(substeps=5))
    assert with_substeps(set_by_user, recordings).stepping.substeps == 5
    assert all(np.isfinite(run.tau).all() for run in jaxid.simulate(stiff, recordings))
