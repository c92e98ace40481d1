"""Torques on the motor's side of a joint, given the motor's position and velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .effect import Effect
from .plants import sigma


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
    """Half the difference of Fv (N m s) and Fc (N m) between the two directions.

    With exponent 1 the friction of each direction has the shape of sigma; with 2 the difference is
    smooth at standstill.
    """

    joint: int
    viscous: float
    coulomb: float
    gamma: float = 100.0
    exponent: float = 1.0
    name, place, amplitudes = "asymmetric_friction", "motor", ("viscous", "coulomb")

    def needed(self, t: float, q: float, v: float) -> float:
        """Torque, N m: Fv+- = Fv +- viscous, and Fc likewise, in steady motion."""
        return self.viscous * abs(v) + self.coulomb * abs(sigma(v, self.gamma)) ** self.exponent


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
