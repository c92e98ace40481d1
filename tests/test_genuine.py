"""Fitted effects whose values are those of another effect."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stories import recordings_of, scene_of, search_of

import jaxid
from jaxid.discovery.hypotheses import survey
from jaxid.effects import (
    EndStop,
    Hysteresis,
    LuGre,
    Motion,
    Stribeck,
    ThermalDrift,
    TorqueRipple,
    Viscous,
)


@pytest.mark.parametrize(
    ("level", "velocity", "exponent", "viscous", "expected"),
    [
        # A peak at low speed, also if the friction rises everywhere.
        (1.0, 0.1, 2.0, 20.0, True),
        (1.0, 0.6, 1.0, 20.0, True),
        # Slow motion, in which friction falls up to the highest speed.
        (1.0, 5.0, 1.0, 0.1, True),
        # A bend of a rising curve: 3.85 v + 8.36 exp(-(v/3.29)^1.1), which a drag explains.
        (8.36, 3.29, 1.1, 3.85, False),
        (1.0, 1.5, 2.0, 20.0, False),
    ],
)
def test_a_stribeck_term_ends_or_falls(level, velocity, exponent, viscous, expected):
    term = Stribeck(joint=1, level=level, velocity=velocity, exponent=exponent)
    beside = [Viscous(joint=1, coefficient=viscous), Viscous(joint=2, coefficient=99.0)]
    assert term.genuine(scene_of(3.0), beside) is expected


@pytest.mark.parametrize(
    ("side", "share", "expected"),
    # Parts of the travel over which the stop acts; the last one ends beyond it.
    [(1, 0.1, True), (-1, 0.1, True), (-1, 0.6, True), (1, 0.9, False), (-1, 1.2, False)],
)
def test_a_stop_leaves_a_part_of_the_travel_free(side, share, expected):
    scene = scene_of(3.0)
    low, high, travel = float(scene.q_low[0]), float(scene.q_high[0]), scene.travel(1)
    angle = high - share * travel if side > 0 else low + share * travel
    stop = EndStop(joint=1, stiffness=40.0, angle=angle, side=side)
    assert stop.genuine(scene, []) is expected


@pytest.mark.parametrize(("waves", "expected"), [(0.7, False), (1.4, True), (9.0, True)])
def test_a_ripple_has_more_than_a_wave(waves, expected):
    scene = scene_of(3.0)
    ripple = TorqueRipple(joint=1, harmonic=2 * np.pi * waves / scene.travel(1))
    assert ripple.genuine(scene, []) is expected


@pytest.mark.parametrize("kind", [Hysteresis, LuGre])
def test_a_bristle_bends_for_longer_than_a_sample(kind):
    """Compared with the way of a sine within a sample after its reversal."""
    scene = scene_of(3.0)
    amplitude = scene.travel(1) / 2
    rate = float(scene.speed[0]) / amplitude
    way = amplitude * (1 - np.cos(rate * scene.period))
    assert kind(joint=1, slide=1.01 * way).genuine(scene, [])
    assert not kind(joint=1, slide=0.99 * way).genuine(scene, [])


@pytest.mark.parametrize(
    ("returned", "expected"),
    # The joint moves back after these times, s; zero if it never does.
    [((), True), ((0.0,), True), ((2.0,), True), ((6.0,), False)],
)
def test_a_drift_acts_in_both_directions(returned, expected):
    scene = dataclasses.replace(scene_of(3.0), returned=returned)
    assert ThermalDrift(joint=1, time_constant=2.0).genuine(scene, []) is expected


def test_the_time_of_motion_in_both_directions_is_that_of_the_first_recording(offset_case):
    loop, (fitting, _) = jaxid.scara(), recordings_of(offset_case)
    t = np.tile(np.arange(0, 4, 0.01), (2, 1))
    v = np.stack([np.sin(2 * np.pi * t / period) for period in (2.0, 6.0)], axis=-1)
    v[1] = 0.01

    def at(t, v):
        return Motion(t, q=v, v=v, a=v, tau=v, state=jnp.zeros(0), label=jnp.array(0))

    along = jax.vmap(jax.vmap(at))
    tones = ((), ())
    both = survey(loop, fitting, along(jnp.array(t), jnp.array(v)), tones).returned
    assert both == pytest.approx((1.0, 3.0), abs=0.06)
    assert survey(loop, fitting, along(jnp.array(t), jnp.abs(v)), tones).returned == (0.0, 0.0)


@pytest.mark.xdist_group("offset")
def test_a_term_that_approximates_another_effect_is_not_taken(offset_case, offset_story):
    """Its fit is discarded, however good it is, and a note says why."""
    search, story = search_of(offset_case), offset_story[0]
    search.visit((), story.steps[0].fit)
    search.diagnoses[()] = story.steps[0].diagnosis
    bend = Stribeck(joint=1, level=1e-3, velocity=1e3)
    fit = story.steps[0].fit
    last = dataclasses.replace(fit, loop=fit.loop.add(bend))
    found = last.loop.effects[-1]
    assert search.not_genuine(last) == (found,)
    assert search.failures == (
        "stribeck on joint 1: the fitted values are those of another effect",
    )
