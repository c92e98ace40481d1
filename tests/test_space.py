"""Effects of arms in space, against Pinocchio: a tilted base, a carried body, cables."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.arms import BODY, SerialArm
from jaxid.chain import moved_body
from jaxid.control import PD, Tracking
from jaxid.discovery.hypotheses import survey
from jaxid.discovery.screening import not_examined
from jaxid.discovery.step import effect_parameters
from jaxid.effects import (
    BaseTilt,
    CableDrag,
    CarriedBody,
    Gravity,
    Motion,
    Payload,
    Tilt,
)
from jaxid.effects import recording_label as label
from tests.test_serial import PINOCCHIO, POLAR, pinocchio_of, robots

pinocchio = pytest.importorskip("pinocchio")
GRAVITY = np.array([0.0, 0.0, -9.81])


@pytest.fixture(params=["ur5", "z1", "polar"])
def arm(request, tmp_path):
    """An arm, and Pinocchio's model of it."""
    if request.param == "polar":
        path = tmp_path / "polar.urdf"
        path.write_text(POLAR)
    else:
        path = (
            robots()
            / {
                "ur5": "ur_description/urdf/ur5_robot.urdf",
                "z1": "z1_description/urdf/z1.urdf",
            }[request.param]
        )
        if not path.exists():
            pytest.skip(f"example-robot-data has no {path.name}")
    made = SerialArm.from_urdf(path)
    return made, *pinocchio_of(path, made)


def states(arm, count=20):
    rng = np.random.default_rng(3)
    q = rng.uniform(arm.lower, arm.upper, (count, arm.joints))
    return (q, *rng.normal(size=(2, count, arm.joints)))


def torque(effect, q, v, a, name=""):
    """The effect's torque at each state."""

    @eqx.filter_jit
    def along(effect, q, v, a):
        def one(q, v, a):
            at = jnp.asarray(label(name))
            return effect.torque(Motion(jnp.zeros(()), q, v, a, q, jnp.zeros(0), at))

        return jax.vmap(one)(q, v, a)

    return np.asarray(along(effect, q, v, a))


def rnea(model, position, q, v, a):
    data = model.createData()
    rows = zip(map(position, q), v, a, strict=True)
    return np.array([pinocchio.rnea(model, data, *row) for row in rows])


def test_a_tilted_base_weighs_as_in_pinocchio(arm):
    made, model, position = arm
    q, v, a = states(made)
    level = rnea(model, position, q, v, a)
    # The base turned about its x and y axes: gravity leans by the tangents.
    leaning = np.array([np.tan(0.05), np.tan(-0.2), -1.0])
    model.gravity.linear = 9.81 * leaning / np.linalg.norm(leaning)
    tilted = rnea(model, position, q, v, a)
    effect = BaseTilt(made.chain, made.bodies, x=leaning[0], y=leaning[1])
    np.testing.assert_allclose(effect.gravity(), model.gravity.linear, rtol=1e-14)
    ours = torque(effect, q, v, a)
    np.testing.assert_allclose(ours, tilted - level, atol=1e-12 * np.abs(level).max())
    assert np.all(torque(dataclasses.replace(effect, x=0.0, y=0.0), q, v, a) == 0)


def test_gravity_leans_across_itself_wherever_it_points():
    for drawn in np.vstack([np.eye(3), -np.eye(3), [[1.0, 2.0, 3.0]]]):
        chain = SerialArm.from_urdf(POLAR, gravity=tuple(drawn)).chain
        effect = BaseTilt(chain, np.zeros((2, 10)))
        slopes = [
            jax.jacfwd(lambda s, e=effect, k=k: dataclasses.replace(e, **{k: s}).gravity())(0.0)
            for k in ("x", "y")
        ]
        np.testing.assert_allclose(np.asarray(slopes) @ drawn, 0, atol=1e-15)
        found = np.asarray(slopes) @ np.asarray(slopes).T
        np.testing.assert_allclose(found, drawn @ drawn * np.eye(2), atol=1e-14)
        far = dataclasses.replace(effect, x=3.0, y=-4.0).gravity()
        np.testing.assert_allclose(far @ far, drawn @ drawn, rtol=1e-14)


def test_a_carried_body_loads_the_joints_as_one_welded_to_pinocchios_arm(arm):
    made, model, position = arm
    q, v, a = states(made)
    empty = rnea(model, position, q, v, a)
    mass, centre = 2.5, np.array([0.03, -0.05, 0.12])
    own = np.array([[0.02, 0.001, 0.002], [0.001, 0.03, -0.003], [0.002, -0.003, 0.025]])
    tip = np.asarray(made.chain.tip)
    welded = pinocchio.Inertia(mass, tip + centre, own)
    model.appendBodyToJoint(model.njoints - 1, welded, pinocchio.SE3.Identity())
    loaded = rnea(model, position, q, v, a)
    about_tip = own + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    effect = CarriedBody(
        made.chain,
        mass=mass,
        rest=[*about_tip[np.triu_indices(3)], *(mass * centre)],
        recordings=("with", "also with"),
    )
    np.testing.assert_allclose(effect.centre(), tip + centre, atol=1e-15)
    assert effect.rest_units == ("kg·m²",) * 6 + ("kg·m",) * 3
    ours = torque(effect, q, v, a, "with")
    np.testing.assert_allclose(ours, loaded - empty, atol=1e-12 * np.abs(loaded).max())
    assert np.all(torque(effect, q, v, a, "without") == 0)


def test_a_urdf_says_where_its_tip_is():
    # The clamp is 0.4 m along the link that slides.
    np.testing.assert_allclose(SerialArm.from_urdf(POLAR).chain.tip, [0.4, 0.0, 0.0])
    there = SerialArm.from_urdf(POLAR, tip="slide").chain.tip
    np.testing.assert_allclose(there, np.zeros(3))


def test_a_body_is_moved_as_pinocchio_moves_it():
    place, mass, centre = np.array([0.1, -0.2, 0.3]), 2.0, np.array([0.05, 0.02, -0.07])
    given = pinocchio.Inertia(mass, centre, np.diag([0.1, 0.12, 0.09]))
    there = pinocchio.Inertia(mass, centre + place, np.diag([0.1, 0.12, 0.09]))
    order = list(PINOCCHIO)
    before, after = (body.toDynamicParameters()[order] for body in (given, there))
    assert len(BODY) == len(order)
    np.testing.assert_allclose(moved_body(jnp.asarray(before), jnp.asarray(place)), after)


def test_cables_have_an_energy():
    """What each joint does to the other is the same, and its torque is the energy's slope."""
    effect = CableDrag(2, 3, shared=-1.5, preload=0.3, other_preload=-0.2)
    q = np.array([9.0, 0.4, -0.7, 5.0])

    def energy(q):
        i, j = q[1], q[2]
        return -1.5 * i * j + 0.3 * i - 0.2 * j

    steps = 1e-6 * np.eye(4)
    slope = [(energy(q + s) - energy(q - s)) / 2e-6 for s in steps]
    ours = torque(effect, q[None], np.zeros((1, 4)), np.zeros((1, 4)))[0]
    np.testing.assert_allclose(ours, slope, atol=1e-8)


def test_a_payload_has_the_parameters_that_motions_show(arm):
    """As many as the regressor of the last link's body has independent columns."""
    made, model, position = arm
    data = model.createData()
    rows = [
        np.array(pinocchio.computeJointTorqueRegressor(model, data, position(q), v, a))[:, -10:]
        for q, v, a in zip(*states(made, 40), strict=True)
    ]
    carried = made.in_space().carried
    assert carried[0] == BODY.index("M")
    assert len(carried) == np.linalg.matrix_rank(np.vstack(rows), tol=1e-7)
    shown = [PINOCCHIO[k] for k in carried]
    if not np.any(made.chain.tip):
        assert np.linalg.matrix_rank(np.vstack(rows)[:, shown], tol=1e-7) == len(carried)


# --- which arm is offered which -----------------------------------------------------------------


def scene_along(loop, names=("a", "b")):
    """The scene of a loop along a made-up motion."""
    rng = np.random.default_rng(0)
    q, v, a = rng.uniform(-1, 1, (3, len(names), 50, loop.joints))
    time = np.tile(np.linspace(0, 1, 50), (len(names), 1))
    made = [
        jaxid.Recording.from_arrays(t, x, x, name=name)
        for t, x, name in zip(time, q, names, strict=True)
    ]
    # As a linearised run gives it: points are the first axes.
    labels = np.zeros(time.shape, int)
    motion = jax.vmap(jax.vmap(Motion))(time, q, v, a, q, np.zeros((*time.shape, 0)), labels)
    return survey(loop, jaxid.Recordings.of(made), motion, [()] * loop.joints)


def proposed(loop, names=("a", "b")):
    """Classes that the catalogue proposes for a loop along a made-up motion."""
    scene = scene_along(loop, names)
    return {entry: list(entry.screened(scene)) for entry in jaxid.catalogue}


def test_what_an_arm_from_a_urdf_cannot_show_without_its_law_is_named():
    unknown = jaxid.serial(POLAR)
    names = not_examined(unknown, scene_along(unknown), jaxid.catalogue)
    assert {"backlash", "joint elasticity", "actuator lag", "torque saturation"} <= set(names)
    assert "spring" not in names
    known = jaxid.serial(POLAR, PD(Kp=[100.0, 100.0], Kv=[10.0, 10.0]))
    flat = jaxid.two_link(Tracking(), link_length=0.5)
    for loop in (known, flat):
        assert not not_examined(loop, scene_along(loop), jaxid.catalogue)


def test_each_arm_is_offered_the_gravity_and_the_payload_that_are_right_for_it():
    flat = proposed(jaxid.two_link(link_length=0.5))
    assert all(flat[entry] for entry in (Gravity, Payload))
    assert not any(flat[entry] for entry in (BaseTilt, CarriedBody, CableDrag))
    turning = POLAR.replace('type="prismatic"', 'type="revolute"')
    for bodies, everywhere in (("drawn", 1), ("free", 0)):
        deep = proposed(jaxid.serial(turning, bodies=bodies))
        assert not any(deep[entry] for entry in (Gravity, Tilt, Payload))
        assert len(deep[BaseTilt]) == 1
        assert len(deep[CableDrag]) == 1
        # Where the last link is estimated, a body that is always there is a part of it.
        assert len(deep[CarriedBody]) == 2 + everywhere
    assert len(proposed(jaxid.serial(turning), ("a",))[CarriedBody]) == 1
    # On rails a lean along the floor is seen along the rail alone.
    rail = jaxid.serial(POLAR.replace('type="continuous"', 'type="fixed"'))
    (seen,) = proposed(rail)[BaseTilt]
    assert sorted([seen.x is None, seen.y is None]) == [False, True]
    weightless = jaxid.serial(turning, gravity=(0.0, 0.0, 0.0))
    assert not proposed(weightless)[BaseTilt]


def test_values_of_a_payload_have_the_names_of_the_fit():
    loop = jaxid.serial(POLAR)
    body = CarriedBody(loop.arm.chain, 0.5, (0.1, 0.2), ("a",), (6, 7))
    loop = loop.add(body)
    found = effect_parameters(loop, loop.effects[-1])
    names = [name for _, name, _ in found]
    assert names == ["mass", *body.rest_names]
    assert [loop.names[place] for place, _, _ in found][1:] == names[1:]
