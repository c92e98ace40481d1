"""Rigid bodies and their base friction, as their equations stand in the literature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

TWO_OVER_PI = 2.0 / math.pi


def sigma(v: float, gamma: float) -> float:
    """Smooth sign of a velocity (rad/s or m/s): 2/pi atan(gamma v)."""
    return TWO_OVER_PI * math.atan(gamma * v)


class Plant(Protocol):
    """What the simulation needs of a rigid body."""

    joints: int
    gamma: float

    def friction_parameters(self) -> tuple[tuple[float, float], ...]: ...

    def drive_offsets(self) -> tuple[float, ...]: ...

    def inertia(self, q: Sequence[float]) -> list[list[float]]: ...

    def bias(self, q: Sequence[float], v: Sequence[float]) -> list[float]: ...


@dataclass(frozen=True)
class Scara:
    """SCARA of Brunot et al. 2016: ZZ kg m2, MX and MY kg m, Fv N m s, Fc N m, L m."""

    ZZ1r: float = 3.44
    Fv1: float = 0.07
    Fc1: float = 0.23
    ZZ2: float = 0.06
    MX2: float = 0.24
    MY2: float = 0.01
    Fv2: float = 0.003
    Fc2: float = 0.05
    L: float = 0.5
    gamma: float = 100.0
    joints = 2
    base = ("ZZ1r", "Fv1", "Fc1", "ZZ2", "MX2", "MY2", "Fv2", "Fc2")

    def friction_parameters(self) -> tuple[tuple[float, float], ...]:
        """(Fv, Fc) of each joint, N m s and N m."""
        return (self.Fv1, self.Fc1), (self.Fv2, self.Fc2)

    def drive_offsets(self) -> tuple[float, ...]:
        """None, N m."""
        return 0.0, 0.0

    def inertia(self, q: Sequence[float]) -> list[list[float]]:
        """Mass matrix, kg m2."""
        h = self.L * (self.MX2 * math.cos(q[1]) - self.MY2 * math.sin(q[1]))
        return [[self.ZZ1r + self.ZZ2 + 2 * h, self.ZZ2 + h], [self.ZZ2 + h, self.ZZ2]]

    def bias(self, q: Sequence[float], v: Sequence[float]) -> list[float]:
        """Coriolis and centrifugal torques, N m."""
        k = self.L * (self.MX2 * math.sin(q[1]) + self.MY2 * math.cos(q[1]))
        return [-k * v[1] * (2 * v[0] + v[1]), k * v[0] * v[0]]

    def energy(self, q: Sequence[float], v: Sequence[float]) -> float:
        """Kinetic energy, J."""
        return kinetic_energy(self, q, v)

    def second_link_moments(self) -> tuple[float, float]:
        """First moments of link 2 along and across it, kg m."""
        return self.MX2, self.MY2

    def with_payload(self, mass: float, reach: float) -> Scara:
        """The same arm with a point mass (kg) on link 2, `reach` m from joint 2."""
        return replace(
            self,
            ZZ1r=self.ZZ1r + mass * self.L**2,
            ZZ2=self.ZZ2 + mass * reach**2,
            MX2=self.MX2 + mass * reach,
        )


@dataclass(frozen=True)
class TwoLink:
    """Two links under gravity, q1 from hanging down: p1..p3 kg m2, p4 and p5 kg m."""

    p1: float = 0.108
    p2: float = 0.0443
    p3: float = 0.0333
    p4: float = 0.349
    p5: float = 0.111
    Fv1: float = 0.005
    Fc1: float = 0.08
    Fv2: float = 0.003
    Fc2: float = 0.05
    g: float = 9.81
    link_1: float = 0.3
    gamma: float = 100.0
    joints = 2
    base = ("p1", "p2", "p3", "p4", "p5", "Fv1", "Fc1", "Fv2", "Fc2")

    def friction_parameters(self) -> tuple[tuple[float, float], ...]:
        """(Fv, Fc) of each joint, N m s and N m."""
        return (self.Fv1, self.Fc1), (self.Fv2, self.Fc2)

    def drive_offsets(self) -> tuple[float, ...]:
        """None, N m."""
        return 0.0, 0.0

    def inertia(self, q: Sequence[float]) -> list[list[float]]:
        """Mass matrix, kg m2."""
        h = self.p3 * math.cos(q[1])
        return [[self.p1 + self.p2 + 2 * h, self.p2 + h], [self.p2 + h, self.p2]]

    def bias(self, q: Sequence[float], v: Sequence[float]) -> list[float]:
        """Coriolis, centrifugal and gravity torques, N m."""
        k = self.p3 * math.sin(q[1])
        g2 = self.g * self.p5 * math.sin(q[0] + q[1])
        return [
            -k * v[1] * (2 * v[0] + v[1]) + self.g * self.p4 * math.sin(q[0]) + g2,
            k * v[0] * v[0] + g2,
        ]

    def energy(self, q: Sequence[float], v: Sequence[float]) -> float:
        """Kinetic and potential energy, J."""
        height = -self.p4 * math.cos(q[0]) - self.p5 * math.cos(q[0] + q[1])
        return kinetic_energy(self, q, v) + self.g * height

    def second_link_moments(self) -> tuple[float, float]:
        """First moments of link 2 along and across it, kg m."""
        return self.p5, 0.0

    def with_payload(self, mass: float, reach: float) -> TwoLink:
        """The same arm with a point mass (kg) on link 2, `reach` m from joint 2."""
        return replace(
            self,
            p1=self.p1 + mass * self.link_1**2,
            p2=self.p2 + mass * reach**2,
            p3=self.p3 + mass * self.link_1 * reach,
            p4=self.p4 + mass * self.link_1,
            p5=self.p5 + mass * reach,
        )


@dataclass(frozen=True)
class Axis:
    """One prismatic axis: M kg, Fv N/(m/s), Fc N, offset N; gamma s/m as EMPS needs it."""

    M: float = 95.1
    Fv: float = 203.5
    Fc: float = 20.4
    offset: float = -3.16
    gamma: float = 1e4
    joints = 1
    base = ("M", "Fv", "Fc", "offset")

    def friction_parameters(self) -> tuple[tuple[float, float], ...]:
        """(Fv, Fc) of the axis, N/(m/s) and N."""
        return ((self.Fv, self.Fc),)

    def drive_offsets(self) -> tuple[float, ...]:
        """What the drive spends on itself (its amplifier's offset), N: no load of its table."""
        return (self.offset,)

    def inertia(self, q: Sequence[float]) -> list[list[float]]:
        """Mass, kg."""
        return [[self.M]]

    def bias(self, q: Sequence[float], v: Sequence[float]) -> list[float]:
        """None, N."""
        return [0.0]

    def energy(self, q: Sequence[float], v: Sequence[float]) -> float:
        """Kinetic energy, J."""
        return kinetic_energy(self, q, v)

    def with_payload(self, mass: float, reach: float) -> Axis:
        """The same axis with a mass (kg) on its table; `reach` has no meaning here."""
        return replace(self, M=self.M + mass)


def kinetic_energy(plant: Plant, q: Sequence[float], v: Sequence[float]) -> float:
    """Half v' M v, J."""
    m = plant.inertia(q)
    joints = range(plant.joints)
    return 0.5 * sum(v[i] * m[i][j] * v[j] for i in joints for j in joints)


def inverse_dynamics(
    plant: Plant, q: Sequence[float], v: Sequence[float], a: Sequence[float]
) -> list[float]:
    """Drive torque (N m or N) of the base model, base friction included."""
    m, b = plant.inertia(q), plant.bias(q, v)
    return [
        sum(m[j][i] * a[i] for i in range(plant.joints))
        + b[j]
        + fv * v[j]
        + fc * sigma(v[j], plant.gamma)
        + plant.drive_offsets()[j]
        for j, (fv, fc) in enumerate(plant.friction_parameters())
    ]


def solve_accelerations(m: Sequence[Sequence[float]], r: Sequence[float]) -> list[float]:
    """Accelerations of m a = r for one or two joints."""
    if len(r) == 1:
        return [r[0] / m[0][0]]
    (a, b), (c, d) = m
    det = a * d - b * c
    return [(d * r[0] - b * r[1]) / det, (a * r[1] - c * r[0]) / det]
