"""On the way from command to drive torque, between motor and link, and the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from .effect import Effect


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
