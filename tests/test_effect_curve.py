"""An effect's own curve, against its formula and what recordings of another simulator leave."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from stories import recordings_of

import jaxid
from jaxid.discovery import effect_curve
from jaxid.effects import Motion
from jaxid.errors import ModelError


@pytest.fixture(scope="module")
def fit(offset_case):
    """The model with Stribeck friction on joint 2, and none of it in the recordings."""
    loop = jaxid.scara().add(jaxid.effects.Stribeck(joint=2, level=0.02, velocity=0.3))
    used, _ = recordings_of(offset_case)
    return jaxid.fit(loop.hold("vs2"), used, jaxid.OEM(progress=False))


def test_a_curve_is_the_formula_with_the_deviation_of_what_is_linear(fit):
    found = effect_curve(fit, "stribeck")
    effect = fit.loop.effects[-1]
    level, velocity, eps = (float(x) for x in (effect.level, effect.velocity, effect.smoothing))
    shape = np.exp(-((found.x / velocity) ** 2)) * 2 / np.pi * np.arctan(found.x / eps)
    assert found.coordinate == "velocity of joint 2"
    assert found.units == ("rad/s", "N·m")
    assert not found.signed
    # Means over stretches of the velocity, a hundredth of its range wide.
    slow = np.abs(found.x) < 20 * eps
    assert found.torque[~slow] == pytest.approx(level * shape[~slow], abs=0.02 * abs(level))
    std = fit.std[fit.names.index("Fs2")]
    assert found.std[~slow] == pytest.approx(std * np.abs(shape[~slow]), abs=0.02 * std)
    assert found.share > 0.95
    assert len(found.cloud) == sum(len(r) for r in fit.residuals)


def test_the_cloud_is_the_residual_without_the_effect(fit):
    less = fit.loop.without("stribeck", 2)
    expected = np.concatenate(jaxid.compare(less, fit.recordings).residuals)[:, 1]
    assert effect_curve(fit, "stribeck", 2).cloud == pytest.approx(expected, abs=1e-9)


def test_friction_that_varies_with_position_is_shown_over_position():
    t = np.linspace(0, 20, 2001)
    q = 1.5 * np.sin(1.3 * t) + 0.3 * np.sin(4.1 * t)
    v = np.gradient(q, t)
    a = np.gradient(v, t)
    force = 95.0 * a + 200.0 * v + 20.0 * np.sign(v) + 5.0 * np.sin(q) * np.sign(v)
    record = jaxid.Recording.from_arrays(t, q, force, q_ref=q, name="one")
    loop = jaxid.emps(jaxid.control.Tracking()).add(
        jaxid.effects.PositionDependentFriction(joint=1)
    )
    fit = jaxid.fit(loop, record, jaxid.OEM(progress=False))
    found = effect_curve(fit, "position_dependent_friction")
    assert found.coordinate == "position of joint 1"
    assert found.signed
    # What the effect asks for at speed; where the joint turns, the sign of velocity is no step.
    rest, one, none = jnp.zeros(()), jnp.ones(1), jnp.zeros(1)
    expected = [
        fit.loop.effects[-1].torque(
            Motion(rest, jnp.asarray([x]), 1e3 * one, none, none, jnp.zeros(0), jnp.asarray(0))
        )[0]
        for x in found.x
    ]
    inside = np.abs(found.x) < 1.0
    size = np.abs(expected).max()
    assert found.torque[inside] == pytest.approx(np.array(expected)[inside], abs=0.1 * size)


@pytest.mark.parametrize("kind", ["by load", "with a lead"])
def test_what_an_effect_is_told_of_the_loop_is_told_to_its_curve(kind):
    """Friction by the load of a spring, and friction that is ahead of the recorded motion."""
    t = np.linspace(0, 20, 2001)
    q = 0.5 * np.sin(1.3 * t) + 0.1 * np.sin(4.1 * t)
    v, a = (np.gradient(np.gradient(q, t), t), np.gradient(q, t))[::-1]
    # The torque that passes the gear is 95 a + 300 q and the friction; 300 q is the load.
    ratio, lead, stiffness = 0.1, 0.02, 300.0
    link = 95.0 * a + stiffness * q
    both = (link + stiffness * q) / (1 - ratio * np.sign(v) * np.sign(link + stiffness * q))
    friction = ratio * np.abs(both) * np.sign(v)
    if kind == "with a lead":
        friction = 20.0 * np.sign(v + lead * a)
    force = link + friction
    record = jaxid.Recording.from_arrays(t, q, force, q_ref=q, name="one")
    loop = jaxid.emps(jaxid.control.Tracking()).add(
        jaxid.effects.Spring(joint=1, stiffness=stiffness)
    )
    if kind == "by load":
        loop = loop.add(jaxid.effects.GearFriction(joint=1, drive=ratio))
        found = effect_curve(jaxid.fit(loop, record, jaxid.OEM(progress=False)), "gear_friction")
        assert found.share > 0.8
        # Largest at the ends of the travel, where the spring is stretched most.
        assert np.abs(found.torque).max() == pytest.approx(np.abs(friction).max(), rel=0.15)
        return
    fit = jaxid.fit(loop.with_values(lead1=lead), record, jaxid.OEM(progress=False))
    found = effect_curve(fit, "coulomb")
    still = effect_curve(dataclasses.replace(fit, loop=fit.loop.with_values(lead1=0.0)), "coulomb")
    # Near a reversal the friction has changed its direction before the velocity has.
    assert np.abs(found.torque - np.interp(found.x, still.x, still.torque)).max() > 5.0


@pytest.mark.xdist_group("offset")
def test_a_story_draws_what_it_found(offset_story):
    story, _ = offset_story
    name = story.steps[-1].added.effect_name()
    found = story.curve(name, 2, story.steps[-1].held_out.recordings)
    band, line = found.plot().data[1:]
    assert np.asarray(line.y) == pytest.approx(found.torque)
    assert list(found.table().columns) == ["torque (N·m)", "std", "low", "high"]
    high = found.table()["high"].to_numpy()
    assert np.nanmax(np.asarray(band.y, float)) == pytest.approx(high.max(), rel=1e-5)
    assert max(map(len, repr(found).splitlines())) <= 80
    assert found.to_dict()["joint"] == 2


def test_what_has_no_curve_is_refused(fit):
    with pytest.raises(ModelError, match="there is no effect spring on joint 1 in the loop"):
        effect_curve(fit, "spring", 1)
