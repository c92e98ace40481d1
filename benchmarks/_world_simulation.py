"""A random robot under a sampled law, simulated by MuJoCo at 0.1 ms."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from ._world_physics import Friction, Reference, Robot

STEP = 1e-4
TICK = 10  # steps


class Undrawable(ValueError):
    """The drawn numbers give no usable simulation."""


@dataclass(frozen=True)
class Law:
    """PD, optionally with integral, at 1 kHz from encoders; velocity by low-passed difference.

    A command acts `delay` ticks after its reading.
    """

    Kp: tuple[float, ...]
    Ki: tuple[float, ...]
    Kd: tuple[float, ...]
    resolution: tuple[float, ...]
    cutoff: float = 150.0
    delay: int = 0


class Acting(Protocol):
    """A torque on a joint (from 0) that opposes the drive."""

    joint: int

    def reset(self) -> None:
        """The state at rest."""
        ...

    def torque(
        self, t: float, q: Sequence[float], v: Sequence[float], tau: Sequence[float], dt: float
    ) -> float:
        """The torque, N·m or N, after a step of time."""
        ...


@dataclass(frozen=True)
class Signals:
    """Simulated signals at 1 kHz, `(ticks, joints)`; `speed` and `drive` are exact."""

    time: np.ndarray
    q: np.ndarray
    tau: np.ndarray
    q_ref: np.ndarray
    speed: np.ndarray


def loaded(robot: Robot, frictions: Sequence[Friction]) -> mujoco.MjModel:
    """MuJoCo's model of the robot with rotors, and with dry friction for that kind of friction."""
    model = mujoco.MjModel.from_xml_string(robot.urdf())
    model.opt.timestep = STEP
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.jnt_limited[:] = 0
    model.dof_armature[:] = [link.rotor for link in robot.links]
    model.dof_damping[:] = [f.viscous for f in frictions]
    model.dof_frictionloss[:] = [f.coulomb if f.family == "dry" else 0.0 for f in frictions]
    return model


def inertias(robot: Robot) -> np.ndarray:
    """Diagonal of the mass matrix at rest, `(joints,)`."""
    plain = [Friction(0.0, 0.0, "tanh", 1.0)] * len(robot.links)
    model = loaded(robot, plain)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    columns = np.zeros((model.nv, model.nv))
    for j, unit in enumerate(np.eye(model.nv)):
        mujoco.mj_mulM(model, data, columns[j], unit)
    return np.diag(columns).copy()


def simulate(
    robot: Robot,
    frictions: Sequence[Friction],
    law: Law,
    reference: Reference,
    duration: float,
    others: Sequence[Acting] = (),
) -> Signals:
    """A run from rest; commanded torque is held between ticks.

    **Raises:** `Undrawable` if the simulation diverges.
    """
    model = loaded(robot, frictions)
    data = mujoco.MjData(model)
    n = len(robot.links)
    for other in others:
        other.reset()
    ticks = round(duration * 1000)
    rows: dict[str, list] = {"q": [], "tau": [], "q_ref": [], "speed": []}
    before, speed, integral = [0.0] * n, [0.0] * n, [0.0] * n
    smooth = 1.0 - math.exp(-2 * math.pi * law.cutoff * STEP * TICK)
    period = STEP * TICK
    waiting = [[0.0] * n] * law.delay
    for k in range(ticks):
        asked = reference.at(k * period)
        ahead = reference.at((k + 1) * period)
        q = [round(x / r) * r for x, r in zip(data.qpos.tolist(), law.resolution, strict=True)]
        tau = [0.0] * n
        for j in range(n):
            speed[j] += smooth * ((q[j] - before[j]) / period - speed[j])
            error = asked[j] - q[j]
            integral[j] += error * period
            rate = (ahead[j] - asked[j]) / period - speed[j]
            tau[j] = law.Kp[j] * error + law.Ki[j] * integral[j] + law.Kd[j] * rate
        before = q
        for name, row in (("q", q), ("tau", tau), ("q_ref", asked)):
            rows[name].append(row)
        rows["speed"].append(data.qvel.tolist())
        waiting.append(tau)
        drive = waiting.pop(0)
        for step in range(TICK):
            t, at, v = k * period + step * STEP, data.qpos.tolist(), data.qvel.tolist()
            acting = list(drive)
            for j, friction in enumerate(frictions):
                acting[j] -= friction.coulomb * friction.sign(v[j])
            for other in others:
                acting[other.joint] -= other.torque(t, at, v, drive, STEP)
            data.qfrc_applied[:] = acting
            mujoco.mj_step(model, data)
    arrays = {name: np.array(row) for name, row in rows.items()}
    # MuJoCo restarts a simulation that diverges, and goes on.
    restarted = data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number > 0
    if restarted or not all(np.isfinite(x).all() for x in arrays.values()):
        raise Undrawable(f"the simulation of {robot.name} diverged")
    return Signals(np.arange(ticks) * period, **arrays)
