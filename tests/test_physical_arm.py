"""Links that are physical bodies whatever their parameters are, with torque from Pinocchio."""

import dataclasses
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from loops import four_joints

import jaxid
from jaxid.arms import BODY, PhysicalArm, SerialArm, in_base_parameters
from jaxid.arms.physical import pseudo_inertia, smallest_eigenvalues
from jaxid.control import Tracking
from jaxid.errors import ModelError
from jaxid.estimate.drawn import contradiction
from tests.test_prior import NOISE, VISCOUS, motion
from tests.test_serial import described as described

MASS = BODY.index("M")
BODIES = eqx.filter_jit(lambda arm: arm.inertias())


def moved(arm, deformation):
    return dataclasses.replace(arm, deformation=jnp.asarray(deformation).ravel())


@cache
def loop(uncertainty=0.2):
    """An arm whose bodies and viscous friction are estimated."""
    made = jaxid.serial(
        four_joints(),
        Tracking(cutoff=8.0),
        rotors=(0.0,) * 4,
        bodies="physical",
        uncertainty=uncertainty,
    )
    return made.hold(*(n for n in made.names if n[:2] in ("Fc", "of", "ep") or n == "delay"))


def recording(bodies, k=1, seed=0, noise=NOISE):
    """Pinocchio's torque of bodies, with viscous friction and noise."""
    time, q, v, regressor = motion(k)
    tau = regressor @ np.asarray(bodies).ravel() + VISCOUS * v
    tau = tau + noise * np.random.default_rng(seed).normal(size=tau.shape)
    return jaxid.Recording.from_arrays(time, q, tau, name=f"motion {k}")


def test_every_deformation_is_a_physical_body(described):
    """Published arms, at random parameters, against the product of matrices."""
    path, tip = described
    arm = PhysicalArm.from_urdf(path, tip=tip)
    rng = np.random.default_rng(0)
    roots = np.asarray(arm.roots)
    for _ in range(100):
        parameters = rng.normal(size=(arm.joints, 10)) * rng.choice([0.1, 1.0, 2.0])
        bodies = np.asarray(BODIES(moved(arm, parameters)))
        assert smallest_eigenvalues(bodies).min() > 0
        for root, body, given in zip(roots, bodies, parameters, strict=True):
            density, stretch, (xy, xz, yz), shift = np.split(given, (1, 4, 7))
            change = np.eye(4)
            shear = np.array([[0, xy, xz], [0, 0, yz], [0, 0, 0]])
            change[:3, :3] = np.diag(np.exp(stretch)) + shear
            change[:3, 3] = shift
            whole = np.exp(density) * root @ change @ change.T @ root.T
            np.testing.assert_allclose(
                pseudo_inertia(np, body), whole, rtol=1e-9, atol=1e-12 * np.abs(whole).max()
            )


def test_without_deformation_the_bodies_are_those_of_the_file(described):
    path, tip = described
    arm, drawn = (kind.from_urdf(path, tip=tip) for kind in (PhysicalArm, SerialArm))
    bodies, ours = np.asarray(drawn.bodies), np.asarray(arm.inertias())
    # A point gets the extent of a ball: 1 % of its inertia about the joint.
    centre = np.linalg.norm(bodies[:, 6:9], axis=1) / bodies[:, MASS]
    size = bodies[:, MASS] * np.maximum(centre, 0.05) ** 2
    np.testing.assert_allclose(ours[:, 6:], bodies[:, 6:], rtol=1e-9, atol=1e-12)
    assert np.all(np.abs(ours[:, :6] - bodies[:, :6]) < 0.0201 * size[:, None] + 1e-12)
    same = np.abs(ours - bodies).max(axis=1) < 1e-9
    points = np.abs(bodies[:, [0, 3, 5]]).max(axis=1) < 1.0001 * bodies[:, MASS] * centre**2
    assert np.all(same | points), (same, points)


def test_fits_from_bodies_half_wrong_leave_the_error_of_free_base_parameters():
    arm = loop(0.5).arm
    true = np.asarray(arm.inertias())
    record = recording(true)
    linear = SerialArm(arm.chain, true, arm.lower, arm.upper)
    free = jaxid.fit(dataclasses.replace(loop(), arm=linear), record)
    for factor in (0.5, 1.5):
        other = PhysicalArm(arm.chain, factor * true, arm.lower, arm.upper, uncertainty=0.5)
        assert np.asarray(other.inertias())[0, MASS] == pytest.approx(factor * true[0, MASS])
        fit = jaxid.fit(dataclasses.replace(loop(), arm=other), record)
        assert fit.succeeded
        np.testing.assert_allclose(fit.error_percent, free.error_percent, rtol=0.02)
        assert smallest_eigenvalues(np.asarray(fit.loop.arm.inertias())).min() > 0


def test_deviations_hold_for_bodies_as_uncertain_as_declared():
    """Also in base parameters, where they follow by linearisation."""
    arm = loop().arm
    expected, covariance = map(np.asarray, arm.expected())
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        drawn = expected + np.sqrt(np.diag(covariance)) * rng.normal(size=len(expected))
        true = moved(arm, drawn)
        fit = jaxid.fit(loop(), recording(true.inertias(), seed=seed))
        count = len(expected)
        assert fit.names[:count] == arm.deformation_names
        found, spread = in_base_parameters(fit.loop.arm, fit.covariance[:count, :count])
        exact, _ = in_base_parameters(true, np.eye(count))
        errors.append((found.base - exact.base) / np.sqrt(np.diag(spread)))
        assert not any("uncertainty allows" in note for note in fit.notes)
    size = np.sqrt(np.mean(np.square(errors)))
    assert 0.75 < size < 1.25, size


def test_a_body_far_from_the_drawing_is_told():
    arm = loop().arm
    heavy = np.asarray(arm.inertias()) * np.array([1, 1, 1, 4.0])[:, None]
    fit = jaxid.fit(loop(), recording(heavy))
    (said,) = [n for n in fit.notes if "uncertainty allows" in n]
    assert "density4 by" in said
    assert np.asarray(fit.loop.arm.inertias())[3, MASS] == pytest.approx(4.0, rel=0.3)
    (told,) = [n for n in fit.notes if "those of the drawing" in n]
    assert "all but" in told


def test_torque_in_a_wrong_unit_is_named():
    record = recording(loop().arm.inertias())
    wrong = jaxid.Recording.from_arrays(record.time, record.q, 0.1 * record.tau, name="wrong")
    assert not contradiction(jaxid.fit(loop(0.5), record))
    assert "the unit of torque" in contradiction(jaxid.fit(loop(0.5), wrong))


def test_it_is_written_saved_and_read(tmp_path):
    arm = moved(loop().arm, 0.3 * np.random.default_rng(1).normal(size=40))
    made = dataclasses.replace(loop(), arm=arm)
    source = tmp_path / "arm.urdf"
    source.write_text(four_joints(), encoding="utf-8")
    out = jaxid.write_urdf(made, source, tmp_path / "out.urdf")
    again = SerialArm.from_urdf(out)
    np.testing.assert_allclose(again.bodies, arm.inertias(), rtol=1e-9, atol=1e-12)
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(jaxid.write_mjcf(made, tmp_path / "out.xml")))
    np.testing.assert_allclose(model.body_mass[1:], again.bodies[:, MASS])


def test_a_link_that_is_no_body_is_refused():
    text = four_joints().replace('<mass value="3"/>', '<mass value="0"/>')
    with pytest.raises(ModelError, match="link 2 is drawn with a mass of 0 kg"):
        jaxid.serial(text, bodies="physical")


def test_a_copy_with_other_bodies_deforms_these():
    arm = loop().arm
    other = dataclasses.replace(arm, bodies=2.0 * arm.bodies)
    np.testing.assert_allclose(other.inertias(), 2.0 * arm.inertias(), rtol=1e-12)
