"""Torques on the links, given all links' positions and velocities; inertia."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .effect import Effect


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
