"""Arms against their Lagrangians, MuJoCo, the independent plants and conservation of energy."""

import dataclasses
from functools import partial

import equinox as eqx
import independent as sim
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.arms import SCARA, AbstractArm, Axis, TwoLink
from jaxid.control import OpenLoop
from jaxid.effects import AbstractEffect, Coulomb, Motion, Viscous, smooth_sign
from jaxid.errors import ModelError
from jaxid.parameters import list_parameters, read_values
from jaxid.simulation.loads import inverse

G = 9.81
LENGTH = 0.5


# --- rigid bodies, from the position of their centres of mass ---------------------------------


def turned(angle, vector):
    """A vector of the plane, turned."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def centres(q, links):
    """Centres of mass of two links in the plane, (links, 2), m; both lie along x at q = 0."""
    elbow = turned(q[0], jnp.array([LENGTH, 0.0]))
    return jnp.stack([turned(q[0], links["com"][0]), elbow + turned(q[0] + q[1], links["com"][1])])


def lagrangian(q, v, links, gravity):
    """Kinetic minus potential energy of two links, J; gravity pulls along x."""
    place, speed = jax.jvp(lambda at: centres(at, links), (q,), (v,))
    moving = 0.5 * jnp.sum(links["mass"] * jnp.sum(speed**2, axis=1))
    turning = 0.5 * jnp.sum(links["izz"] * jnp.cumsum(v) ** 2)
    return moving + turning + gravity * jnp.sum(links["mass"] * place[:, 0])


def torque_of(lagrange, q, v, a):
    """d/dt dL/dv - dL/dq along a motion."""
    momentum = jax.grad(lagrange, argnums=1)
    rate = jax.jvp(momentum, (q, v), (v, a))[1]
    return rate - jax.grad(lagrange)(q, v)


def scara_of(links):
    """The SCARA whose base parameters are those of the links."""
    m, i = links["mass"], links["izz"]
    (x1, y1), (x2, y2) = links["com"]
    return SCARA(
        ZZ1r=i[0] + m[0] * (x1**2 + y1**2) + m[1] * LENGTH**2,
        ZZ2=i[1] + m[1] * (x2**2 + y2**2),
        MX2=m[1] * x2,
        MY2=m[1] * y2,
        length=LENGTH,
    )


def two_link_of(links, known_length=False):
    """The two-link arm of links whose centres of mass lie on them."""
    m, i, (r1, r2) = links["mass"], links["izz"], links["com"][:, 0]
    values = {
        "p1": i[0] + m[0] * r1**2 + m[1] * LENGTH**2,
        "p2": i[1] + m[1] * r2**2,
        "p4": m[0] * r1 + m[1] * LENGTH,
        "p5": m[1] * r2,
    }
    if known_length:
        return TwoLink(**values, link_length=LENGTH, g=G)
    return TwoLink(**values, p3=m[1] * LENGTH * r2, g=G)


def draw_links(seed, count, aligned):
    """Random links: masses, centres of mass and inertias of bodies that can be built."""
    rng = np.random.default_rng(seed)
    com = rng.uniform(-0.4, 0.4, (count, 2, 2))
    if aligned:
        com[..., 1] = 0.0
    # Any positive inertia about the centre of mass belongs to some body in the plane.
    izz = np.exp(rng.uniform(np.log(1e-4), np.log(0.5), (count, 2)))
    return {
        "mass": jnp.asarray(np.exp(rng.uniform(np.log(0.05), np.log(10.0), (count, 2)))),
        "com": jnp.asarray(com),
        "izz": jnp.asarray(izz),
    }


def draw_motions(seed, count, joints):
    """Random states: positions over a turn, velocities and accelerations of a quick arm."""
    rng = np.random.default_rng(seed)
    return tuple(jnp.asarray(rng.uniform(-s, s, (count, joints))) for s in (np.pi, 5.0, 20.0))


TWO_LINKED = {
    "scara": (scara_of, 0.0, False),
    "two_link": (two_link_of, G, True),
    "two_link of known length": (partial(two_link_of, known_length=True), G, True),
}


def assert_same_dynamics(arm_torque, regressed, expected):
    """Sums of some ten terms each: rounding stays below 1e-13 of the largest of them."""
    size = np.abs(expected).max()
    np.testing.assert_allclose(arm_torque, expected, rtol=1e-10, atol=1e-12 * size)
    np.testing.assert_allclose(regressed, arm_torque, rtol=1e-10, atol=1e-12 * size)


def both_torques(arm, q, v, a):
    """Torque from mass matrix and bias, and from the regressor with theta in field order."""
    theta = read_values(arm, list_parameters(arm))
    return arm.mass_matrix(q) @ a + arm.bias(q, v), arm.regressor(q, v, a) @ theta


@pytest.mark.parametrize("name", TWO_LINKED)
def test_two_links_obey_their_lagrangian(name):
    build, gravity, aligned = TWO_LINKED[name]

    def one(links, q, v, a):
        expected = torque_of(lambda q, v: lagrangian(q, v, links, gravity), q, v, a)
        return *both_torques(build(links), q, v, a), expected

    results = jax.jit(jax.vmap(one))(draw_links(1, 100, aligned), *draw_motions(2, 100, 2))
    assert_same_dynamics(*results)


def test_axis_obeys_its_lagrangian():
    def one(mass, q, v, a):
        expected = torque_of(lambda q, v: 0.5 * mass * jnp.sum(v**2), q, v, a)
        return *both_torques(Axis(M=mass), q, v, a), expected

    masses = jnp.linspace(0.1, 200.0, 20)
    assert_same_dynamics(*jax.jit(jax.vmap(one))(masses, *draw_motions(3, 20, 1)))


@pytest.mark.parametrize("name", TWO_LINKED)
def test_regressor_that_is_written_out_is_the_one_that_follows(name):
    build, _, aligned = TWO_LINKED[name]

    def both(links, *motion):
        arm = build(links)
        return arm.regressor(*motion), AbstractArm.regressor(arm, *motion)

    drawn = draw_links(11, 20, aligned), *draw_motions(12, 20, 2)
    written, following = jax.jit(jax.vmap(both))(*drawn)
    np.testing.assert_allclose(written, following, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["scara", "two_link"])
def test_mass_matrix_and_bias_agree_with_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    build, gravity, aligned = TWO_LINKED[name]
    links = jax.tree.map(lambda leaf: leaf[0], draw_links(5, 1, aligned))
    bodies = [
        f'<inertial pos="{x:.17g} {y:.17g} 0" mass="{m:.17g}" '
        f'diaginertia="{i:.17g} {i:.17g} {i:.17g}"/>'
        for m, i, (x, y) in zip(links["mass"], links["izz"], links["com"], strict=True)
    ]
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="{gravity} 0 0"/><worldbody><body>'
        f'<joint type="hinge" axis="0 0 1"/>{bodies[0]}<body pos="{LENGTH} 0 0">'
        f'<joint type="hinge" axis="0 0 1"/>{bodies[1]}</body></body></worldbody></mujoco>'
    )
    data, arm = mujoco.MjData(model), build(links)
    ours = eqx.filter_jit(lambda q, v: (arm.mass_matrix(q), arm.bias(q, v)))
    for q, v, _ in zip(*draw_motions(6, 20, 2), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        full = np.zeros((2, 2))
        for row, unit in zip(full, np.eye(2), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        mass, bias = ours(q, v)
        # Closed forms both; MuJoCo's quaternions cost it some digits.
        np.testing.assert_allclose(mass, full, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(bias, data.qfrc_bias, rtol=1e-9, atol=1e-9)


PAIRS = {
    "scara": (
        jaxid.scara().with_values(
            ZZ1r=3.44, ZZ2=0.06, MX2=0.24, MY2=0.01, Fv1=0.07, Fc1=0.23, Fv2=0.003, Fc2=0.05
        ),
        sim.Scara(),
    ),
    "two_link": (
        jaxid.two_link().with_values(
            p1=0.108,
            p2=0.0443,
            p3=0.0333,
            p4=0.349,
            p5=0.111,
            Fv1=0.005,
            Fc1=0.08,
            Fv2=0.003,
            Fc2=0.05,
        ),
        sim.TwoLink(),
    ),
    "emps": (
        jaxid.emps().with_values(M=95.1, Fv1=203.5, Fc1=20.4, eps1=1e-4, offset1=-3.16),
        sim.Axis(),
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_robots_agree_with_the_independent_plants(name):
    """Arm and friction together take the torque that the independent equations take."""
    loop, plant = PAIRS[name]

    def ours(q, v, a):
        zeros = jnp.zeros(loop.joints)
        motion = Motion(jnp.zeros(()), q, v, a, zeros, jnp.zeros(0), jnp.asarray(0))
        return inverse(loop, motion, tuple(e.initial_state() for e in loop.effects))

    motions = draw_motions(7, 20, loop.joints)
    theirs = [
        sim.inverse_dynamics(plant, *map(np.ndarray.tolist, map(np.asarray, m)))
        for m in zip(*motions, strict=True)
    ]
    np.testing.assert_allclose(jax.jit(jax.vmap(ours))(*motions), theirs, rtol=1e-12, atol=1e-12)


# --- what is physical -------------------------------------------------------------------------


@pytest.mark.parametrize("name", TWO_LINKED)
def test_inertia_of_any_real_arm_is_positive_definite(name):
    build, _, aligned = TWO_LINKED[name]
    links = draw_links(8, 300, aligned)
    smallest = jax.jit(jax.vmap(lambda one: build(one).smallest_inertia()))(links)
    assert np.all(np.asarray(smallest) > 0)


def smallest(arm):
    """The smallest inertia as a number."""
    return float(arm.smallest_inertia())


def test_inertia_of_an_impossible_arm_is_not_positive():
    # det M = ZZ1r ZZ2 - (L |MX2| cos)², and M22 = ZZ2, must be positive.
    assert smallest(SCARA(ZZ1r=1.0, ZZ2=0.04, MX2=0.39)) > 0
    assert smallest(SCARA(ZZ1r=1.0, ZZ2=0.04, MX2=0.41)) < 0
    assert smallest(SCARA(ZZ1r=1.0, ZZ2=0.04, MX2=0.0, MY2=-0.41)) < 0
    assert smallest(SCARA(ZZ1r=-1.0, ZZ2=0.04)) < 0
    assert smallest(TwoLink(p1=0.1, p2=0.05, p3=0.07)) > 0
    assert smallest(TwoLink(p1=0.1, p2=0.05, p3=0.072)) < 0
    assert smallest(TwoLink(p1=0.1, p2=0.05, p5=0.2, link_length=0.4)) < 0
    assert smallest(Axis(M=-1.0)) < 0 < smallest(Axis(M=1.0))


@pytest.mark.parametrize("angle", [0.1, 0.13, 1.3, 2.0])
def test_smallest_inertia_sees_every_direction(angle):
    """The second joint's worst angle lies between the points of the workspace, wherever it is."""
    # 25 points are 15 degrees apart: between them the cosine falls to 0.9914 at the most.
    reach = 0.4 / np.cos(np.pi / 24) * (1 + 1e-9)
    arm = SCARA(ZZ1r=1.0, ZZ2=0.04, MX2=reach * np.cos(angle), MY2=reach * np.sin(angle))
    assert smallest(arm) < 0


# --- the rest of an arm's interface -----------------------------------------------------------


def test_units_and_joints():
    assert (SCARA().joints, TwoLink().joints, Axis().joints) == (2, 2, 1)
    assert SCARA().units() == (("N·m", "N·m"), ("rad", "rad"))
    assert Axis().units() == (("N",), ("m",))
    assert Axis().prismatic() == (True,)
    for arm in (SCARA(), TwoLink(), Axis()):
        assert arm.workspace().shape[1] == arm.joints


def test_two_link_needs_one_of_coupling_and_length():
    with pytest.raises(ModelError, match="give one, because p3 = link_length"):
        TwoLink(p3=0.05, link_length=0.3)
    assert float(TwoLink(p5=0.2).coupling) == pytest.approx(0.05)
    assert float(TwoLink(p5=0.2, link_length=0.3).coupling) == pytest.approx(0.06)
    assert [p.name for p in list_parameters(TwoLink(link_length=0.3))] == ["p1", "p2", "p4", "p5"]
    assert len(list_parameters(TwoLink())) == 5


# --- energy -----------------------------------------------------------------------------------


class FrictionWork(AbstractEffect):
    """Counts the work that viscous and Coulomb friction of the given sizes take, J."""

    viscous: jax.Array
    level: jax.Array

    def initial_state(self):
        """None yet."""
        return jnp.zeros(1)

    def derivative(self, motion):
        """Power, W."""
        needed = self.viscous * motion.v + self.level * smooth_sign(motion.v, jnp.asarray(0.01))
        return jnp.sum(needed * motion.v)[None]


def released(loop, viscous, level, substeps):
    """Energy along a motion without torque from a start that moves, and the friction's work."""
    friction = [
        kind for j in (1, 2) for kind in (Viscous(j, viscous[j - 1]), Coulomb(j, level[j - 1]))
    ]
    counter = FrictionWork(jnp.asarray(viscous), jnp.asarray(level))
    loop = dataclasses.replace(
        loop,
        controller=OpenLoop(),
        effects=(*friction, counter),
        stepping=jaxid.Stepping(substeps=substeps),
    )
    time = np.arange(0.0, 2.005, 0.01)
    still = np.ones((len(time), 2))
    start = jaxid.Recording(time, still * (0.9, -0.6), 0 * still, v=still * (1.0, 2.0))
    (run,) = jaxid.simulate(loop, start)
    mass = jax.vmap(loop.arm.mass_matrix)(jnp.asarray(run.q))
    energy = 0.5 * np.einsum("ki,kij,kj->k", run.v, np.asarray(mass), run.v)
    if isinstance(loop.arm, TwoLink):
        height = -loop.arm.p4 * np.cos(run.q[:, 0]) - loop.arm.p5 * np.cos(run.q.sum(axis=1))
        energy = energy + loop.arm.g * np.asarray(height)
    return run, energy, run.states[:, -1]


@pytest.mark.parametrize("name", ["scara", "two_link"])
def test_free_motion_keeps_its_energy(name):
    loop, none = PAIRS[name][0], np.zeros(2)
    run, coarse, _ = released(loop, none, none, 2)
    _, fine, _ = released(loop, none, none, 4)
    np.testing.assert_allclose(run.q[0], (0.9, -0.6), rtol=1e-12)
    np.testing.assert_allclose(run.v[0], (1.0, 2.0), rtol=1e-12)
    moving = np.abs(run.v).max() ** 2 * 0.1
    # Steps of 2.5 ms of method order four, with motions of some 10 rad/s: (0.025)^4 is 4e-7.
    assert np.ptp(fine) < 4e-7 * moving
    # Halving the step of a method of order four leaves a sixteenth of the drift, or less.
    assert np.ptp(fine) < np.ptp(coarse) / 12


@pytest.mark.parametrize("name", ["scara", "two_link"])
def test_energy_lost_is_the_work_of_friction(name):
    loop = PAIRS[name][0]
    _, energy, work = released(loop, np.array([0.05, 0.02]), np.array([0.2, 0.04]), 4)
    assert work[-1] > 0.1
    assert np.all(np.diff(work) >= 0)
    # Where a velocity changes its sign, friction turns over within 1/(100 · acceleration), a step
    # or so: that one step does a millesimal of the work and has no order, say a thousandth of it.
    np.testing.assert_allclose(energy + work, energy[0], atol=1e-6 * work[-1])
