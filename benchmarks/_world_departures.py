"""Worlds: what a laboratory has beside the hidden effect.

All but the plain one leave what jaxid's models contain. A world has friction of another kind on
every joint (LuGre, a peak at low speed with a random exponent, friction that changes with load and
temperature at once), noise that drifts, times that jitter with samples missing, a law that acts
late, or one small resonance. Each but the plain one also has motions that are pulses, or slow as if
guided by hand, and recordings of 5 to 60 s at 50 to 1000 Hz.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ._world_physics import Friction, Hidden, Robot

WORLDS = ("plain", "lugre", "peak", "load_and_heat", "drift", "jitter", "delay", "resonance")
# Effects of the catalogue that describe a world: there they are true, and no further effect.
DESCRIBING: dict[str, tuple[str, ...]] = {
    "lugre": ("hysteresis", "stribeck"),
    "peak": ("stribeck",),
    "load_and_heat": ("load_dependent_friction", "thermal_drift"),
    "delay": ("time_delay", "actuator_lag"),
    "resonance": ("joint_elasticity",),
}
# Effects of a drive that a sampled law has if it is taken for continuous.
DELAYS = "actuator_lag", "time_delay"
RATES = (50, 100, 200, 250, 500, 1000)


@dataclass
class Bristles:
    """LuGre friction of a joint: bristles that bend over `reach`, with a peak at low speed."""

    joint: int
    coulomb: float
    reach: float
    damping: float
    peak: float
    velocity: float
    bend: float = field(default=0.0, init=False)

    def reset(self) -> None:
        """Unbent bristles."""
        self.bend = 0.0

    def torque(
        self, t: float, q: Sequence[float], v: Sequence[float], tau: Sequence[float], dt: float
    ) -> float:
        """The friction; a bend of one is that of slow sliding without a peak."""
        w = v[self.joint]
        most = 1.0 + self.peak * math.exp(-((w / self.velocity) ** 2))
        rate = (w - abs(w) * self.bend / most) / self.reach
        self.bend += dt * rate
        return self.coulomb * self.bend + self.damping * self.reach * rate


@dataclass(frozen=True)
class LoadAndHeat:
    """Coulomb friction that grows with the torque of the drive and changes while it warms up."""

    joint: int
    friction: Friction
    load: float
    by_load: float
    by_heat: float
    warm_up: float

    def reset(self) -> None:
        """Nothing to reset: it has no state."""

    def torque(
        self, t: float, q: Sequence[float], v: Sequence[float], tau: Sequence[float], dt: float
    ) -> float:
        """The torque in addition to the Coulomb friction."""
        loaded = 1.0 + self.by_load * abs(tau[self.joint]) / self.load
        warmed = 1.0 + self.by_heat * (1.0 - math.exp(-t / self.warm_up))
        return self.friction.coulomb * self.friction.edge(v[self.joint]) * (loaded * warmed - 1.0)


@dataclass
class Resonance:
    """A small mass on a spring, attached to a joint."""

    joint: int
    inertia: float
    frequency: float
    damping: float
    q: float = field(default=0.0, init=False)
    v: float = field(default=0.0, init=False)

    def reset(self) -> None:
        """The mass at rest."""
        self.q = self.v = 0.0

    def torque(
        self, t: float, q: Sequence[float], v: Sequence[float], tau: Sequence[float], dt: float
    ) -> float:
        """The torque that accelerates the mass."""
        w = 2 * math.pi * self.frequency
        pull = w * w * (q[self.joint] - self.q) + 2 * self.damping * w * (v[self.joint] - self.v)
        self.v += dt * pull
        self.q += dt * self.v
        return self.inertia * pull


Beside = Bristles | Hidden | LoadAndHeat | Resonance


@dataclass(frozen=True)
class World:
    """What a case has beside robot, law and hidden effect.

    `frictions` are those that the simulator itself applies; `delay` is that of the law, in ticks.
    """

    frictions: tuple[Friction, ...]
    beside: tuple[Beside, ...] = ()
    delay: int = 0
    uneven: bool = False


def describing(world: str, law: str) -> set[str]:
    """Effects that are neither right nor wrong in a world if the law is known in this way."""
    return {*DESCRIBING.get(world, ()), *(DELAYS if law == "continuous" else ())}


def draw_world(
    rng: np.random.Generator,
    name: str,
    robot: Robot,
    frictions: tuple[Friction, ...],
    inertia: np.ndarray,
    speed: np.ndarray,
    load: np.ndarray,
    duration: float,
) -> World:
    """A world of a kind with random numbers.

    **Arguments:**

    - `inertia`: of each joint at rest, `(joints,)`, kg·m² or kg.
    - `speed`: the largest of each joint, `(joints,)`, rad/s or m/s.
    - `load`: the usual torque of each joint, `(joints,)`, N·m or N.
    """
    joints, uniform = range(len(frictions)), rng.uniform
    speeds, loads = speed.tolist(), load.tolist()
    if name == "lugre":
        found = []
        for j, friction in zip(joints, frictions, strict=True):
            reach = robot.links[j].travel * math.exp(uniform(math.log(3e-4), math.log(3e-3)))
            damping = uniform(0.2, 1.0) * math.sqrt(friction.coulomb / reach * float(inertia[j]))
            peak = float(rng.choice([0.0, uniform(0.1, 0.5)]))
            found.append(
                Bristles(j, friction.coulomb, reach, damping, peak, uniform(0.03, 0.1) * speeds[j])
            )
        return World(tuple(replace(f, coulomb=0.0) for f in frictions), tuple(found))
    if name == "peak":
        peaks = []
        for j, friction in zip(joints, frictions, strict=True):
            size = friction.coulomb * uniform(0.2, 0.8)
            drawn = {"velocity": uniform(0.02, 0.1), "exponent": uniform(0.6, 3.0)}
            link = robot.links[j]
            peaks.append(
                Hidden("stribeck", j, friction, link.travel, speeds[j], drawn, link.slides, size)
            )
        return World(frictions, tuple(peaks))
    if name == "load_and_heat":
        both = (
            LoadAndHeat(
                j,
                frictions[j],
                loads[j],
                uniform(0.05, 0.3),
                uniform(-0.3, -0.1),
                duration * uniform(0.3, 1.0),
            )
            for j in joints
        )
        return World(frictions, tuple(both))
    if name == "resonance":
        j = int(rng.integers(len(frictions)))
        small = Resonance(
            j, float(inertia[j]) * uniform(0.01, 0.04), uniform(8.0, 25.0), uniform(0.01, 0.05)
        )
        return World(frictions, (small,))
    if name == "delay":
        return World(frictions, delay=int(rng.integers(1, 5)))
    return World(frictions, uneven=name == "jitter")


def draw_length(rng: np.random.Generator) -> tuple[int, float]:
    """Sample rate, Hz, and duration, s, of recordings outside the plain world."""
    return int(rng.choice(RATES)), math.exp(rng.uniform(math.log(5.0), math.log(60.0)))


def draw_motions(rng: np.random.Generator) -> list[str]:
    """Kinds of the references outside the plain world; the first moves all bodies fast."""
    kinds = ("sines", "moves", "pulses", "guided")
    return [str(rng.choice(kinds[:2])), str(rng.choice(kinds)), str(rng.choice(kinds))]


def logged_ticks(rng: np.random.Generator, ticks: int, every: int, *, uneven: bool) -> np.ndarray:
    """Numbers of the ticks that are logged, `(samples,)`.

    If uneven, each is up to a fifth of the period late, at least one tick if the period has
    several, one of a hundred is missing, and so is one stretch of 0.1 s.
    """
    even = np.arange(0, ticks, every)
    if not uneven:
        return even
    latest = max(1, every // 5) if every > 1 else 0
    late = np.minimum(even + rng.integers(0, latest + 1, len(even)), ticks - 1)
    kept = rng.random(len(even)) > 0.01
    begin = int(rng.integers(len(even) // 4, 3 * len(even) // 4))
    kept[begin : begin + max(1, round(100 / every))] = False
    kept[:3] = kept[-3:] = True
    return late[kept]
