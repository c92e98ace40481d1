"""Values that a model holds by default: the smoothing of a sign, its form, the lead of friction.

Torque is that of inverse dynamics written out here, along motions in closed form.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.likelihood import noise_filters
from jaxid.discovery.predict import Predictor
from jaxid.discovery.release import doubtful, released
from jaxid.discovery.signs import from_usual_signs, has_one_sign, of_one_sign
from jaxid.discovery.system import System
from jaxid.discovery.verify import Refits
from jaxid.effects import (
    AsymmetricFriction,
    Coulomb,
    Motion,
    Stribeck,
    TorqueOffset,
    Viscous,
    smooth_sign,
)
from jaxid.noise import ARFilter

MASS, DRAG, DRY, STIFF = 5.0, 4.0, 3.0, 8.0


def test_a_smoothed_sign_is_a_half_at_its_smoothing_and_a_sign_at_none():
    v = jnp.array([-0.3, -0.02, 0.02, 0.3])
    for form in (0.0, 0.4, 1.0, 1.3, 1.5):
        half = smooth_sign(jnp.asarray(0.02), jnp.asarray(0.02), jnp.asarray(form))
        assert float(half) == pytest.approx(0.5, rel=1e-12)
        sharp = smooth_sign(v, jnp.asarray(0.0), jnp.asarray(form))
        np.testing.assert_allclose(sharp, np.sign(v), atol=1e-12)
        assert float(smooth_sign(jnp.asarray(0.0), jnp.asarray(0.0), jnp.asarray(form))) == 0
    # The last form is a ramp up to its corners, and none exceeds one visibly.
    ramp = smooth_sign(jnp.linspace(-0.03, 0.03, 13), jnp.asarray(0.02), jnp.asarray(1.5))
    np.testing.assert_allclose(ramp, np.linspace(-0.75, 0.75, 13), atol=0.01)
    for form in np.linspace(0.0, 1.5, 16):
        rise = np.asarray(
            smooth_sign(jnp.linspace(0, 1, 400), jnp.asarray(0.02), jnp.asarray(form))
        )
        assert rise.max() < 1.004
    # At its bound the derivative is that of arctan2: a search that went there finds the way back.
    slope = jax.grad(lambda eps: smooth_sign(jnp.asarray(0.02), eps))(0.0)
    assert float(slope) == pytest.approx(-2 / np.pi / 0.02, rel=1e-9)


def axis(smoothing=0.01):
    effects = Viscous(1, 1.0), Coulomb(1, 1.0, smoothing=smoothing), TorqueOffset(1)
    return jaxid.ClosedLoop(jaxid.arms.Axis(M=MASS), Tracking(cutoff=20.0), effects, name="axis")


def recorded(seed, sign, spring=0.0, late=0.0, noise=0.01):
    """An axis moved by sines, its torque that of the motion `late` s later."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 12.0, 0.004)
    rates = 2 * np.pi * np.array([0.23, 0.61, 1.3]) * rng.uniform(0.9, 1.1, 3)
    sizes, phases = np.array([0.08, 0.03, 0.01]), rng.uniform(0, 6, 3)

    def motion(t, order):
        turned = t[:, None] * rates + phases + order * np.pi / 2
        return (sizes * rates**order * np.sin(turned)).sum(axis=1)

    q, v, a = (motion(time + late, k) for k in range(3))
    tau = MASS * a + DRAG * v + DRY * sign(v) + spring * q
    tau = tau + noise * rng.standard_normal(len(time))
    return jaxid.Recording.from_arrays(time, motion(time, 0), tau, name=f"run_{seed}")


def tanh(v):
    return np.tanh(v / 0.004)


def arctan(v):
    return 2 / np.pi * np.arctan(v / 0.01)


def predictor(recordings, loop=None):
    fit = jaxid.fit(loop or axis(), recordings, jaxid.OEM(progress=False))
    system = System.of(fit)
    noise = [ARFilter(np.zeros(0), float(np.var(system.residual[system.mask])))]
    return Predictor.of(system, noise)


def test_held_values_are_in_doubt_unless_a_user_held_them():
    assert [p.name for p in doubtful(axis())] == ["eps1", "form1", "lead1"]
    assert [p.name for p in doubtful(axis().free("eps1"))] == ["form1", "lead1"]
    assert [p.name for p in doubtful(axis().hold("form1"))] == ["eps1", "lead1"]


def test_nothing_is_released_where_the_default_is_right():
    assert released(predictor([recorded(1, arctan), recorded(2, arctan)]), 20.0) is None


def test_a_wrong_smoothing_is_released():
    found = released(predictor([recorded(1, tanh), recorded(2, tanh)]), 20.0)
    assert found is not None
    assert "eps1" in found.loop.names
    fit = jaxid.fit(found.loop.free("form1"), [recorded(1, tanh)], jaxid.OEM(progress=False))
    table = fit.table()
    # tanh is a half where its argument is artanh(1/2).
    assert table.loc["eps1", "value"] == pytest.approx(0.004 * np.arctanh(0.5), rel=0.02)
    assert table.loc["form1", "value"] > 0.95
    assert table.loc["Fc1", "value"] == pytest.approx(DRY, rel=0.01)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_how_friction_by_direction_begins_near_standstill_is_released(exponent):
    """The difference of the directions has the shape of the sign, or is smooth at standstill."""

    def differs(v):
        return arctan(v) + 0.3 * np.abs(arctan(v)) ** exponent

    runs = [recorded(1, differs), recorded(2, differs)]
    loop = axis().without("torque_offset").add(AsymmetricFriction(joint=1, coulomb=1.0))
    found = released(predictor(runs, loop), 20.0)
    assert (found is None) == (exponent == 1.0)
    table = jaxid.fit(loop.free("da1"), runs, jaxid.OEM(progress=False)).table()
    assert table.loc["da1", "value"] == pytest.approx(exponent, rel=0.05)
    assert table.loc["dFc1", "value"] == pytest.approx(0.3 * DRY, rel=0.02)


def test_the_exponent_of_a_stribeck_curve_is_released():
    """The torque falls as an exponential of speed, not as a Gaussian."""
    width = 0.004 * np.arctanh(0.5)

    def falls(v):
        return tanh(v) * (1 + 0.6 * np.exp(-np.abs(v / 0.03)))

    runs = [recorded(1, falls), recorded(2, falls)]
    frictions = (
        Coulomb(1, 3.0, smoothing=width, form=1.0),
        Stribeck(1, 1.0, 0.03, smoothing=width, form=1.0),
    )
    loop = axis().without("coulomb").add(*frictions)
    found = released(predictor(runs, loop), 20.0)
    assert found is not None
    assert "ds1" in found.loop.names
    table = jaxid.fit(found.loop, runs, jaxid.OEM(progress=False)).table()
    for name, true in (("ds1", 1.0), ("Fs1", 0.6 * DRY), ("vs1", 0.03)):
        assert table.loc[name, "value"] == pytest.approx(true, abs=5 * table.loc[name, "std"])
        assert table.loc[name, "std"] < 0.1 * true


@pytest.mark.parametrize("sharp", [0.002, 0.03])
def test_a_peak_of_friction_has_the_sign_that_is_estimated_beside_it(sharp):
    """One fit estimates the sign beside a peak that has the sign of the model before."""
    width, fall = 0.012, 0.05

    def falls(v):
        return 2 / np.pi * np.arctan(v / width) * (1 + 1.5 * np.exp(-((v / fall) ** 2)))

    runs = jaxid.Recordings.of([recorded(1, falls), recorded(2, falls)])
    loop = of_one_sign(axis(sharp).free("eps1").add(Stribeck(1, 1.0, 0.03)))
    once = jaxid.fit(loop, runs, jaxid.OEM(start="given", progress=False))
    assert not has_one_sign(once.loop)
    assert abs(once.table().loc["Fs1", "value"] / (1.5 * DRY) - 1) > 0.1
    noise = [ARFilter(np.zeros(0), 1e-4)]
    found = Refits(runs, jaxid.OEM(progress=False)).filtered(loop, noise)
    assert has_one_sign(found.loop)
    for name, true in (("Fs1", 1.5 * DRY), ("vs1", fall), ("eps1", width)):
        assert found.table().loc[name, "value"] == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_a_stribeck_curve_has_its_values_and_derivatives_at_rest(exponent):
    def torque(exponent, v):
        zeros, label = jnp.zeros(1), jnp.asarray(0)
        motion = Motion(jnp.zeros(()), zeros, v[None], zeros, zeros, jnp.zeros(0), label)
        return Stribeck(1, 2.0, 0.1, exponent, smoothing=0.0).torque(motion)[0]

    fast = torque(exponent, jnp.asarray(0.15))
    assert float(fast) == pytest.approx(2 * np.exp(-(1.5**exponent)), rel=1e-9)
    for v in (0.0, 0.15):
        by_exponent, by_speed = jax.grad(torque, argnums=(0, 1))(exponent, jnp.asarray(v))
        assert np.isfinite([by_exponent, by_speed]).all()
    assert float(by_exponent) == pytest.approx(-fast * 1.5**exponent * np.log(1.5), rel=1e-9)


@pytest.mark.parametrize("late", [0.0007, -0.003, 0.015])
def test_a_fit_estimates_the_delay_of_the_torque(late):
    runs = [recorded(k, arctan, late=late) for k in (1, 2)]
    table = jaxid.fit(axis(), runs, jaxid.OEM(progress=False)).table()
    for name, true in (("delay", late), ("Fv1", DRAG), ("Fc1", DRY), ("M", MASS)):
        assert table.loc[name, "value"] == pytest.approx(true, abs=3 * table.loc[name, "std"])
        assert table.loc[name, "std"] < 0.01 * max(abs(true), 0.01)


def test_friction_that_precedes_velocity_is_released():
    """The dry friction of a soft constraint: a ramp of the velocity that the joint would reach."""
    lead, corner = 0.0095, 0.03

    def soft(v):
        ahead = v + lead * np.gradient(v, 0.004)
        return np.clip(ahead / corner, -1, 1)

    runs = [recorded(k, soft) for k in (6, 7)]
    loop = axis().with_values(eps1=corner / 2, form1=1.5)
    found = released(predictor(runs, loop.free("eps1")), 20.0)
    assert found is not None
    assert "lead1" in found.loop.names
    table = jaxid.fit(found.loop, runs, jaxid.OEM(progress=False)).table()
    assert table.loc["lead1", "value"] == pytest.approx(lead, abs=4 * table.loc["lead1", "std"])
    assert table.loc["lead1", "std"] < 0.001


def test_a_lead_of_friction_acts_only_along_an_imposed_motion():
    loop = axis().with_values(lead1=0.0095)
    run = recorded(8, tanh)
    along = [jaxid.simulate(x, run)[0].tau for x in (loop, axis())]
    assert np.abs(along[0] - along[1]).max() > 0.1 * DRY
    law = jaxid.control.PD(Kp=[400.0], Kv=[40.0])
    reference = jaxid.Recording.from_arrays(run.time, run.q, run.tau, q_ref=run.q)
    moved = [
        jaxid.simulate(dataclasses.replace(x, controller=law), reference)[0].tau
        for x in (loop, axis())
    ]
    np.testing.assert_array_equal(*moved)


@pytest.mark.slow
def test_another_friction_curve_is_no_further_effect():
    """A spring in an axis whose sign of velocity is a tanh: the spring alone is added."""
    runs = [recorded(k, tanh, spring=STIFF) for k in (3, 4)]
    unseen = recorded(5, tanh, spring=STIFF)
    story = jaxid.discover(axis(), runs, validate=unseen, progress=False)
    assert story.verdict == "explained"
    assert [(a["effect"], a["joint"]) for a in story.to_dict()["added"]] == [("spring", 1)]
    assert any("eps1 was estimated" in note for note in story.notes)
    with pytest.raises(jaxid.errors.RecordingError, match="a model must be tested"):
        jaxid.discover(axis(), runs, validate=runs[0], progress=False)


def test_where_a_joint_stands_still_its_torque_is_not_compared():
    time = np.arange(0.0, 8.0, 0.005)
    q = 0.2 * np.clip(time - 1, 0, 2) - 0.1 * np.clip(time - 5, 0, 1)
    moving = (time > 1) & (time < 3) | (time > 5) & (time < 6)
    held = 2.0 * np.sin(time) * ~moving  # what friction lets the drive do at rest
    tau = np.sign(np.gradient(q)) * 1.0 * moving + held
    record = jaxid.Recording.from_arrays(time, q, tau + 1e-3 * np.cos(40 * time))
    found = jaxid.Standstill().moving(record, 20.0)
    away = np.abs(time[:, None] - [1, 3, 5, 6]).min(axis=1) > 0.1
    np.testing.assert_array_equal(found[away, 0], moving[away])
    assert jaxid.Standstill(still=0.0).moving(record, 20.0).all()
    law = Tracking(cutoff=20.0)
    loop = jaxid.ClosedLoop(jaxid.arms.Axis(), law, (Viscous(1), Coulomb(1)), name="axis")
    fit = jaxid.fit(loop, record, jaxid.OEM(progress=False))
    still = np.mean(np.concatenate(fit.residuals) == 0)
    assert 0.5 < still < 0.7


def test_a_fit_that_ends_at_a_jump_is_repeated_from_a_usual_sign():
    def root(v):
        return v / np.sqrt(v**2 + 0.002**2)

    refits = Refits(jaxid.Recordings.of([recorded(k, root) for k in (1, 2)]), jaxid.OEM())
    noise = [ARFilter(np.zeros(0), 1e-4)]
    jumps = axis(smoothing=0.0).free("eps1", "form1").with_values(form1=1.5, Fc1=DRY, Fv1=DRAG)
    # Values with a prior have weights that are estimated in further rounds, which may free the fit.
    jumps = jumps.hold("offset1", "delay")
    stuck = jaxid.fit(
        jumps, refits.recordings, jaxid.SeparablePEM(refits.given(), filters=tuple(noise))
    )
    assert stuck.table().loc["eps1", "value"] < 1e-6
    found = refits.filtered(jumps, noise)
    assert np.all(found.error_percent < 0.6 * stuck.error_percent)
    table = found.table()
    for name, true in (("form1", 0.5), ("Fc1", DRY), ("Fv1", DRAG)):
        assert table.loc[name, "value"] == pytest.approx(true, abs=4 * table.loc[name, "std"])


def test_only_a_sign_at_an_end_of_its_shapes_starts_from_a_usual_one():
    loop = axis(smoothing=0.005).free("eps1", "form1")
    assert from_usual_signs(loop.with_values(form1=1.2)) is None
    ramp = from_usual_signs(loop.with_values(form1=1.5))
    assert ramp is not None
    values = {p.name: float(np.asarray(p.where(ramp))) for p in ramp.parameters}
    assert values["form1"] == 0.5
    assert values["eps1"] > 0.005


def test_noise_does_not_determine_the_delay():
    """Noise of a third of the torque: the delay of the smallest noise is not that of the motion."""
    runs = jaxid.Recordings.of([recorded(k, arctan, noise=2.0) for k in (1, 2)])
    plain = jaxid.fit(axis(), runs, jaxid.OEM(progress=False))
    for fit in (
        plain,
        Refits(runs, jaxid.OEM()).filtered(plain.loop, noise_filters(plain.residuals)),
    ):
        value, std = fit.table().loc["delay", ["value", "std"]]
        assert abs(value) < 3 * std
        assert 5e-4 < std < 5e-3
