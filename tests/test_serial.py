"""Serial arms from a URDF, against Pinocchio and MuJoCo, and what broken files are told."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.arms import SerialArm
from jaxid.chain import inverse_by_rows
from jaxid.effects import Counterbalance, SharedShaft
from jaxid.errors import ModelError

pinocchio = pytest.importorskip("pinocchio")
# Where Pinocchio has `jaxid.arms.BODY`: mass, first moments, then xx, xy, yy, xz, yz, zz.
PINOCCHIO = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def robots():
    """URDFs of different shape: published arms, and one that turns and slides."""
    data = pytest.importorskip("example_robot_data")
    found = Path(data.__file__).parent.parent.parent.parent.parent / "share"
    folder = next(iter(found.glob("example-robot-data/robots")), None)
    if folder is None:
        pytest.skip("example-robot-data has no folder of robots here")
    return folder


CASES = {
    "ur5": ("ur_description/urdf/ur5_robot.urdf", None),
    "panda": ("panda_description/urdf/panda.urdf", "panda_link8"),
    "z1": ("z1_description/urdf/z1.urdf", None),
}
POLAR = """<robot name="polar">
 <link name="floor"/>
 <link name="column"><inertial><origin xyz="0.01 0 0.2" rpy="0.1 0 0"/><mass value="8"/>
  <inertia ixx="0.2" iyy="0.25" izz="0.1" ixy="0.01" ixz="0" iyz="0"/></inertial></link>
 <link name="slide"><inertial><origin xyz="0.3 0.02 0"/><mass value="3"/>
  <inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0" ixz="0.002" iyz="0"/></inertial></link>
 <link name="tool"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
  <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="turn" type="continuous"><parent link="floor"/><child link="column"/>
  <origin xyz="0 0 0.5" rpy="0 0.3 0"/><axis xyz="0 0 1"/></joint>
 <joint name="reach" type="prismatic"><parent link="column"/><child link="slide"/>
  <origin xyz="0.1 0 0.2" rpy="0 0 0.2"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="0.6" effort="9" velocity="9"/></joint>
 <joint name="clamp" type="fixed"><parent link="slide"/><child link="tool"/>
  <origin xyz="0.4 0 0" rpy="0.5 0 0"/></joint>
</robot>"""


@pytest.fixture(params=[*CASES, "polar", "kr300", "tx40"])
def described(request, tmp_path):
    """Path of a URDF, and its tip."""
    if request.param in CASES:
        path, tip = CASES[request.param]
        found = robots() / path
        if not found.exists():
            pytest.skip(f"example-robot-data has no {path}")
        return found, tip
    if request.param == "polar":
        path = tmp_path / "polar.urdf"
        path.write_text(POLAR)
        return path, None
    path = next((SHARED / request.param).glob("*.urdf"), None) if SHARED.exists() else None
    if path is None:
        pytest.skip("the recordings beside the checkout are not there")
    return path, None


def pinocchio_of(path, arm):
    """Pinocchio's model with only the joints of the arm, and how it takes their positions."""
    model = pinocchio.buildModelFromUrdf(str(path))
    if model.nv > arm.joints:
        first = pinocchio.neutral(model)
        later = [k for k in range(1, model.njoints) if model.joints[k].idx_v >= arm.joints]
        model = pinocchio.buildReducedModel(model, later, first)

    def position(q):
        x = pinocchio.neutral(model)
        for joint in model.joints[1:]:
            at = q[joint.idx_v]
            values = [np.cos(at), np.sin(at)] if joint.nq == 2 else [at]
            x[joint.idx_q : joint.idx_q + joint.nq] = values
        return x

    return model, position


def test_torque_inertia_and_regressor_are_pinocchios(described):
    path, tip = described
    arm = SerialArm.from_urdf(path, tip=tip)
    model, position = pinocchio_of(path, arm)
    data = model.createData()
    rng = np.random.default_rng(0)
    count = 1000
    q = rng.uniform(arm.lower, arm.upper, (count, arm.joints))
    v, a = rng.normal(size=(2, count, arm.joints))

    @eqx.filter_jit
    def ours(arm, q, v, a):
        return jax.vmap(lambda *x: (arm.inverse(*x), arm.mass_matrix(x[0]), arm.regressor(*x)))(
            q, v, a
        )

    torque, mass, regressor = (np.asarray(x) for x in ours(arm, q, v, a))
    at = [position(x) for x in q]
    expected = np.array([pinocchio.rnea(model, data, *x) for x in zip(at, v, a, strict=True)])
    upper = np.array([np.triu(pinocchio.crba(model, data, x)) for x in at])
    full = upper + np.triu(upper, 1).transpose(0, 2, 1)
    size = np.abs(expected).max()
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(mass, full, rtol=0, atol=1e-12 * np.abs(full).max())
    # By a link's parameters torque is linear: each base parameter has the column of its leader.
    places = np.asarray([10 * (k // 10) + PINOCCHIO[k % 10] for k in arm.leading])
    by_bodies = np.array(
        [
            np.array(pinocchio.computeJointTorqueRegressor(model, data, *x))[:, places]
            for x in zip(at, v, a, strict=True)
        ]
    )
    largest = np.abs(by_bodies).max()
    np.testing.assert_allclose(regressor, by_bodies, rtol=0, atol=1e-12 * largest)
    # What drawings round to is left out of the combinations.
    np.testing.assert_allclose(regressor @ np.asarray(arm.base), expected, atol=1e-7 * size)


def test_derivatives_by_rows_are_those_of_the_equations():
    arm, rng = SerialArm.from_urdf(POLAR), np.random.default_rng(3)
    at = (arm.chain, arm.inertias(), *jnp.asarray(rng.normal(size=(3, 2))))
    tangents = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=np.shape(x))), at)

    def equations(chain, *motion):
        return chain.inverse(*motion)

    theirs = eqx.filter_jvp(equations, at, tangents)
    ours = eqx.filter_jvp(inverse_by_rows, at, tangents)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-12)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-12)
    # What is held has no tangent.
    for k in range(1, 5):
        only = [None] * 5
        only[k] = tangents[k]
        one, other = (
            eqx.filter_jvp(lambda x, f=f, k=k: f(*at[:k], x, *at[k + 1 :]), (at[k],), (only[k],))
            for f in (inverse_by_rows, equations)
        )
        np.testing.assert_allclose(one[1], other[1], rtol=1e-11, atol=1e-12)


def test_torque_is_mujocos(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    path = tmp_path / "polar.urdf"
    path.write_text(POLAR)
    arm = SerialArm.from_urdf(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for q, v, a in rng.uniform(0.1, 0.6, (50, 3, 2)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        ours = np.asarray(arm.inverse(*map(jax.numpy.asarray, (q, v, a))))
        np.testing.assert_allclose(ours, data.qfrc_inverse, rtol=1e-10, atol=1e-10)


def test_base_parameters_say_what_they_are():
    arm = SerialArm.from_urdf(POLAR)
    named = dict(zip(arm.base_names, np.asarray(arm.base), strict=True))
    assert named == pytest.approx(
        {name: float(x) for name, x in zip(arm.base_names, arm.base, strict=True)}
    )
    # A link that slides moves with its mass; the column under it turns with its inertia.
    assert any(text.startswith("M2") for text in arm.combinations().values())
    loop = jaxid.serial(POLAR, bodies="free").with_values(**{arm.base_names[0]: 0.7})
    assert float(loop.arm.base[0]) == 0.7
    assert set(arm.base_names) <= set(loop.names)
    own = {"XX": "kg·m²", "YY": "kg·m²", "ZZ": "kg·m²", "MX": "kg·m", "MY": "kg·m", "M": "kg"}
    base = next(p for p in loop.parameters if p.names == list(arm.base_names))
    for name, unit in zip(base.names, loop.units(base), strict=True):
        assert unit == own["M" if name[1:2].isdigit() else name[:2]], name


def test_bodies_that_no_motion_shows_do_not_matter():
    arm = SerialArm.from_urdf(POLAR)
    rng = np.random.default_rng(2)
    moved = eqx.tree_at(lambda a: a.base, arm, arm.base * rng.uniform(0.5, 1.5, arm.base.shape))
    q, v, a = (jax.numpy.asarray(x) for x in rng.uniform(0, 1, (3, 2)))
    there = np.asarray(moved.inverse(q, v, a))
    np.testing.assert_allclose(there, np.asarray(moved.regressor(q, v, a) @ moved.base), rtol=1e-9)


BROKEN = {
    "<!DOCTYPE a [<!ENTITY b 'c'>]><robot name='r'/>": "declares entities",
    "<robot": "is not XML",
    "<mujoco/>": "has the root <mujoco>",
    POLAR.replace('type="continuous"', 'type="floating"'): "is 'floating'",
    POLAR.replace('<mass value="3"/>', ""): "without its mass or inertia",
    POLAR.replace('mass value="3"', 'mass value="nan"'): "the mass of link 'slide'",
    POLAR.replace('mass value="3"', 'mass value="-3"'): "an inertia that is not physical",
    POLAR.replace('izz="0.1"', 'izz="5"'): "an inertia that is not physical",
    POLAR.replace('axis xyz="1 0 0"', 'axis xyz="0 0 0"'): "an axis of zero length",
    POLAR.replace('lower="0" upper="0.6"', 'lower="1" upper="0.6"'): "lower must be below upper",
    POLAR.replace('<child link="tool"/>', '<child link="gone"/>'): "there is no such link",
    POLAR.replace('<child link="tool"/>', '<child link="slide"/>'): "has two joints with child",
    POLAR.replace('<parent link="floor"/>', '<parent link="tool"/>'): "a closed chain",
    POLAR.replace("</robot>", "<link name='other'/></robot>"): "several roots",
    POLAR.replace('<limit lower="0"', '<mimic joint="turn"/><limit lower="0"'): "mimics another",
    POLAR.replace("inertial", "nothing"): "has no mass beyond joint",
    "/nowhere/arm.urdf": "cannot be read",
}


@pytest.mark.parametrize("text", BROKEN, ids=[re.sub(r"\W+", "-", x) for x in BROKEN.values()])
def test_broken_files_are_told_in_a_sentence(text):
    with pytest.raises(ModelError, match=re.escape(BROKEN[text])) as told:
        SerialArm.from_urdf(text)
    assert "\n" not in str(told.value)


def test_rival_tips_are_named():
    text = POLAR.replace(
        "</robot>",
        """<link name="second"/><joint name="branch" type="revolute"><parent link="column"/>
        <child link="second"/><axis xyz="1 0 0"/><limit lower="-1" upper="1"/></joint></robot>""",
    )
    with pytest.raises(ModelError, match="several tips"):
        SerialArm.from_urdf(text)
    assert SerialArm.from_urdf(text, tip="tool").joints == 2


# --- effects of arms in space -------------------------------------------------------------------


def test_a_cylinder_pulls_as_its_points_say():
    """By virtual work: the torque of a constant force is how its length changes with the angle."""
    force, near, far, angle = 900.0, 0.2, 0.8, 0.3
    effect = Counterbalance(joint=2, level=force * near, angle=angle, ratio=near / far)
    for q in np.linspace(-1.5, 1.5, 7):

        def length(at):
            return np.sqrt(near**2 + far**2 - 2 * near * far * np.cos(at - angle))

        expected = force * (length(q + 1e-6) - length(q - 1e-6)) / 2e-6
        motion = motion_of(q=[0.0, q])
        np.testing.assert_allclose(effect.torque(motion), [0.0, expected], rtol=1e-6, atol=1e-6)


def test_a_shaft_loads_both_joints_with_one_power():
    effect = SharedShaft(1, 2, viscous=0.5, coulomb=0.2, inertia=0.1, share=2.0, smoothing=1e-6)
    motion = motion_of(q=[0.0, 0.0], v=[0.3, -0.1], a=[1.0, 2.0])
    on_shaft = 0.5 * 0.5 + 0.2 + 0.1 * 4.0
    np.testing.assert_allclose(effect.torque(motion), [2 * on_shaft, on_shaft], rtol=1e-5)


def motion_of(q, v=(0.0, 0.0), a=(0.0, 0.0)):
    from jaxid.effects import Motion

    values = (jax.numpy.asarray(np.asarray(x, float)) for x in (q, v, a))
    none = jax.numpy.zeros(0)
    return Motion(jax.numpy.asarray(0.0), *values, jax.numpy.zeros(2), none, jax.numpy.asarray(0))
