"""A library of mechanical effects: named torques of a joint along a motion.

It was written for the baselines, from textbooks, and shares no formula with jaxid's catalogue. It
contains the shapes of the effects that the worlds hide, on a grid. A constant counts as asymmetric
friction, because the worlds hide no other constant torque.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ._baseline_rows import Columns, Motion, Table, residual

# Number of the highest tones of the residual that become disturbance candidates, by joint.
TONES = 6


@dataclass(frozen=True)
class Candidate:
    """Columns of one effect on one joint (from 0), with a shape from a grid."""

    family: str
    joint: int
    columns: Columns


def library(table: Table, slides: tuple[bool, ...]) -> list[Candidate]:
    """All candidates for all joints.

    **Arguments:**

    - `slides`: whether each joint is prismatic; ripples and turns are only for revolute joints.
    """
    tones = _tones(table)
    return [
        Candidate(family, j, columns)
        for j in range(table.joints)
        for family, columns in _of_joint(table, j, slides[j], tones[j])
    ]


def _of_joint(
    table: Table, j: int, slides: bool, tones: list[float]
) -> Iterator[tuple[str, Columns]]:
    width = table.widths[j]
    fastest = max(float(np.abs(m.v[:, j]).max()) for m in table.motions)
    reach = max(float(np.abs(m.q[:, j]).max()) for m in table.motions)
    duration = max(float(m.time[-1] - m.time[0]) for m in table.motions)

    def sign(m: Motion) -> np.ndarray:
        return np.tanh(m.v[:, j] / width)

    def stack(*parts: np.ndarray) -> np.ndarray:
        return np.stack(parts, axis=-1)

    for share in (0.03, 0.05, 0.08, 0.12):
        for power in (1.0, 2.0):

            def peak(m: Motion, share: float = share, power: float = power) -> np.ndarray:
                return stack(sign(m) * np.exp(-(np.abs(m.v[:, j] / (share * fastest)) ** power)))

            yield "stribeck", peak
    yield "asymmetric_friction", lambda m: stack(np.ones(len(m.time)))
    yield "asymmetric_friction", lambda m: stack(np.ones(len(m.time)), np.abs(m.v[:, j]))
    yield "quadratic_drag", lambda m: stack(m.v[:, j] * np.abs(m.v[:, j]))
    yield (
        "load_dependent_friction",
        lambda m: stack(np.abs(table.load(m)[:, j]) * sign(m)),
    )
    for turns in (1, 2):
        rate = turns * (0.5 * np.pi / reach if slides else 1.0)

        def around(m: Motion, rate: float = rate) -> np.ndarray:
            return stack(*(sign(m) * f(rate * m.q[:, j]) for f in (np.sin, np.cos)))

        yield "position_dependent_friction", around
    for share in (0.03, 0.06, 0.1):
        yield "hysteresis", lambda m, share=share: stack(_lagging(m, j, share * reach))
    yield "spring", lambda m: stack(m.q[:, j], np.ones(len(m.time)))
    for harmonic in () if slides else range(6, 25):

        def ripple(m: Motion, harmonic: int = harmonic) -> np.ndarray:
            return stack(*(f(harmonic * m.q[:, j]) for f in (np.sin, np.cos)))

        yield "torque_ripple", ripple
    for share in (0.2, 0.4, 0.6):

        def warming(m: Motion, share: float = share) -> np.ndarray:
            warm = 1 - np.exp(-(m.time - m.time[0]) / (share * duration))
            return stack(warm * sign(m), warm * m.v[:, j])

        yield "thermal_drift", warming
    for tone in tones:

        def shaking(m: Motion, tone: float = tone) -> np.ndarray:
            angle = 2 * np.pi * tone * m.time
            return stack(np.sin(angle), np.cos(angle))

        yield "periodic_disturbance", shaking
    for side in (-1.0, 1.0):
        for share in (0.4, 0.5, 0.6, 0.7):

            def stop(m: Motion, side: float = side, share: float = share) -> np.ndarray:
                return stack(np.maximum(0.0, side * m.q[:, j] - share * reach))

            yield "end_stop", stop


def _lagging(motion: Motion, joint: int, reach: float) -> np.ndarray:
    """Friction that follows the direction over a length: z' = v/reach − |v| z/reach, exactly."""
    v, step = motion.v[:, joint], np.diff(motion.time, append=motion.time[-1])
    state, along = 0.0, np.zeros(len(v))
    for k, (speed, h) in enumerate(zip(v.tolist(), step.tolist(), strict=True)):
        along[k] = state
        target = 1.0 if speed > 0 else -1.0
        state = target + (state - target) * np.exp(-abs(speed) * h / reach)
    return along


def _tones(table: Table) -> list[list[float]]:
    """The highest peaks of the spectrum of the rigid robot's residual, by joint, Hz."""
    rest = residual(table.base, table.right)
    times = np.concatenate([m.picked(m.time) for m in table.motions])
    which = np.repeat(np.arange(len(table.motions)), [len(m.picked(m.time)) for m in table.motions])
    found = []
    for j, kept in enumerate(table.moving):
        span = max(float(m.time[-1] - m.time[0]) for m in table.motions)
        grid = np.arange(0.3, 8.0, 0.1 / span)
        power = np.zeros(len(grid))
        own = rest[table.joint == j]
        for k in range(len(table.motions)):
            # Rows at rest are missing, so the sum is over the existing times.
            here = which[kept] == k
            waves = np.exp(-2j * np.pi * np.outer(grid, times[kept][here]))
            power += np.abs(waves @ own[here]) ** 2
        row = []
        for _ in range(TONES):
            row.append(float(grid[int(np.argmax(power))]))
            power[np.abs(grid - row[-1]) < 1.5 / span] = 0.0
        found.append(row)
    return found
