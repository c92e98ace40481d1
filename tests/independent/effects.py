"""Physical effects with their physics written out; joints count from 1; zero amplitude is absence.

Sign convention: torques returned here are needed from the drive, as friction is.
`place` says where an effect acts; `amplitudes` which fields make it large or small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from .plants import sigma


@dataclass(frozen=True)
class Effect:
    """Base of all effects: what it is called, where it acts, which fields scale it."""

    name = ""
    place = ""
    amplitudes = ()
    largest = math.inf  # physical cap of the amplitudes, in their unit

    def scaled(self, factor: float) -> Effect:
        """The same effect with its amplitudes times `factor`, capped where physics does."""
        old = [getattr(self, f) for f in self.amplitudes]
        top = max((abs(x) for x in old), default=0.0)
        if top * abs(factor) > self.largest:
            factor = math.copysign(self.largest / top, factor)
        return replace(self, **{f: x * factor for f, x in zip(self.amplitudes, old, strict=True)})


# --- torques on the motor side of the joint: f(t, q, v) with the motor's position and velocity ---


@dataclass(frozen=True)
class Stribeck(Effect):
    """Extra friction near standstill: torque (N m) exp(-(v/velocity)^2) sigma(v)."""

    joint: int
    torque: float
    velocity: float
    gamma: float = 100.0
    name, place, amplitudes = "stribeck", "motor", ("torque",)

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        return self.torque * math.exp(-((v / self.velocity) ** 2)) * sigma(v, self.gamma)


@dataclass(frozen=True)
class AsymmetricFriction(Effect):
    """Half the difference of Fv (N m s) and Fc (N m) between the two directions."""

    joint: int
    viscous: float
    coulomb: float
    gamma: float = 100.0
    name, place, amplitudes = "asymmetric_friction", "motor", ("viscous", "coulomb")

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m: (viscous v + coulomb sigma) sigma, so Fv+- = Fv +- viscous, Fc likewise."""
        s = sigma(v, self.gamma)
        return (self.viscous * v + self.coulomb * s) * s


@dataclass(frozen=True)
class QuadraticDrag(Effect):
    """Drag v|v| times `drag`, N m s2."""

    joint: int
    drag: float
    name, place, amplitudes = "quadratic_drag", "motor", ("drag",)

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        return self.drag * v * abs(v)


@dataclass(frozen=True)
class PositionDependentFriction(Effect):
    """Coulomb friction that varies over a turn; A1, B1, A2, B2 in N m."""

    joint: int
    A1: float
    B1: float
    A2: float
    B2: float
    gamma: float = 100.0
    name, place = "position_dependent_friction", "motor"
    amplitudes = ("A1", "B1", "A2", "B2")

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        wave = self.A1 * math.cos(q) + self.B1 * math.sin(q)
        wave += self.A2 * math.cos(2 * q) + self.B2 * math.sin(2 * q)
        return wave * sigma(v, self.gamma)


@dataclass(frozen=True)
class TorqueRipple(Effect):
    """Cogging: A cos(n q) + B sin(n q), N m."""

    joint: int
    A: float
    B: float
    harmonic: float
    name, place, amplitudes = "torque_ripple", "motor", ("A", "B")

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        return self.A * math.cos(self.harmonic * q) + self.B * math.sin(self.harmonic * q)


@dataclass(frozen=True)
class TorqueOffset(Effect):
    """Constant torque, N m."""

    joint: int
    torque: float
    name, place, amplitudes = "torque_offset", "motor", ("torque",)

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        return self.torque


@dataclass(frozen=True)
class FrictionStep(Effect):
    """Coulomb friction that jumps by `coulomb` N m at `time` s."""

    joint: int
    coulomb: float
    time: float
    gamma: float = 100.0
    name, place, amplitudes = "friction_step", "motor", ("coulomb",)

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        return self.coulomb * sigma(v, self.gamma) if t >= self.time else 0.0


@dataclass(frozen=True)
class VelocityBump(Effect):
    """Friction bump around one speed: torque (N m), velocity and width (rad/s)."""

    joint: int
    torque: float
    velocity: float
    width: float
    gamma: float = 100.0
    name, place, amplitudes = "velocity_bump", "motor", ("torque",)

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m."""
        bump = math.exp(-(((abs(v) - self.velocity) / self.width) ** 2))
        return self.torque * bump * sigma(v, self.gamma)


# --- motor side, other forms ---


@dataclass(frozen=True)
class ThermalDrift(Effect):
    """Base Fv and Fc of the joint times 1 + amplitude exp(-t/time_constant)."""

    joint: int
    amplitude: float
    time_constant: float
    name, place, amplitudes, largest = "thermal_drift", "base_friction", ("amplitude",), 3.0

    def factor(self, t: float) -> float:
        """Factor on the base friction, 1."""
        return 1.0 + self.amplitude * math.exp(-t / self.time_constant)


@dataclass(frozen=True)
class LoadDependentFriction(Effect):
    """Coulomb friction ratio |tau_out| sigma(v), tau_out what reaches the link (Hamon 2010)."""

    joint: int
    ratio: float
    gamma: float = 100.0
    name, place, amplitudes, largest = "load_dependent_friction", "load", ("ratio",), 0.6

    def delivered(self, net: float, v: float) -> float:
        """tau_out of tau_out + ratio sigma(v) |tau_out| = net, N m; closed form as ratio < 1."""
        s = self.ratio * sigma(v, self.gamma)
        return net / (1.0 + s) if net >= 0.0 else net / (1.0 - s)


@dataclass(frozen=True)
class Dahl(Effect):
    """Presliding friction of Dahl: torque N m, displacement rad; state between -1 and 1."""

    joint: int
    torque: float
    displacement: float
    name, place, amplitudes = "hysteresis", "bristle", ("torque",)

    def rate(self, z: float, v: float) -> float:
        """State derivative, 1/s."""
        return (v - abs(v) * z) / self.displacement

    def needed_of_state(self, z: float, v: float) -> float:
        """Torque, N m."""
        return self.torque * z


@dataclass(frozen=True)
class LuGre(Effect):
    """LuGre in units of its sliding torque (N m): displacement rad, Stribeck excess and speed.

    The bristle's damping is `damping` s times the state's rate; viscous friction is the base's.
    """

    joint: int
    torque: float
    displacement: float
    excess: float = 0.4
    velocity: float = 0.15
    damping: float = 0.005
    name, place, amplitudes = "hysteresis", "bristle", ("torque",)

    def rate(self, z: float, v: float) -> float:
        """State derivative, 1/s."""
        steady = 1.0 + self.excess * math.exp(-((v / self.velocity) ** 2))
        return (v - abs(v) * z / steady) / self.displacement

    def needed_of_state(self, z: float, v: float) -> float:
        """Torque, N m."""
        return self.torque * (z + self.damping * self.rate(z, v))


# --- torques on the link: f(t, q, v) with all links' positions and velocities ---


@dataclass(frozen=True)
class Spring(Effect):
    """Spring: stiffness N m/rad, rest angle rad."""

    joint: int
    stiffness: float
    rest: float
    name, place, amplitudes = "spring", "link", ("stiffness",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        return self.stiffness * (q[self.joint - 1] - self.rest)


@dataclass(frozen=True)
class PeriodicDisturbance(Effect):
    """amplitude (N m) sin(2 pi frequency (Hz) t + phase)."""

    joint: int
    amplitude: float
    frequency: float
    phase: float
    name, place, amplitudes = "periodic_disturbance", "link", ("amplitude",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        return self.amplitude * math.sin(2 * math.pi * self.frequency * t + self.phase)


@dataclass(frozen=True)
class EndStop(Effect):
    """Spring (N m/rad) beyond an angle (rad): above it if positive, below it if negative."""

    joint: int
    stiffness: float
    angle: float
    name, place, amplitudes = "end_stop", "link", ("stiffness",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        beyond = q[self.joint - 1] - self.angle
        return self.stiffness * beyond if beyond * self.angle > 0.0 else 0.0


@dataclass(frozen=True)
class TorqueBump(Effect):
    """Gaussian torque (N m) around one angle, width in rad."""

    joint: int
    torque: float
    angle: float
    width: float
    name, place, amplitudes = "torque_bump", "link", ("torque",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        return self.torque * math.exp(-(((q[self.joint - 1] - self.angle) / self.width) ** 2))


@dataclass(frozen=True)
class CrossCoupling(Effect):
    """Torque (N m) by the other joint's angle: sin(harmonic q_other + phase)."""

    joint: int
    torque: float
    harmonic: float
    phase: float
    name, place, amplitudes = "cross_coupling", "link", ("torque",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        return self.torque * math.sin(self.harmonic * q[2 - self.joint] + self.phase)


@dataclass(frozen=True)
class CrossBump(Effect):
    """Torque (N m) by the other joint's angle: Gaussian around `angle` rad."""

    joint: int
    torque: float
    angle: float
    width: float
    name, place, amplitudes = "cross_bump", "link", ("torque",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        return self.torque * math.exp(-(((q[2 - self.joint] - self.angle) / self.width) ** 2))


@dataclass(frozen=True)
class CubicDeadSpring(Effect):
    """Cubic spring (N m/rad3) beyond a dead zone of +-dead rad."""

    joint: int
    stiffness: float
    dead: float
    name, place, amplitudes = "cubic_dead_spring", "link", ("stiffness",)

    def needed(self, t: float, q: list[float], v: list[float]) -> float:
        """Torque, N m."""
        x = q[self.joint - 1]
        return self.stiffness * math.copysign(max(abs(x) - self.dead, 0.0) ** 3, x)


@dataclass(frozen=True)
class Gravity(Effect):
    """Base not level: in-plane gravity (m/s2) and the first moment (kg m) that joint 1 carries.

    Potential U = -(g . sum of first moments); link 2's moments are the plant's.
    """

    gx: float
    gy: float
    first_moment: float
    joint: int | None = None
    name, place, amplitudes, largest = "gravity", "gravity", ("gx", "gy"), 9.81

    def needed_of_moments(self, mx: float, my: float, q: list[float]) -> tuple[float, float]:
        """Torques on both joints, N m."""
        c1, s1 = math.cos(q[0]), math.sin(q[0])
        c12, s12 = math.cos(q[0] + q[1]), math.sin(q[0] + q[1])
        second = self.gx * (mx * s12 + my * c12) - self.gy * (mx * c12 - my * s12)
        return second + self.first_moment * (self.gx * s1 - self.gy * c1), second


# --- inertia ---


@dataclass(frozen=True)
class RotorInertia(Effect):
    """Inertia (kg m2) that turns with this joint's own velocity only: adds J a_j to tau_j."""

    joint: int
    inertia: float
    name, place, amplitudes = "rotor_inertia", "rotor", ("inertia",)


@dataclass(frozen=True)
class AccelerationSquare(Effect):
    """An odd one: coefficient (N m s4) a|a| on the joint's own acceleration; coefficient >= 0."""

    joint: int
    coefficient: float
    name, place, amplitudes = "acceleration_square", "acceleration", ("coefficient",)


@dataclass(frozen=True)
class Payload(Effect):
    """Point mass (kg) on the last link, `reach` m from its joint, in the named recordings only."""

    mass: float
    reach: float
    recordings: tuple[str, ...] = ("fit_2",)
    joint: int | None = None
    name, place, amplitudes = "payload", "payload", ("mass",)


# --- on the way from command to drive torque ---


@dataclass(frozen=True)
class DriveGain(Effect):
    """Delivered = (1 + gain) commanded."""

    joint: int
    gain: float
    name, place, amplitudes, largest = "drive_gain", "gain", ("gain",), 0.5


@dataclass(frozen=True)
class ActuatorLag(Effect):
    """First-order lag of the drive torque, s."""

    joint: int
    time_constant: float
    name, place, amplitudes, largest = "actuator_lag", "lag", ("time_constant",), 0.08


@dataclass(frozen=True)
class TimeDelay(Effect):
    """Dead time between command and drive torque, s."""

    joint: int
    delay: float
    name, place, amplitudes, largest = "time_delay", "delay", ("delay",), 0.04


@dataclass(frozen=True)
class TorqueSaturation(Effect):
    """Drive torque limited to +-limit, N m; infinite means absent."""

    joint: int
    limit: float
    name, place = "torque_saturation", "saturation"

    def scaled(self, factor: float) -> TorqueSaturation:
        """Stronger for a larger factor, that is a lower limit; 0 gives none."""
        return replace(self, limit=self.limit / factor if factor else math.inf)


# --- between motor and link, and the sensor ---


@dataclass(frozen=True)
class JointElasticity(Effect):
    """Compliance (rad/(N m)) between a motor (kg m2, taken from the joint's inertia) and its link.

    Spong's model: M_jj loses the motor's inertia, the motor has its own equation, encoder and
    friction. Damping is `damping` s times the stiffness.
    """

    joint: int
    compliance: float
    motor_inertia: float
    damping: float = 1e-3
    name, place, amplitudes = "joint_elasticity", "transmission", ("compliance",)

    def absent(self) -> bool:
        """Rigid?"""
        return self.compliance == 0.0

    def transmitted(self, twist: float, rate: float) -> float:
        """Torque (N m) on the link for a twist (rad, motor minus link) and its rate (rad/s)."""
        return (twist + self.damping * rate) / self.compliance


@dataclass(frozen=True)
class Backlash(Effect):
    """Gap (rad, from flank to flank) between motor and link; contact N m/rad, damping s/rad."""

    joint: int
    gap: float
    motor_inertia: float
    stiffness: float
    damping: float = 3.0
    name, place, amplitudes, largest = "backlash", "transmission", ("gap",), 0.3

    def absent(self) -> bool:
        """Rigid?"""
        return self.gap == 0.0

    def transmitted(self, twist: float, rate: float) -> float:
        """Torque (N m) on the link; damping after Hunt and Crossley, so that contact is smooth."""
        depth = abs(twist) - 0.5 * self.gap
        if depth <= 0.0:
            return 0.0
        side = 1.0 if twist > 0.0 else -1.0
        return side * self.stiffness * depth * max(0.0, 1.0 + self.damping * side * rate)


@dataclass(frozen=True)
class EncoderEccentricity(Effect):
    """Reads q + amplitude (rad) sin(q + phase); the controller sees this and its derivative."""

    joint: int
    amplitude: float
    phase: float
    name, place, amplitudes, largest = "encoder_eccentricity", "sensor", ("amplitude",), 0.2

    def read(self, q: float, v: float) -> tuple[float, float]:
        """Position (rad) and velocity (rad/s) as read."""
        return (
            q + self.amplitude * math.sin(q + self.phase),
            v * (1.0 + self.amplitude * math.cos(q + self.phase)),
        )


CATALOGUE = (
    "stribeck",
    "asymmetric_friction",
    "quadratic_drag",
    "load_dependent_friction",
    "position_dependent_friction",
    "hysteresis",
    "joint_elasticity",
    "backlash",
    "torque_ripple",
    "torque_offset",
    "drive_gain",
    "actuator_lag",
    "time_delay",
    "torque_saturation",
    "gravity",
    "spring",
    "payload",
    "rotor_inertia",
    "thermal_drift",
    "periodic_disturbance",
    "end_stop",
    "encoder_eccentricity",
)
OUTSIDE = (
    "torque_bump",
    "friction_step",
    "cross_coupling",
    "cross_bump",
    "cubic_dead_spring",
    "velocity_bump",
    "acceleration_square",
)
