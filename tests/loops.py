"""Loops of the independent simulator's arms, and its recordings, for the tests of simulation."""

import dataclasses
from collections.abc import Sequence
from functools import cache

import equinox as eqx
import independent as sim
import jax.numpy as jnp
import numpy as np

import jaxid
from jaxid.effects import AbstractEffect, Motion, on_joint
from jaxid.parameters import Scalar, parameter

LINES = sim.MultiSine(
    (((0.5, 2.0, 0.3), (0.2, 5.0, 1.0)), ((0.6, 3.0, 2.0), (0.2, 6.0, 0.5))), rise=1.0
)
MOVES = sim.Trapezoid(((0.05, 0.05, 0.2, 3.0), (0.5, -0.03, 0.25, 4.0)))
SCARA_VALUES = {
    "ZZ1r": 3.44,
    "ZZ2": 0.06,
    "MX2": 0.24,
    "MY2": 0.01,
    "Fv1": 0.07,
    "Fc1": 0.23,
    "Fv2": 0.003,
    "Fc2": 0.05,
}
TWO_LINK_VALUES = {
    "p1": 0.108,
    "p2": 0.0443,
    "p3": 0.0333,
    "p4": 0.349,
    "p5": 0.111,
    "Fv1": 0.005,
    "Fc1": 0.08,
    "Fv2": 0.003,
    "Fc2": 0.05,
}
TWO_LINK_GAINS = {"Kp": (60.0, 120.0), "Kv": (10.0, 15.0), "Kg": (0.15, 0.045)}
EMPS_VALUES = {"M": 95.1, "Fv1": 203.5, "Fc1": 20.4, "offset1": -3.16, "eps1": 1e-4}
FINE = jaxid.Stepping(substeps=8)
# A tenth of a millimetre's worth of torque: the spline through the reference errs by 2e-6 rad
# where the fading's third derivative jumps, 60 rad/s³ · (10 ms)³ / 24; gains are up to 22 N·m/rad.
SPLINE = {"rtol": 0, "atol": 5e-5}


def four_joints() -> str:
    """A URDF of an arm that turns about crossing axes, with one sliding joint."""
    axes = ("0 0 1", "0 1 0", "1 0 0", "0 1 0")
    kinds = ("revolute", "revolute", "prismatic", "revolute")
    parts = ['<robot name="four"><link name="l0"/>']
    for k, (axis, kind) in enumerate(zip(axes, kinds, strict=True), start=1):
        parts.append(
            f'<link name="l{k}"><inertial><origin xyz="0.1 0.02 0.{k}" rpy="0.1 0.2 0"/>'
            f'<mass value="{5 - k}"/><inertia ixx="0.0{k}" iyy="0.05" izz="0.04" ixy="0.001" '
            f'ixz="0.002" iyz="0"/></inertial></link>'
            f'<joint name="j{k}" type="{kind}"><parent link="l{k - 1}"/><child link="l{k}"/>'
            f'<origin xyz="0.2 0 0.1" rpy="0 0.{k} 0.1"/><axis xyz="{axis}"/>'
            f'<limit lower="-2" upper="2" effort="99" velocity="9"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def scara(*effects, stepping=FINE):
    """The SCARA of the independent plant, with more effects."""
    loop = jaxid.scara().with_values(**SCARA_VALUES).add(*effects)
    return dataclasses.replace(loop, stepping=stepping)


def recorded(run):
    """A run of the independent simulator as a recording."""
    return jaxid.Recording(run.time, run.q, run.tau, q_ref=run.q_ref)


@cache
def plain():
    """The independent SCARA without any effect, 1.5 s."""
    return sim.simulate(sim.Scara(), LINES, sim.PD(), duration=1.5)


def simulated(loop, record=None):
    """jaxid's run of one recording."""
    return jaxid.simulate(loop, recorded(plain()) if record is None else record)[0]


def independent_torque(*effects):
    """The independent simulator's torque with effects."""
    return sim.simulate(sim.Scara(), LINES, sim.PD(), effects, duration=1.5).tau


def relative(ours, theirs):
    """Difference in norm, relative, joint by joint."""
    return np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)


class QuadraticDrag(AbstractEffect):
    """Drag v|v|."""

    joint: int = eqx.field(static=True)
    drag: Scalar = parameter(0.0, symbol="drag", unit="N·m·s²/rad²", scale=0.01)

    def torque(self, motion: Motion):
        """On its joint."""
        v = motion.v[self.joint - 1]
        return on_joint(self.joint, self.drag * v * jnp.abs(v), motion)


def sines(
    time: np.ndarray, sizes: Sequence[float], frequencies: Sequence[float], phases: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration of a sum of sines, `(samples,)` each.

    **Arguments:**

    - `time`: s. `sizes`: rad or m. `frequencies`: Hz. `phases`: rad.
    """
    rates = 2 * np.pi * np.asarray(frequencies)

    def motion(order: int) -> np.ndarray:
        turned = time[:, None] * rates + phases + order * np.pi / 2
        return (np.asarray(sizes) * rates**order * np.sin(turned)).sum(axis=1)

    return motion(0), motion(1), motion(2)
