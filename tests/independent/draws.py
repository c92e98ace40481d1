"""Random robots, effects and noise filters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from . import effects as fx
from .effects import CATALOGUE, OUTSIDE, Effect
from .plants import Axis, Plant, Scara, TwoLink
from .simulate import Simulation

ROBOTS: dict[str, Plant] = {"scara": Scara(), "two_link": TwoLink(), "axis": Axis()}


def draw_parameters(
    rng: np.random.Generator, robot: str = "scara", spread: float = 0.12
) -> Scara | TwoLink | Axis:
    """A robot with every base parameter within +-spread of the published values."""
    plant = ROBOTS[robot]
    factors = rng.uniform(1 - spread, 1 + spread, len(plant.base))
    return replace(
        plant,
        **{k: getattr(plant, k) * float(f) for k, f in zip(plant.base, factors, strict=True)},
    )


def free_inertia(m: list[list[float]], j: int) -> float:
    """What joint j (from 0) feels of a mass matrix while the other joint is free, kg m2."""
    if len(m) == 1:
        return m[0][0]
    o = 1 - j
    return m[j][j] - m[j][o] * m[o][j] / m[o][o]


def applicable(robot: str) -> tuple[str, ...]:
    """Names of all effects, catalogue and outside, that make sense on a robot."""
    # One axis cannot tell them from its own mass, friction and offset, or has no other joint.
    same = ("gravity", "rotor_inertia", "torque_offset", "drive_gain")
    pointless = (*same, "cross_coupling", "cross_bump")
    return tuple(n for n in CATALOGUE + OUTSIDE if robot != "axis" or n not in pointless)


@dataclass(frozen=True)
class Scale:
    """Sizes of a motion per joint (rad, rad/s, rad/s2, N m, kg m2), its duration in s."""

    q_low: tuple[float, ...]
    q_high: tuple[float, ...]
    v: tuple[float, ...]
    a: tuple[float, ...]
    tau: tuple[float, ...]
    tau_top: tuple[float, ...]
    inertia: tuple[float, ...]
    duration: float

    @classmethod
    def of(cls, plant: Plant, runs: Sequence[Simulation]) -> Scale:
        """Ranges and root mean squares over several runs."""

        def over(name: str, f: Callable[[np.ndarray], np.ndarray]) -> tuple[float, ...]:
            return tuple(f(np.concatenate([getattr(r, name) for r in runs])).tolist())

        def rms(x: np.ndarray) -> np.ndarray:
            return np.sqrt(np.mean(x**2, axis=0))

        inertia = [
            free_inertia(plant.inertia([0.0] * plant.joints), j) for j in range(plant.joints)
        ]
        return cls(
            over("q", lambda x: x.min(axis=0)),
            over("q", lambda x: x.max(axis=0)),
            over("v", rms),
            over("a", rms),
            over("tau", rms),
            over("tau", lambda x: np.abs(x).max(axis=0)),
            tuple(inertia),
            float(runs[0].time[-1]),
        )


# A typical SCARA motion, for draws without a simulation at hand.
TYPICAL = Scale(
    (-2.0, -2.0), (2.0, 2.0), (0.8, 1.3), (1.5, 5.0), (3.0, 0.35), (7.0, 1.2), (3.2, 0.051), 20.0
)


def draw_effect(
    name: str,
    joint: int | None,
    rng: np.random.Generator,
    scale: Scale = TYPICAL,
    plant: Plant = ROBOTS["scara"],
) -> Effect:
    """A random effect by its name on joint 1, 2, ... (None: any), of a size to be calibrated."""
    count = len(scale.tau)
    whole = name in ("gravity", "payload")
    if name not in applicable("axis" if count == 1 else "scara"):
        raise ValueError(f"{name!r} is no effect, or none for a robot of {count} joint(s)")
    if joint is None and not whole:
        # A rotor on joint 1 of these arms is part of its base inertia.
        first = 2 if name == "rotor_inertia" else 1
        joint = int(rng.integers(first, count + 1))
    j = (joint or 1) - 1
    size = float(scale.tau[j] * rng.uniform(0.03, 0.1))
    sign = float(rng.choice([-1.0, 1.0]))
    v, gamma = scale.v[j], plant.gamma
    low, high = scale.q_low[j], scale.q_high[j]
    travel = 0.5 * (high - low)
    # The axis' cascade is ten times as fast as the arms' PD: its mechanics must be too.
    stiffer = 5.0 if count == 1 else 1.0

    def uniform(a: float, b: float) -> float:
        return float(rng.uniform(a, b))

    def elsewhere() -> float:
        # A place well inside the other joint's travel.
        o = count - 1 - j
        return uniform(0.7 * scale.q_low[o], 0.7 * scale.q_high[o])

    match name:
        case "stribeck":
            return fx.Stribeck(joint, size, v * uniform(0.08, 0.35), gamma)
        case "asymmetric_friction":
            share = uniform(0.3, 1.0)
            both = sign * size * (1 - share) / v * float(rng.choice([-1.0, 1.0]))
            exponent = 1.0 if share > 0.65 else 2.0
            return fx.AsymmetricFriction(joint, both, sign * size * share, gamma, exponent)
        case "quadratic_drag":
            return fx.QuadraticDrag(joint, size / v**2)
        case "load_dependent_friction":
            return fx.LoadDependentFriction(joint, uniform(0.05, 0.15), gamma)
        case "position_dependent_friction":
            return fx.PositionDependentFriction(joint, *(rng.normal(0, size, 4).tolist()), gamma)
        case "hysteresis":
            slide = uniform(0.005, 0.03) * travel
            if rng.uniform() < 0.5:
                return fx.Dahl(joint, size, slide)
            return fx.LuGre(joint, size, slide, uniform(0.2, 0.6), v * uniform(0.1, 0.3))
        case "joint_elasticity":
            inertia = scale.inertia[j]
            rate = 2 * math.pi * uniform(4.0, 9.0) * stiffer
            return fx.JointElasticity(joint, 1 / (inertia * rate**2), inertia * uniform(0.15, 0.4))
        case "backlash":
            share, inertia = uniform(0.2, 0.45), scale.inertia[j]
            reduced = inertia * share * (1 - share)
            stiff = reduced * (uniform(120.0, 180.0) * stiffer) ** 2
            return fx.Backlash(joint, uniform(0.003, 0.01) * travel, inertia * share, stiff)
        case "torque_ripple":
            turn = uniform(0, 2 * math.pi)
            n = float(rng.integers(3, 13)) if count == 2 else float(rng.integers(6, 30)) / travel
            return fx.TorqueRipple(joint, size * math.cos(turn), size * math.sin(turn), n)
        case "torque_offset":
            return fx.TorqueOffset(joint, sign * size)
        case "drive_gain":
            return fx.DriveGain(joint, sign * uniform(0.03, 0.1))
        case "actuator_lag":
            return fx.ActuatorLag(joint, uniform(0.005, 0.02))
        case "time_delay":
            return fx.TimeDelay(joint, uniform(0.005, 0.02))
        case "torque_saturation":
            return fx.TorqueSaturation(joint, scale.tau_top[j] * uniform(0.7, 0.85))
        case "gravity":
            if isinstance(plant, TwoLink):
                # Along the plumb line it would only rescale p4 and p5: the base leans sideways.
                return fx.Gravity(0.0, sign * 0.2, plant.p4)
            turn, tilt = uniform(0, 2 * math.pi), 0.1
            return fx.Gravity(tilt * math.cos(turn), tilt * math.sin(turn), uniform(1.5, 4.0))
        case "spring":
            return fx.Spring(joint, size / travel, uniform(-0.4, 0.4) * travel)
        case "payload":
            reach = uniform(0.12, 0.22) if isinstance(plant, TwoLink) else uniform(0.25, 0.45)
            return fx.Payload(0.1 * scale.inertia[-1] / (reach**2 if count == 2 else 1.0), reach)
        case "rotor_inertia":
            return fx.RotorInertia(joint, scale.inertia[j] * uniform(0.05, 0.3))
        case "thermal_drift":
            return fx.ThermalDrift(joint, uniform(0.3, 0.8), scale.duration * uniform(0.15, 0.5))
        case "periodic_disturbance":
            f = math.exp(uniform(math.log(0.3), math.log(8.0)))
            return fx.PeriodicDisturbance(joint, size, f, uniform(0, 2 * math.pi))
        case "end_stop":
            end = high if sign > 0 else low
            return fx.EndStop(joint, size / (0.2 * travel), end * uniform(0.55, 0.8))
        case "encoder_eccentricity":
            return fx.EncoderEccentricity(joint, uniform(0.005, 0.03), uniform(0, 2 * math.pi))
        case "torque_bump":
            place = uniform(0.7 * low, 0.7 * high)
            return fx.TorqueBump(joint, sign * size, place, travel * uniform(0.06, 0.2))
        case "friction_step":
            return fx.FrictionStep(joint, size, scale.duration * uniform(0.3, 0.7), gamma)
        case "cross_coupling":
            return fx.CrossCoupling(joint, size, uniform(2.0, 4.0), uniform(0, 2 * math.pi))
        case "cross_bump":
            return fx.CrossBump(joint, sign * size, elsewhere(), uniform(0.2, 0.5))
        case "cubic_dead_spring":
            dead = uniform(0.2, 0.5) * travel
            return fx.CubicDeadSpring(joint, size / travel**3, dead)
        case "velocity_bump":
            middle = v * uniform(0.6, 1.3)
            return fx.VelocityBump(joint, sign * size, middle, middle * uniform(0.15, 0.35), gamma)
        case "acceleration_square":
            return fx.AccelerationSquare(joint, size / scale.a[j] ** 2)
    raise ValueError(f"no draw for {name!r}")


@dataclass(frozen=True)
class Noise:
    """Torque noise e / A(z) per joint, A = 1 + a1 z^-1 + ...; `level` of the torque's norm."""

    ar: tuple[tuple[float, ...], ...] = ((), ())
    level: float = 0.015

    def samples(self, tau: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Noise for the torques (samples, joints), stationary from the first sample on."""
        columns = []
        for coefficients, signal in zip(self.ar, tau.T, strict=True):
            white = rng.standard_normal(len(signal) + 2000)
            n = lfilter([1.0], [1.0, *coefficients], white)[2000:]
            columns.append(n * self.level * np.linalg.norm(signal) / np.linalg.norm(n))
        return np.stack(columns, axis=1)


def draw_noise(
    rng: np.random.Generator, colour: str = "moderate", joints: int = 2, level: float = 0.015
) -> Noise:
    """`white`, `moderate` (AR(2), poles of radius 0.4 to 0.8) or `strong` (AR(2), about 0.97)."""
    ar = []
    for _ in range(joints):
        if colour == "white":
            ar.append(())
            continue
        if colour == "moderate":
            radius, angle = rng.uniform(0.4, 0.8), rng.uniform(0.2, 1.5)
        elif colour == "strong":
            radius, angle = rng.uniform(0.955, 0.98), rng.uniform(0.03, 0.5)
        else:
            raise ValueError(f"no noise is called {colour!r}")
        ar.append((-2 * float(radius * math.cos(angle)), float(radius**2)))
    return Noise(tuple(ar), level)
