"""The independent simulator against MuJoCo, conservation laws and itself."""

import csv
import math
from dataclasses import replace

import independent as sim
import numpy as np
import pytest
from independent import effects as fx
from independent.draws import ROBOTS
from independent.loop import Loop
from independent.plants import solve_accelerations
from independent.references import onset, trapezoid_move

EVERY = sim.CATALOGUE + sim.OUTSIDE
REFERENCE = sim.draw_multisine(np.random.default_rng(7), 6.0, bands=((0.1, 0.5), (0.15, 1.2)))
STILL = sim.MultiSine(((), ()))
SHORT = 4.0


def run(effects=(), plant=None, duration=SHORT, **options):
    """A short SCARA run on the common reference."""
    return sim.simulate(plant or sim.Scara(), REFERENCE, None, effects, duration, **options)


SCALE = sim.Scale.of(sim.Scara(), [run()])


def draw(name, joint=None):
    """The effect of that name as drawn for the common run."""
    joint = 2 if joint is None and name not in ("gravity", "payload") else joint
    return sim.draw_effect(name, joint, np.random.default_rng(3), SCALE, ROBOTS["scara"])


# --- the rigid bodies, against a second implementation of the same mechanics ---

LINKS = {  # kg, m, kg m2 about the centre of mass; plain numbers with nothing symmetric
    "mass": (5.3, 1.7),
    "com": ((0.21, 0.0), (0.17, 0.03)),
    "izz": (0.31, 0.045),
    "length": 0.5,
}


def mujoco_arm(gravity, link_1_com, link_2_com, armature=0.0, payload=(0.0, 0.0)):
    """MuJoCo model of two links in the xy plane with one inertia per link."""
    mujoco = pytest.importorskip("mujoco")
    (m1, m2), (i1, i2) = LINKS["mass"], LINKS["izz"]
    tool = ""
    if payload[0]:
        # A point mass; MuJoCo wants some inertia, too small to be felt.
        tool = (
            f'<body pos="{payload[1]} 0 0">'
            f'<inertial pos="0 0 0" mass="{payload[0]}" diaginertia="1e-12 1e-12 1e-12"/></body>'
        )
    xml = f"""<mujoco><option gravity="{gravity[0]} {gravity[1]} 0"/><worldbody>
    <body><joint type="hinge" axis="0 0 1"/>
    <inertial pos="{link_1_com[0]} {link_1_com[1]} 0" mass="{m1}" diaginertia="{i1} {i1} {i1}"/>
    <body pos="{LINKS["length"]} 0 0"><joint type="hinge" axis="0 0 1" armature="{armature}"/>
    <inertial pos="{link_2_com[0]} {link_2_com[1]} 0" mass="{m2}" diaginertia="{i2} {i2} {i2}"/>
    {tool}</body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    return mujoco, model, mujoco.MjData(model)


def mujoco_accelerations(arm, q, v, tau):
    """Accelerations at one state, rad/s2."""
    mujoco, model, data = arm
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def assert_same_accelerations(arm, plant, effects):
    """Loop and MuJoCo agree at random states under random torques."""
    loop = Loop(plant, effects, None)
    rng = np.random.default_rng(11)
    for _ in range(50):
        q, v, tau = rng.uniform(-3, 3, 2), rng.uniform(-4, 4, 2), rng.uniform(-5, 5, 2)
        ours = loop.rate(0.0, [*q, *v], tau)[2:4]
        # Both are closed forms in double precision; MuJoCo's quaternions lose some digits.
        np.testing.assert_allclose(ours, mujoco_accelerations(arm, q, v, tau), rtol=1e-9, atol=1e-9)


def scara_of_links(link_1_com):
    """The SCARA's base parameters, frictionless, of LINKS."""
    (m1, m2), (i1, i2), (x2, y2) = LINKS["mass"], LINKS["izz"], LINKS["com"][1]
    length = LINKS["length"]
    return sim.Scara(
        ZZ1r=i1 + m1 * (link_1_com[0] ** 2 + link_1_com[1] ** 2) + m2 * length**2,
        ZZ2=i2 + m2 * (x2**2 + y2**2),
        MX2=m2 * x2,
        MY2=m2 * y2,
        Fv1=0.0,
        Fc1=0.0,
        Fv2=0.0,
        Fc2=0.0,
        L=length,
    )


def test_scara_agrees_with_mujoco():
    com = LINKS["com"][0]
    assert_same_accelerations(mujoco_arm((0, 0), *LINKS["com"]), scara_of_links(com), [])


def test_tilted_loaded_scara_with_rotor_agrees_with_mujoco():
    com, (m1, m2) = LINKS["com"][0], LINKS["mass"]
    arm = mujoco_arm((0.7, -0.4), *LINKS["com"], armature=0.02, payload=(0.6, 0.33))
    moment = m1 * com[0] + (m2 + 0.6) * LINKS["length"]
    effects = [fx.Gravity(0.7, -0.4, moment), fx.RotorInertia(2, 0.02), fx.Payload(0.6, 0.33)]
    assert_same_accelerations(arm, scara_of_links(com), effects)


def test_two_link_arm_agrees_with_mujoco():
    (m1, m2), (i1, i2), length = LINKS["mass"], LINKS["izz"], LINKS["length"]
    r1, r2 = 0.21, 0.17
    plant = sim.TwoLink(
        p1=i1 + m1 * r1**2 + m2 * length**2,
        p2=i2 + m2 * r2**2,
        p3=m2 * length * r2,
        p4=m1 * r1 + m2 * length,
        p5=m2 * r2,
        Fv1=0.0,
        Fc1=0.0,
        Fv2=0.0,
        Fc2=0.0,
        link_1=length,
    )
    # Down is along x, where both links point at zero angles.
    assert_same_accelerations(mujoco_arm((9.81, 0), (r1, 0), (r2, 0)), plant, [])
    loaded = mujoco_arm((9.81, 0), (r1, 0), (r2, 0), payload=(0.4, 0.25))
    assert_same_accelerations(loaded, plant, [fx.Payload(0.4, 0.25)])


@pytest.mark.parametrize("plant", [sim.Scara(), sim.TwoLink()])
def test_free_motion_conserves_energy(plant):
    free = replace(plant, Fv1=0.0, Fc1=0.0, Fv2=0.0, Fc2=0.0)
    still = sim.OpenLoop(lambda t: (0.0, 0.0))
    motion = sim.simulate(
        free, STILL, still, duration=SHORT, q0=(0.8, -1.1), v0=(0.5, 2.0), rtol=1e-11, atol=1e-13
    )
    energy = [free.energy(q, v) for q, v in zip(motion.q, motion.v, strict=True)]
    kinetic = max(free.energy(q, v) for q, v in zip(motion.q, motion.v, strict=True))
    # Some 400 steps, each with an error of rtol of the state.
    assert np.ptp(energy) < 1e-8 * abs(kinetic)


def test_inverse_dynamics_returns_the_pd_torque():
    plant, motion = sim.Scara(), run()
    state = zip(motion.q, motion.v, motion.a, strict=True)
    expected = [sim.inverse_dynamics(plant, *s) for s in state]
    np.testing.assert_allclose(motion.tau, expected, atol=1e-12)
    law = [3.5 * (6.25 * (motion.q_ref[:, 0] - motion.q[:, 0]) - 2.0 * motion.v[:, 0])]
    law += [0.06 * (156.25 * (motion.q_ref[:, 1] - motion.q[:, 1]) - 25.0 * motion.v[:, 1])]
    np.testing.assert_allclose(motion.tau, np.transpose(law), atol=1e-12)


def test_velocity_and_acceleration_are_derivatives_of_the_reading():
    effects = [fx.EncoderEccentricity(2, 0.05, 1.0), fx.JointElasticity(1, 0.01, 0.8)]
    # Friction that turns over within 1/(gamma a), some 20 ms, is smooth at a sample of 1 ms.
    motion = run(effects, sim.Scara(gamma=5.0), sample=1e-3)
    slope = np.gradient(motion.q, 1e-3, axis=0)[2:-2]
    bend = np.gradient(motion.v, 1e-3, axis=0)[2:-2]
    # Central differences err by h^2/6 times the third derivative: of q below 1e3 rad/s3, of v
    # that of friction, 2 rad/s2 turning over in 20 ms twice, and of the shaft's ringing.
    np.testing.assert_allclose(slope, motion.v[2:-2], atol=2e-4)
    np.testing.assert_allclose(bend, motion.a[2:-2], atol=5e-3)


# --- effects ---


@pytest.fixture(scope="module")
def rigid():
    """The run without any effect."""
    return run()


@pytest.mark.parametrize("name", EVERY)
def test_effect_without_amplitude_changes_nothing(name, rigid):
    none = draw(name).scaled(0.0)
    # Additional states (of a bristle) share in the step control; delays use the same steps.
    np.testing.assert_allclose(run([none]).tau, rigid.tau, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", EVERY)
def test_drawn_effect_is_made_as_visible_as_asked(name, rigid):
    effect, reached = sim.calibrate(
        draw(name), 3.0, sim.Scara(), [REFERENCE], sim.PD(), duration=SHORT, tolerance=0.2
    )
    assert reached == pytest.approx(3.0, rel=0.2)
    # Calibration runs at a loose tolerance, 1e-6, some 1e-4 of the noise's norm.
    assert sim.visibility([run([effect])], [rigid], 0.015) == pytest.approx(reached, rel=1e-3)


@pytest.mark.parametrize("name", ["torque_ripple", "hysteresis", "time_delay", "backlash"])
def test_tolerance_is_tight_enough(name):
    coarse = run([draw(name)]).tau
    fine = run([draw(name)], rtol=5e-10, atol=5e-12).tau
    assert np.linalg.norm(coarse - fine) < 1e-5 * np.linalg.norm(fine)


def test_stiff_or_quick_effects_approach_the_rigid_loop(rigid):
    """Elasticity, lag and delay have the rigid loop as their limit, in the order of their size."""
    for effect in (
        fx.JointElasticity(2, 2e-3, 0.015),
        fx.ActuatorLag(2, 4e-3),
        fx.TimeDelay(2, 4e-3),
    ):
        whole = np.linalg.norm(run([effect]).tau - rigid.tau)
        half = np.linalg.norm(run([effect.scaled(0.5)]).tau - rigid.tau)
        assert 0.4 < half / whole < 0.6, effect


def test_delay_arrives_when_it_should():
    push = sim.OpenLoop(lambda t: (0.0, math.sin(3 * t)))
    later = sim.OpenLoop(lambda t: (0.0, math.sin(3 * max(0.0, t - 0.0137))))
    delayed = sim.simulate(sim.Scara(), STILL, push, [fx.TimeDelay(2, 0.0137)], duration=2.0)
    shifted = sim.simulate(sim.Scara(), STILL, later, duration=2.0)
    # The torque has a kink where it arrives, which the step control resolves to its tolerance.
    np.testing.assert_allclose(delayed.q, shifted.q, atol=1e-7)


def test_load_dependent_friction_satisfies_its_definition():
    friction = fx.LoadDependentFriction(1, 0.3)
    for net in (2.0, -1.5):
        for v in (0.4, -0.02):
            out = friction.delivered(net, v)
            s = 2 / math.pi * math.atan(100 * v)
            assert out + 0.3 * abs(out) * s == pytest.approx(net, rel=1e-14)


@pytest.mark.parametrize("joint", [1, 2])
def test_acceleration_square_satisfies_its_equation(joint):
    plant, x, u = sim.Scara(), [0.3, -0.7, 0.5, 1.5], (2.0, -0.4)
    a = Loop(plant, [fx.AccelerationSquare(joint, 0.02)], None).rate(0.0, x, u)[2:]
    tau = sim.inverse_dynamics(plant, x[:2], x[2:], a)
    tau[joint - 1] += 0.02 * a[joint - 1] * abs(a[joint - 1])
    assert tau == pytest.approx(u, rel=1e-12)


def test_effects_compose():
    first, second = fx.TorqueOffset(1, 0.2), fx.TorqueOffset(1, 0.1)
    np.testing.assert_allclose(
        run([first, second]).tau, run([fx.TorqueOffset(1, 0.3)]).tau, atol=1e-9
    )


def test_motor_cannot_take_more_inertia_than_there_is():
    with pytest.raises(ValueError, match="more inertia"):
        run([fx.JointElasticity(2, 0.01, 0.07)])


# --- sampled control ---


def test_sampled_control_approaches_continuous_control(rigid):
    """A hold is a delay of half a period on average, so the difference is of first order."""
    gaps = [
        np.linalg.norm(
            sim.simulate(sim.Scara(), REFERENCE, sim.SampledPD(p), (), SHORT).tau - rigid.tau
        )
        for p in (0.01, 0.005)
    ]
    assert 0.45 < gaps[1] / gaps[0] < 0.55


def test_axis_follows_the_emps_cascade():
    moves = sim.Trapezoid(((0.1, 0.08, 0.2, 2.0),))
    cascade = sim.EmpsCascade()
    motion = sim.simulate(sim.Axis(), moves, cascade, duration=1.2, sample=1e-3)
    assert np.abs(motion.tau).max() <= 10.0 * cascade.gtau
    assert abs(motion.q[-1, 0] - 0.08) < 2e-4
    read = np.round(motion.q[:, 0] / cascade.resolution) * cascade.resolution
    mean = 0.5 * (read + np.r_[read[0], read[:-1]])
    speed = np.diff(mean, prepend=mean[0]) / 1e-3
    volt = cascade.kp * cascade.kv * (motion.q_ref[:, 0] - read) - cascade.kv * speed
    np.testing.assert_allclose(motion.tau[:, 0], cascade.gtau * np.clip(volt, -10, 10), atol=1e-6)
    late = sim.simulate(
        sim.Axis(), moves, sim.EmpsCascade(delay_samples=1), duration=1.2, sample=1e-3
    )
    dead = sim.simulate(
        sim.Axis(), moves, cascade, [fx.TimeDelay(1, 1e-3)], duration=1.2, sample=1e-3
    )
    assert np.abs(late.q - motion.q).max() > 1e-6
    # One sample late inside the controller or behind it is the same thing.
    np.testing.assert_allclose(late.q, dead.q, atol=1e-12)


# --- references, noise, files ---


@pytest.mark.parametrize("reference", [REFERENCE, sim.draw_smooth_steps(np.random.default_rng(1))])
def test_references_start_at_rest(reference):
    at = np.array([reference.position(t) for t in (0.0, 1e-3, 2e-3)])
    # Of third order in time: position, velocity and acceleration vanish.
    assert np.all(np.abs(at) < 1e-6)
    np.testing.assert_allclose(at[2], 8 * at[1], rtol=0.2)


def test_trapezoid_arrives_and_stops():
    assert trapezoid_move(10.0, -0.3, 0.2, 1.0) == -0.3
    assert trapezoid_move(0.85, 0.3, 0.2, 1.0) == pytest.approx(0.15)
    assert onset(0.5, 1.0) == pytest.approx(0.5)


@pytest.mark.parametrize("colour", ["white", "moderate", "strong"])
def test_noise_has_its_level_and_colour(colour):
    rng = np.random.default_rng(0)
    noise = sim.draw_noise(rng, colour)
    tau = np.ones((20_000, 2)) * (3.0, 0.3)
    n = noise.samples(tau, rng)
    level = np.linalg.norm(n, axis=0) / np.linalg.norm(tau, axis=0)
    np.testing.assert_allclose(level, 0.015, rtol=1e-12)
    for column, coefficients in zip(n.T, noise.ar, strict=True):
        white = np.convolve(column, [1.0, *coefficients], mode="valid")
        lagged = np.corrcoef(white[1:], white[:-1])[0, 1]
        # Five standard deviations of the correlation of independent samples.
        assert abs(lagged) < 5 / math.sqrt(len(white))


def test_case_is_calibrated_reproducible_and_written(tmp_path):
    case = sim.make_case(5, [("stribeck", 2)], multiple=4.0, duration=5.0)
    again = sim.make_case(5, [("stribeck", 2)], multiple=4.0, duration=5.0)
    clean = sim.make_case(5, duration=5.0)
    assert case.multiples[0] == pytest.approx(4.0, rel=0.1)
    assert clean.plant == case.plant
    assert clean.references == case.references
    for name, r in case.recordings.items():
        np.testing.assert_array_equal(r["tau"], again.recordings[name]["tau"])
        np.testing.assert_allclose(r["noise_floor_percent"], 1.5, atol=0.05)
        assert np.abs(r["q"] - r["q_true"]).max() <= math.pi / 40_000 + 1e-12
    assert max(sim.remaining_in_inverse_dynamics(clean)) < 1e-9
    assert sim.remaining_in_inverse_dynamics(case)[1] > 1.0
    sim.write_case(tmp_path, case)
    with open(tmp_path / "held_out.csv") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time", "q_ref_1", "q_ref_2", "q_1", "q_2", "tau_1", "tau_2"]
    assert len(rows) == 502
    written = np.array(rows[1:], dtype=float)
    np.testing.assert_allclose(written[:, 5:], case.recordings["held_out"]["tau"], atol=5.1e-9)


def test_effect_can_hide_in_the_base_parameters():
    hidden = sim.make_case(5, [fx.Payload(0.05, 0.3, sim.cases.RECORDINGS)], duration=5.0)
    left = sim.remaining_after_refit(hidden)
    # A payload carried always is only another arm; what is left is of second order.
    assert max(left) < 0.3


def test_dynamics_solver_handles_both_sizes():
    m = [[3.0, 0.4], [0.4, 0.2]]
    np.testing.assert_allclose(solve_accelerations(m, [1.0, 2.0]), np.linalg.solve(m, [1.0, 2.0]))
    assert solve_accelerations([[4.0]], [2.0]) == [0.5]
