"""The torque of a planned motion, against Pinocchio and closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from jaxid.effects import ActuatorLag, CarriedBody, Hysteresis, JointElasticity
from jaxid.errors import ModelError

TIME = np.linspace(0.0, 3.0, 61)
URDF = """<robot name="two"><link name="base"/>
 <link name="upper"><inertial><origin xyz="0.2 0.01 0"/><mass value="4"/>
  <inertia ixx="0.02" iyy="0.1" izz="0.1" ixy="0.003" ixz="0" iyz="0"/></inertial></link>
 <link name="fore"><inertial><origin xyz="0.15 0 0.02"/><mass value="2"/>
  <inertia ixx="0.01" iyy="0.04" izz="0.04" ixy="0" ixz="0.001" iyz="0"/></inertial></link>
 <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
  <axis xyz="0 1 0"/></joint>
 <joint name="elbow" type="continuous"><parent link="upper"/><child link="fore"/>
  <origin xyz="0.4 0 0" rpy="0.3 0 0"/><axis xyz="0 0 1"/></joint></robot>"""


def motion():
    """Position, velocity and acceleration of two joints, `(samples, joints)`."""
    rate, size = np.array([2.0, 3.1]), np.array([0.7, 0.4])
    phase = TIME[:, None] * rate
    return size * np.sin(phase), size * rate * np.cos(phase), -size * rate**2 * np.sin(phase)


def test_torque_of_a_urdf_arm_is_pinocchios_with_friction_and_rotors():
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.buildModelFromXML(URDF)
    data, (q, v, a) = model.createData(), motion()
    turning = np.stack([np.cos(q), np.sin(q)], axis=2).reshape(len(q), -1)
    rigid = [pinocchio.rnea(model, data, *x) for x in zip(turning, v, a, strict=True)]
    loop = jaxid.serial(URDF, rotors=(0.3, 0.1))
    offset = {"Fv1": 2.0, "Fv2": 0.5, "Fc1": 3.0, "offset2": 0.7, "eps1": 0.01}
    values = [offset.get(name, float(x)) for name, x in zip(loop.names, loop.theta, strict=True)]
    found = jaxid.inverse_dynamics(loop.with_theta(jnp.array(values)), TIME, q, v, a)
    friction = np.stack([2 * v[:, 0] + 6 / np.pi * np.arctan(v[:, 0] / 0.01), 0.5 * v[:, 1]], 1)
    expected = np.array(rigid) + a * [0.3, 0.1] + friction + [0.0, 0.7]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_states_of_effects_follow_the_motion():
    """Far from a reversal Dahl's model is dry friction."""
    effect = Hysteresis(joint=1, level=0.3, slide=0.01)
    loop = jaxid.two_link().with_effects([effect])
    ramp = np.stack([0.5 * TIME, 0.0 * TIME], axis=1)
    rate, still = np.tile([0.5, 0.0], (len(TIME), 1)), np.zeros_like(ramp)
    bare = jaxid.inverse_dynamics(loop.with_effects([]), TIME, ramp, rate, still)
    found = jaxid.inverse_dynamics(loop, TIME, ramp, rate, still) - bare
    assert found[0, 0] == 0.0
    np.testing.assert_allclose(found[-20:], np.tile([0.3, 0.0], (20, 1)), rtol=1e-6, atol=1e-12)


def test_a_payload_of_one_recording_acts_in_that_one():
    loop = jaxid.serial(URDF)
    loop = loop.add(CarriedBody(loop.arm.chain, mass=2.0, recordings=("loaded",)))
    plain, loaded = (
        jaxid.inverse_dynamics(loop, TIME, *motion(), recording=name) for name in ("", "loaded")
    )
    assert np.abs(loaded - plain).max() > 1.0


def test_a_drive_that_changes_its_torque_is_refused():
    q, v, a = motion()
    for effect in (ActuatorLag(joint=1), JointElasticity(joint=1)):
        with pytest.raises(ModelError, match=effect.effect_name()):
            jaxid.inverse_dynamics(jaxid.two_link().add(effect), TIME, q, v, a)
    with pytest.raises(ModelError, match=r"q has shape \(61, 1\)"):
        jaxid.inverse_dynamics(jaxid.two_link(), TIME, q[:, :1], v[:, :1], a[:, :1])
