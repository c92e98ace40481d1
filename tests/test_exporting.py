"""Arms written for other programs, read there, and bodies that matter can have."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.arms import SerialArm, physical_bodies
from jaxid.arms.physical import chance_of, smallest_eigenvalues
from jaxid.effects import CarriedBody, Motion, Stribeck
from jaxid.errors import JaxidWarning, ModelError
from tests.test_serial import POLAR, SHARED, pinocchio_of
from tests.test_serial import described as described

INVERSE = eqx.filter_jit(lambda arm, q, v, a: arm.inverse(q, v, a))


def states(arm, count=20, seed=3):
    """Positions within limits, velocities and accelerations."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0)
    return [(rng.uniform(low, high), *rng.normal(size=(2, arm.joints))) for _ in range(count)]


def other(loop):
    """The loop with other bodies, all of which matter can have, and drives with friction."""
    arm = loop.arm
    bodies = np.asarray(arm.bodies) * np.linspace(0.7, 1.4, arm.joints)[:, None]
    arm = dataclasses.replace(arm, base=jnp.asarray(arm.combined @ bodies.ravel()))
    values = {}
    for j in range(1, arm.joints + 1):
        values |= {f"Fv{j}": 0.3 * j, f"Fc{j}": 0.2 * j, f"Ia{j}": 0.05 * j}
    return dataclasses.replace(loop, arm=arm).with_values(**values), bodies


def torque(arm, q, v, a):
    return np.asarray(INVERSE(arm, *map(jnp.asarray, (q, v, a))))


def test_a_urdf_is_written_back_with_other_bodies(described, tmp_path):
    path, tip = described
    loop, bodies = other(jaxid.serial(path, tip=tip))
    out = jaxid.write_urdf(loop, path, tmp_path / "out.urdf", bodies=bodies, tip=tip)
    again = jaxid.serial(out, tip=tip)
    np.testing.assert_allclose(again.arm.bodies, bodies, rtol=1e-9, atol=1e-12)
    assert out.read_text().count("<dynamics") >= loop.joints
    pinocchio = pytest.importorskip("pinocchio")
    model, position = pinocchio_of(out, again.arm)
    data = model.createData()
    for q, v, a in states(loop.arm):
        ours = torque(loop.arm, q, v, a)
        size = np.abs(ours).max()
        np.testing.assert_allclose(torque(again.arm, q, v, a), ours, rtol=1e-9, atol=1e-9 * size)
        theirs = pinocchio.rnea(model, data, position(q), v, a)
        np.testing.assert_allclose(theirs, ours, rtol=1e-9, atol=1e-9 * size)


def test_mujoco_finds_the_same_torque_in_what_is_written(described, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    path, tip = described
    loop, bodies = other(jaxid.serial(path, tip=tip))
    bodies = physical_bodies(dataclasses.replace(loop.arm, bodies=bodies)).bodies
    out = jaxid.write_mjcf(loop, tmp_path / "out.xml", bodies=bodies)
    model = mujoco.MjModel.from_xml_path(str(out))
    data = mujoco.MjData(model)
    np.testing.assert_allclose(model.dof_frictionloss, [0.2 * j for j in range(1, loop.joints + 1)])
    model.dof_frictionloss[:] = 0
    model.jnt_limited[:] = 0
    for q, v, a in states(loop.arm):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        drives = [0.3 * j * v[j - 1] + 0.05 * j * a[j - 1] for j in range(1, loop.joints + 1)]
        ours = torque(loop.arm, q, v, a) + drives
        size = np.abs(ours).max()
        np.testing.assert_allclose(data.qfrc_inverse, ours, rtol=1e-6, atol=1e-6 * size)


def test_bodies_of_a_drawing_are_possible(described):
    path, tip = described
    arm = SerialArm.from_urdf(path, tip=tip)
    found = physical_bodies(arm)
    assert found.possible
    np.testing.assert_allclose(found.base, arm.base, rtol=1e-6, atol=1e-6 * np.abs(arm.base).max())
    # Drawn points are moved by a millionth of a body's size.
    assert smallest_eigenvalues(found.bodies).min() > 0


def test_base_parameters_that_no_body_has_are_told_and_moved_to_the_nearest(described):
    path, tip = described
    arm = SerialArm.from_urdf(path, tip=tip)
    largest = int(np.argmax(np.abs(arm.base)))
    inertia = next(k for k, name in enumerate(arm.base_names) if name[:2] in ("ZZ", "YY", "XX"))
    base = np.asarray(arm.base).copy()
    base[inertia] = -abs(base[largest])
    wrong = dataclasses.replace(arm, base=jnp.asarray(base))
    sure = np.diag((0.01 * np.maximum(np.abs(base), 0.01 * np.abs(base).max())) ** 2)
    found = physical_bodies(wrong, sure)
    assert not found.possible
    assert found.distance > 10
    assert smallest_eigenvalues(found.bodies).min() > 0
    nearest = dataclasses.replace(arm, base=jnp.asarray(found.base))
    assert physical_bodies(nearest, sure).distance < 1
    assert chance_of(wrong, sure, found, draws=19) == 1 / 20


def test_a_small_probability_of_physical_bodies_is_rare(tmp_path):
    """Estimates of bodies at the limit of what is physical, the hardest case."""
    path = tmp_path / "polar.urdf"
    path.write_text(POLAR)
    arm = SerialArm.from_urdf(path)
    base = np.asarray(arm.base)
    sure = np.diag((0.1 * np.maximum(np.abs(base), 0.1 * np.abs(base).max())) ** 2)

    def estimated(values):
        estimate = dataclasses.replace(arm, base=jnp.asarray(values))
        return estimate, physical_bodies(estimate, sure)

    _, limit = estimated(np.where(base == base[0], -base, base))
    assert limit.distance > 5
    rng, small = np.random.default_rng(2), 0
    for _ in range(30):
        noise = np.sqrt(np.diag(sure)) * rng.standard_normal(len(base))
        estimate, found = estimated(limit.base + noise)
        small += found.distance > 0 and chance_of(estimate, sure, found, draws=9) <= 0.1
    # Three are expected.
    assert small <= 7


def test_only_arms_in_space_are_written_and_only_to_their_own_urdf(described, tmp_path):
    path, tip = described
    with pytest.raises(ModelError, match="only arms that were read from a URDF"):
        jaxid.write_urdf(jaxid.scara(), path, tmp_path / "out.urdf", tip=tip)
    one = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>"""
    with pytest.raises(ModelError, match="has 1 joints, but"):
        jaxid.write_urdf(jaxid.serial(path, tip=tip), one, tmp_path / "out.urdf")
    negative = np.asarray(jaxid.serial(one).arm.bodies) * [*[1] * 9, -1]
    with pytest.raises(ModelError, match="physical_bodies"):
        jaxid.write_mjcf(jaxid.serial(one), tmp_path / "out.xml", bodies=negative)


def test_a_payload_is_written_into_the_last_link_and_the_rest_is_told(described, tmp_path):
    path, tip = described
    loop, bodies = other(jaxid.serial(path, tip=tip))
    bodies = physical_bodies(dataclasses.replace(loop.arm, bodies=bodies)).bodies
    base = jnp.asarray(loop.arm.combined @ np.ravel(bodies))
    loop = dataclasses.replace(loop, arm=dataclasses.replace(loop.arm, base=base))
    held = CarriedBody(loop.arm.chain, 0.8, (0.02, 0.0, 0.0, 0.02, 0.0, 0.02, 0.04, -0.02, 0.05))
    carrying = loop.add(held, Stribeck(joint=2, level=jnp.asarray(0.4)))
    with pytest.warns(JaxidWarning, match=r"has no rotor_inertia on joint 1.*stribeck on joint 2"):
        out = jaxid.write_urdf(carrying, path, tmp_path / "out.urdf", bodies=bodies, tip=tip)
    with pytest.warns(JaxidWarning, match="stribeck on joint 2") as told:
        jaxid.write_mjcf(carrying, tmp_path / "out.xml", bodies=bodies)
    assert not any("rotor_inertia" in str(x.message) for x in told)
    again = jaxid.serial(out, tip=tip).arm
    for q, v, a in states(loop.arm):
        zero = jnp.zeros(())
        motion = Motion(
            zero,
            *map(jnp.asarray, (q, v, a)),
            jnp.zeros_like(v),
            jnp.zeros(0),
            jnp.asarray(0),
            {},
            jnp.zeros_like(v),
        )
        ours = torque(loop.arm, q, v, a) + np.asarray(held.torque(motion))
        size = np.abs(ours).max()
        np.testing.assert_allclose(torque(again, q, v, a), ours, rtol=1e-9, atol=1e-9 * size)


def test_bodies_that_simulators_refuse_are_told(tmp_path):
    path = tmp_path / "polar.urdf"
    path.write_text(POLAR)
    loop = jaxid.serial(path)
    bodies = np.array(loop.arm.bodies)
    # One principal inertia above the sum of the others.
    bodies[1, :6] = 0.01, 0.0, 0.0, 0.01, 0.0, 0.05
    bodies[1, 6:9] = 0.0
    with pytest.warns(JaxidWarning, match="bodies of link 2 are not physical.*physical_bodies"):
        jaxid.write_urdf(loop, path, tmp_path / "out.urdf", bodies=bodies)
    with pytest.raises(ModelError, match="link 2 has mass .*physical_bodies"):
        jaxid.write_mjcf(loop, tmp_path / "out.xml", bodies=bodies)


@pytest.mark.slow
def test_free_bodies_that_stand_for_a_spring_are_told():
    """On a KUKA KR300 free bodies stand for the spring that balances it, and no matter has them.

    With bodies as drawn, the spring that the model lacks shows on a recording that no fit has seen.
    """
    folder = SHARED / "kr300"
    if not folder.exists():
        pytest.skip("the recordings beside the checkout are not there")
    a, b = jaxid.read(folder / "kr300_A.csv.gz", folder / "kr300_B.csv.gz", columns={"time": "t"})
    law = jaxid.control.Tracking(cutoff=5.0)
    free = jaxid.fit(jaxid.serial(folder / "kr300.urdf", law, bodies="free"), a)
    assert any("no physical bodies" in note for note in free.notes)
    drawn = jaxid.serial(folder / "kr300.urdf", law)
    without = jaxid.fit(drawn, a)
    assert not any("physical bodies have" in note for note in without.notes)
    sprung = jaxid.fit(drawn.without("torque_offset", 2).add(jaxid.effects.Spring(joint=2)), a)
    errors = [jaxid.compare(fit, b).error_percent["joint 2"].iloc[0] for fit in (without, sprung)]
    assert errors[0] > 80
    assert errors[1] < 10
