"""What a diagnosis says of a fit, and what it proposes to record next."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stories import Bump
from test_noise_floor import axis

import jaxid
from jaxid.control import Tracking
from jaxid.discovery.hypotheses import _inertia, candidates, survey
from jaxid.effects import Curve, Motion, QuadraticDrag, RotorInertia, Stribeck, TorqueOffset


@pytest.mark.xdist_group("offset")
def test_predicted_error_is_the_one_that_adding_leaves(offset_story):
    story, _ = offset_story
    start = story.first_diagnosis
    predicted = start.predicted_error(start.ranking[0])
    np.testing.assert_allclose(predicted, story.to_dict()["error_percent"]["after"]["fit"], 0.02)
    assert story.table().iloc[0, 1] > 1.1 * predicted[1]


@pytest.mark.xdist_group("bump")
def test_own_effect_is_screened_like_the_rest(bump_story):
    class AtHalf(Bump):
        @classmethod
        def screened(cls, scene):
            return [
                cls(joint=j, place=x, width=0.25)
                for j in scene.joints
                for x in np.linspace(scene.q_low[j - 1], scene.q_high[j - 1], 12)
            ]

    diagnosis = jaxid.diagnose(
        bump_story.steps[0].fit, catalogue=(*jaxid.catalogue, AtHalf), progress=False
    )
    best = diagnosis.ranking[0]
    assert (best.hypothesis.name, best.hypothesis.joint) == ("at_half", 2)
    assert diagnosis.best.place == best.hypothesis.effect.place


@pytest.mark.xdist_group("bump")
def test_results_show_themselves(bump_story):
    diagnosis = bump_story.first_diagnosis
    assert {"effect", "joint", "p_value", "amplitude"} <= set(diagnosis.table().columns)
    assert diagnosis.where_table().iloc[0]["coordinate"] == "q2"
    # A story keeps the signatures of its rankings alone; those of all curves are far more.
    assert diagnosis.data.table.width < 0.5 * len(diagnosis.gram.score)
    with pytest.raises(jaxid.errors.FitError, match="diagnose"):
        diagnosis.predicted_error(diagnosis.where[0])
    for figure in (
        diagnosis.plot(),
        diagnosis.plot_where(),
        diagnosis.plot_shares(joint=2),
        bump_story.plot(),
    ):
        assert any(axis.title.text for axis in figure.select_xaxes())
    assert "position of joint 2" in bump_story._repr_html_()


@pytest.mark.xdist_group("bump")
def test_samples_that_are_not_compared_are_not_drawn(bump_story):
    diagnosis = bump_story.first_diagnosis
    residual = diagnosis.data.residual.copy()
    residual[:, ::2] = 0.0
    left_out = dataclasses.replace(
        diagnosis, data=dataclasses.replace(diagnosis.data, residual=residual)
    )
    (drawn,) = (t for t in left_out.plot_where().data if t.name == "residual of joint 2")
    assert len(drawn.y) > 100
    assert not np.any(np.asarray(drawn.y) == 0)


def test_a_joint_that_is_held_still_has_shapes_to_screen():
    time = np.arange(50) * 0.01
    q = np.stack([np.sin(time), np.full(50, 0.3)], axis=1)
    record = jaxid.Recording(time, q, q, q_ref=q)
    rows, zero, v = jnp.asarray(q), jnp.asarray(0 * q), jnp.gradient(jnp.asarray(q), 0.01, axis=0)
    state, label = jnp.zeros((50, 0)), jnp.zeros(50, int)
    motion = jax.vmap(Motion)(jnp.asarray(time), rows, v, zero, rows, state, label)
    motion = jax.tree.map(lambda leaf: leaf[None], motion)
    scene = survey(jaxid.scara(), jaxid.Recordings.of(record), motion, [[1.0], [1.0]])
    settings = [effect for effect, _ in candidates(jaxid.catalogue, scene, 1.0)]
    assert {getattr(e, "joint", 2) for e in settings} == {1, 2}
    for effect in settings:
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(effect)), effect


def test_the_inertia_of_a_joint_includes_its_rotor():
    q = np.stack([np.linspace(0, 1, 50), np.linspace(-1, 1, 50)], axis=1)
    loop = jaxid.scara()
    bare = _inertia(loop, q)
    # A heavy rotor holds its joint, so the other one feels its own inertia only.
    whole = _inertia(loop.add(RotorInertia(joint=2, inertia=1e6)), q)
    mass = np.asarray([loop.arm.mass_matrix(jnp.asarray(x)) for x in q])
    np.testing.assert_allclose(whole[1], 1e6, rtol=1e-3)
    np.testing.assert_allclose(whole[0], mass[:, 0, 0].mean(), rtol=0.02)
    assert bare[0] < whole[0]


def test_a_short_recording_may_come_first():
    """Recordings are padded to the length of the longest."""
    whole, _ = axis(1)
    few = Stribeck, QuadraticDrag
    both = [axis(2, name="short")[0].slice(0.0, 4.0), whole]
    found = [
        jaxid.diagnose(
            jaxid.fit(jaxid.robots.emps(Tracking()), pair), catalogue=few, progress=False
        )
        for pair in (both, both[::-1])
    ]
    rank = "effect", "joint"
    one, other = (d.table().set_index([*rank])["explained_percent"] for d in found)
    assert np.allclose(one, other[one.index], rtol=1e-2)


def test_a_diagnosis_begins_where_its_fit_did():
    """At a first velocity that a parabola through noisy samples tells badly."""
    loop = jaxid.emps(jaxid.control.PD(Kp=[9e3], Kv=[600.0])).with_values(M=90.0, eps1=0.01)
    loop = dataclasses.replace(loop, freed=frozenset())
    time = np.arange(0, 3, 0.01)
    q_ref = 0.1 * np.sin(3 * time[:, None] + 1.0)
    run = jaxid.simulate(loop, jaxid.Recording(time, q_ref, q_ref, q_ref=q_ref))[0]
    noise = np.random.default_rng(0).standard_normal((2, len(time), 1))
    q, tau = np.asarray(run.q) + 2e-4 * noise[0], np.asarray(run.tau) + 0.1 * noise[1]
    fit = jaxid.fit(loop, jaxid.Recording(time, q, tau, q_ref=q_ref), jaxid.OEM(progress=False))
    for judged in (fit, jaxid.compare(fit, fit.recordings)):
        found = jaxid.diagnose(judged, catalogue=(TorqueOffset,), progress=False)
        left = found.data.residual[0, : len(time)]
        np.testing.assert_allclose(left, fit.residuals[0], atol=1e-3 * np.abs(left).max())


@pytest.mark.xdist_group("offset")
def test_unknown_catalogue_entry_is_refused(offset_story):
    story, _ = offset_story
    with pytest.raises(jaxid.errors.ModelError, match="cannot be screened"):
        jaxid.diagnose(story.steps[0].fit, catalogue=("stribeck",), progress=False)


@pytest.mark.xdist_group("offset")
def test_effect_given_as_an_object_is_screened(offset_story):
    story, _ = offset_story
    diagnosis = jaxid.diagnose(
        story.steps[0].fit, catalogue=(TorqueOffset(joint=2),), progress=False
    )
    assert [v.key for v in diagnosis.ranking] == [("torque_offset", 2)]
    assert diagnosis.ranking[0].p_value < 0.01
    assert not isinstance(diagnosis.best, Curve)


@pytest.mark.slow
@pytest.mark.xdist_group("offset")
def test_next_experiment_knows_a_band():
    """With the law unknown fewer rows are compared than a reference has samples."""
    folder = Path(jaxid.__file__).parent / "demo" / "hidden"
    recordings = jaxid.read(folder / "fit_1.csv", folder / "fit_2.csv")
    fit = jaxid.fit(jaxid.scara(jaxid.control.Tracking()), recordings)
    diagnosis = jaxid.diagnose(fit, progress=False)
    pair = [v for v in diagnosis.ranking if v.hypothesis.name in ("stribeck", "spring")][:2]
    proposed = jaxid.next_experiment(diagnosis, pair, tries=24, duration=12.0)
    assert np.isfinite(proposed.then)


def test_next_experiment_keeps_its_limits_and_separates(offset_story):
    story, _ = offset_story
    diagnosis = story.first_diagnosis
    pair = [v for v in diagnosis.ranking if v.key in (("torque_offset", 2), ("spring", 2))]
    proposed = jaxid.next_experiment(diagnosis, pair, tries=6, duration=6.0)
    limits = jaxid.Limits.of(diagnosis.fit.recordings)
    assert np.all(proposed.recording.q_ref >= limits.low - 1e-9)
    assert np.all(proposed.recording.q_ref <= limits.high + 1e-9)
    assert np.all(np.abs(proposed.recording.tau) <= 1.05 * limits.torque)
    assert proposed.then > 0
    better, worse = (dataclasses.replace(proposed, now=x * proposed.then) for x in (0.5, 1.0))
    assert "worth less" not in repr(better)
    assert "worth less than what is recorded" in repr(worse)
    torque = dataclasses.replace(diagnosis.fit.loop, controller=jaxid.control.OpenLoop())
    driven = dataclasses.replace(diagnosis, fit=dataclasses.replace(diagnosis.fit, loop=torque))
    with pytest.raises(jaxid.errors.FitError, match="cannot follow a reference"):
        jaxid.next_experiment(driven)


@pytest.mark.xdist_group("offset")
def test_an_experiment_for_a_transmission_is_refused(offset_story):
    story, _ = offset_story
    diagnosis = story.first_diagnosis
    shaft = next(v for v in diagnosis.ranking if v.key == ("joint_elasticity", 1))
    with pytest.raises(
        jaxid.errors.FitError, match="joint_elasticity on joint 1 needs simulations"
    ):
        jaxid.next_experiment(diagnosis, [diagnosis.ranking[0], shaft])


def test_limits_without_a_reference_are_not_those_of_the_noise():
    time = np.arange(0, 20, 1e-3)
    q = np.sin(time)[:, None]
    noise = 2e-4 * np.random.default_rng(0).standard_normal(q.shape)
    reached = jaxid.Limits.of([jaxid.Recording(time, q + noise, q)])
    assert 0.9 < reached.acceleration[0] < 1.5
