"""Reference trajectories that start at rest; positions in rad or m, times in s."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Reference(Protocol):
    """Reference positions of all joints at one time."""

    def position(self, t: float) -> Sequence[float]: ...


def onset(t: float, rise: float) -> float:
    """Quintic step from 0 to 1 in `rise` s; first and second derivative vanish at both ends."""
    if t >= rise:
        return 1.0
    if t <= 0.0:
        return 0.0
    s = t / rise
    return s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)


@dataclass(frozen=True)
class MultiSine:
    """Sum of sines per joint, faded in: tuples (amplitude rad, rate rad/s, phase rad)."""

    lines: tuple[tuple[tuple[float, float, float], ...], ...]
    rise: float = 1.5

    def position(self, t: float) -> list[float]:
        """Reference positions, rad."""
        w, sin = onset(t, self.rise), math.sin
        return [w * sum([a * sin(r * t + p) for a, r, p in joint]) for joint in self.lines]


@dataclass(frozen=True)
class SmoothSteps:
    """Steps with quintic flanks per joint: levels (rad) held `hold` s, flanks of `rise` s."""

    levels: tuple[tuple[float, ...], ...]
    hold: float = 1.5
    rise: float = 0.8

    def position(self, t: float) -> list[float]:
        """Reference positions, rad; every level is reached from the one before, from 0."""
        k = max(0, int(t / self.hold))
        w = onset(t - k * self.hold, self.rise)
        result = []
        for joint in self.levels:
            here = joint[min(k, len(joint) - 1)]
            before = 0.0 if k == 0 else joint[min(k - 1, len(joint) - 1)]
            result.append(before + (here - before) * w)
        return result


@dataclass(frozen=True)
class Trapezoid:
    """Axis moves with trapezoidal velocity: (start s, distance m, speed m/s, acceleration m/s2)."""

    moves: tuple[tuple[float, float, float, float], ...]

    def position(self, t: float) -> list[float]:
        """Reference position, m."""
        return [sum(trapezoid_move(t - t0, d, v, a) for t0, d, v, a in self.moves if t > t0)]


def trapezoid_move(t: float, distance: float, speed: float, acceleration: float) -> float:
    """Position (m) after t s of one move; short moves are triangles in velocity."""
    sign, d = math.copysign(1.0, distance), abs(distance)
    v = min(speed, math.sqrt(d * acceleration))
    ramp = v / acceleration
    end = d / v + ramp
    if t >= end:
        return distance
    if t < ramp:
        return sign * 0.5 * acceleration * t * t
    if t > end - ramp:
        return sign * (d - 0.5 * acceleration * (end - t) ** 2)
    return sign * v * (t - 0.5 * ramp)


def peak(reference: Reference, duration: float) -> np.ndarray:
    """Largest absolute reference position of each joint, rad or m."""
    grid = np.array([reference.position(t) for t in np.arange(0.0, duration, 0.02)])
    return np.abs(grid).max(axis=0)


def draw_multisine(
    rng: np.random.Generator,
    duration: float = 20.0,
    amplitude: tuple[float, float] = (1.6, 2.3),
    bands: tuple[tuple[float, float], ...] = ((0.04, 0.4), (0.1, 1.0)),
    lines: int = 6,
) -> MultiSine:
    """Random multi-sine; its peak (rad) is drawn in `amplitude`, frequencies in `bands` (Hz)."""
    joints = []
    for low, high in bands:
        f = np.exp(rng.uniform(math.log(low), math.log(high), lines))
        # The spectrum falls with frequency: an arm moves far when slow and little when fast.
        a = rng.uniform(0.4, 1.0, lines) / (1.0 + (f / (0.5 * high)) ** 2)
        p = rng.uniform(0.0, 2 * math.pi, lines)
        joints.append(tuple(zip(a.tolist(), (2 * math.pi * f).tolist(), p.tolist(), strict=True)))
    rise = float(rng.uniform(1.0, 2.0))
    top = peak(MultiSine(tuple(joints), rise), duration)
    scale = rng.uniform(*amplitude, len(bands)) / top
    return MultiSine(
        tuple(
            tuple((a * float(s), r, p) for a, r, p in joint)
            for joint, s in zip(joints, scale, strict=True)
        ),
        rise,
    )


def draw_smooth_steps(
    rng: np.random.Generator, duration: float = 20.0, amplitude: float = 1.8, joints: int = 2
) -> SmoothSteps:
    """Random steps within +-amplitude (rad) with flanks slow enough for the arm to follow."""
    hold = float(rng.uniform(1.2, 2.2))
    count = int(duration / hold) + 1
    levels = tuple(tuple(rng.uniform(-amplitude, amplitude, count).tolist()) for _ in range(joints))
    return SmoothSteps(levels, hold, float(rng.uniform(0.7, 1.0)) * hold)


def draw_trapezoids(
    rng: np.random.Generator, duration: float = 10.0, stroke: float = 0.1
) -> Trapezoid:
    """Random moves of an axis within +-stroke m, with pauses."""
    moves, t, here = [], 0.2, 0.0
    while True:
        there = float(rng.uniform(-stroke, stroke))
        v, a = float(rng.uniform(0.05, 0.3)), float(rng.uniform(0.5, 2.5))
        d = there - here
        ramp = min(v, math.sqrt(abs(d) * a)) / a
        end = t + abs(d) / (ramp * a) + ramp
        if end > duration:
            return Trapezoid(tuple(moves))
        moves.append((t, d, v, a))
        t, here = end + float(rng.uniform(0.05, 0.4)), there
