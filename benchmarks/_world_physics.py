"""Random robots, friction and effects of the worlds benchmark, without jaxid's formulas."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

ROBOTS = ("planar", "scara", "polar", "gantry", "axis", "pendulum")
# Arms of three joints; not among those of the plain world.
LARGER = ("elbow",)
FRICTIONS = ("tanh", "root", "arctan", "dry")
EFFECTS = (
    "stribeck",
    "asymmetric_friction",
    "quadratic_drag",
    "load_dependent_friction",
    "position_dependent_friction",
    "hysteresis",
    "spring",
    "torque_ripple",
    "thermal_drift",
    "periodic_disturbance",
    "end_stop",
)
OUTSIDE = ("torque_bump", "cross_bump", "velocity_bump", "friction_step")
# Torque by the angle of a turning joint.
TURNING = ("torque_ripple",)


@dataclass(frozen=True)
class Link:
    """A link and the joint before it: lengths in m, mass in kg, inertia about its centre."""

    slides: bool
    axis: tuple[float, float, float]
    at: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    inertia: float
    rotor: float
    travel: float

    def drawn(self, wrong: Sequence[float]) -> "Link":
        """The link in a wrong drawing: mass, centre and inertia multiplied by these factors."""
        centre = tuple(x * wrong[1] for x in self.centre)
        inertia = self.inertia * wrong[2]
        return Link(
            self.slides,
            self.axis,
            self.at,
            self.mass * wrong[0],
            (centre[0], centre[1], centre[2]),
            inertia,
            0.0,
            self.travel,
        )


@dataclass(frozen=True)
class Robot:
    """A chain of links on a fixed frame."""

    name: str
    links: tuple[Link, ...]

    def urdf(self, wrong: np.ndarray | None = None) -> str:
        """Its URDF; with factors `(links, 3)`, a URDF that is wrong by these factors."""
        links = self.links
        if wrong is not None:
            links = tuple(link.drawn(w) for link, w in zip(links, wrong, strict=True))
        parts = [f'<robot name="{self.name}">', '<link name="frame"/>']
        before = "frame"
        for k, link in enumerate(links, start=1):
            kind = "prismatic" if link.slides else "revolute"
            c, (x, y, z) = link.centre, link.at
            parts.append(
                f'<link name="link{k}"><inertial><origin xyz="{c[0]} {c[1]} {c[2]}"/>'
                f'<mass value="{link.mass}"/><inertia ixx="{link.inertia}" iyy="{link.inertia}" '
                f'izz="{link.inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
                f'<joint name="joint{k}" type="{kind}"><parent link="{before}"/>'
                f'<child link="link{k}"/><origin xyz="{x} {y} {z}"/>'
                f'<axis xyz="{link.axis[0]} {link.axis[1]} {link.axis[2]}"/>'
                f'<limit lower="{-2 * link.travel}" upper="{2 * link.travel}" effort="1e4" '
                'velocity="1e3"/></joint>'
            )
            before = f"link{k}"
        return "\n".join([*parts, "</robot>"])


def draw_robot(rng: np.random.Generator, name: str) -> Robot:
    """A robot of a kind with random masses, lengths and rotors."""
    turn = {"planar": (0.0, 1.0, 0.0), "pendulum": (0.0, 1.0, 0.0)}.get(name, (0.0, 0.0, 1.0))

    def turning(at: float, turn: tuple[float, float, float] = turn) -> Link:
        mass, length = rng.uniform(1.0, 5.0), rng.uniform(0.25, 0.5)
        sideways = rng.uniform(-0.02, 0.02)
        # Down for arms under gravity, along x for the others.
        centre = (0.0, 0.0, -length / 2) if turn[1] else (length / 2, 0.0, 0.0)
        place = (0.0, 0.0, -at) if turn[1] else (at, 0.0, 0.0)
        centre = (centre[0] + sideways, centre[1], centre[2])
        inertia = mass * length**2 / 12 * rng.uniform(0.8, 1.5)
        rotor = mass * length**2 * rng.uniform(0.1, 0.6)
        return Link(False, turn, place, mass, centre, inertia, rotor, rng.uniform(0.8, 1.5))

    def sliding(axis: tuple[float, float, float]) -> Link:
        mass = rng.uniform(3.0, 15.0)
        centre = (rng.uniform(0.1, 0.3), 0.0, 0.0)
        rotor, travel = mass * rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.3)
        return Link(True, axis, (0.0, 0.0, 0.0), mass, centre, 0.02, rotor, travel)

    along_x, along_y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    upright, sideways = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
    links = {
        # A turning base that carries an arm under gravity.
        "elbow": lambda: (
            turning(0.0, upright),
            turning(0.0, sideways),
            turning(rng.uniform(0.25, 0.5), sideways),
        ),
        "planar": lambda: (turning(0.0), turning(rng.uniform(0.25, 0.5))),
        "scara": lambda: (turning(0.0), turning(rng.uniform(0.25, 0.5))),
        "polar": lambda: (turning(0.0), sliding(along_x)),
        "gantry": lambda: (sliding(along_x), sliding(along_y)),
        "axis": lambda: (sliding(along_x),),
        "pendulum": lambda: (turning(0.0),),
    }[name]()
    return Robot(name, links)


# What a torque may depend on: time, positions, velocities, and the drive's own torque.
Torque = Callable[[float, Sequence[float], Sequence[float], Sequence[float], float], float]


@dataclass(frozen=True)
class Friction:
    """Viscous and Coulomb friction; the sign of velocity by one of several functions."""

    viscous: float
    coulomb: float
    family: str
    width: float

    def sign(self, v: float) -> float:
        """The sign of velocity in this world; zero if the simulator's own friction is used."""
        x = v / self.width
        if self.family == "tanh":
            return math.tanh(x)
        if self.family == "root":
            return x / math.sqrt(1.0 + x * x)
        if self.family == "arctan":
            return 2.0 / math.pi * math.atan(x)
        return 0.0

    def edge(self, v: float) -> float:
        """The sign for effects, also if the base friction is the simulator's own."""
        return math.tanh(v / self.width) if self.family == "dry" else self.sign(v)


@dataclass
class Hidden:
    """One effect that the user's model lacks: torque on `joint` (from 0) is `size · shape`."""

    name: str
    joint: int
    friction: Friction
    travel: float
    speed: float
    drawn: dict[str, float]
    slides: bool = False
    size: float = 0.0
    # State of effects with memory.
    state: float = 0.0

    def reset(self) -> None:
        """The state at rest."""
        self.state = 0.0

    def torque(
        self, t: float, q: Sequence[float], v: Sequence[float], tau: Sequence[float], dt: float
    ) -> float:
        """The torque; with a size of one before the size is known."""
        return (self.size or 1.0) * self.shape(t, q, v, tau, dt)

    def shape(
        self, t: float, q: Sequence[float], v: Sequence[float], tau: Sequence[float], dt: float
    ) -> float:
        """The torque for a size of one."""
        j, d = self.joint, self.drawn
        x, w = q[j] / self.travel, v[j]
        sign = self.friction.edge(w)
        match self.name:
            case "stribeck":
                return sign * math.exp(-(abs(w / (d["velocity"] * self.speed)) ** d["exponent"]))
            case "asymmetric_friction":
                return abs(sign)
            case "quadratic_drag":
                return w * abs(w)
            case "load_dependent_friction":
                # Depends on the torque that reaches the link.
                f = self.friction
                return abs(tau[j] - f.coulomb * sign - f.viscous * w) * sign
            case "position_dependent_friction":
                # Once or twice per turn, or along the travel of a sliding joint.
                angle = 0.5 * math.pi * x if self.slides else q[j]
                return sign * math.cos(d["turns"] * angle + d["phase"])
            case "hysteresis":
                reach = d["reach"] * self.travel
                self.state += dt * w * (1.0 - self.state * (1 if w > 0 else -1)) / reach
                return self.state
            case "spring":
                return q[j] - d["rest"] * self.travel
            case "torque_ripple":
                return math.sin(d["harmonic"] * q[j] + d["phase"])
            case "thermal_drift":
                f = self.friction
                warm = f.coulomb * sign + f.viscous * w
                return (1.0 - math.exp(-t / d["time"])) * warm
            case "periodic_disturbance":
                return math.sin(2 * math.pi * d["frequency"] * t + d["phase"])
            case "end_stop":
                return max(0.0, x * d["side"] - d["begin"]) * d["side"]
            case "torque_bump":
                return math.exp(-(((x - d["place"]) / d["width"]) ** 2))
            case "cross_bump":
                other = (j + 1) % len(q)
                return math.exp(-(((q[other] / self.travel - d["place"]) / d["width"]) ** 2))
            case "velocity_bump":
                return sign * math.exp(-(((abs(w) / self.speed - 0.4) / 0.15) ** 2))
            case "friction_step":
                return sign if t > d["time"] else 0.0
        raise ValueError(self.name)


def draw_shape(rng: np.random.Generator, name: str, duration: float) -> dict[str, float]:
    """Shape parameters of an effect; speeds and positions are shares of the motion's range."""
    uniform = rng.uniform
    draws: dict[str, dict[str, float]] = {
        "stribeck": {"velocity": uniform(0.03, 0.12), "exponent": float(rng.choice([1.0, 2.0]))},
        "position_dependent_friction": {
            "turns": float(rng.integers(1, 3)),
            "phase": uniform(0, 2 * math.pi),
        },
        "hysteresis": {"reach": uniform(0.03, 0.1)},
        "spring": {"rest": uniform(-0.3, 0.3)},
        "torque_ripple": {
            "harmonic": float(rng.integers(6, 25)),
            "phase": uniform(0, 2 * math.pi),
        },
        "thermal_drift": {"time": duration * uniform(0.2, 0.6)},
        "periodic_disturbance": {"frequency": uniform(0.5, 6.0), "phase": uniform(0, 6.28)},
        "end_stop": {"side": float(rng.choice([-1.0, 1.0])), "begin": uniform(0.4, 0.7)},
        "torque_bump": {"place": uniform(-0.4, 0.4), "width": uniform(0.08, 0.2)},
        "cross_bump": {"place": uniform(-0.4, 0.4), "width": uniform(0.08, 0.2)},
        "friction_step": {"time": duration * uniform(0.35, 0.65)},
    }
    return draws.get(name, {})


@dataclass(frozen=True)
class Reference:
    """Reference positions: sums of sines; moves from point to point with rests between; pulses
    from one place and back; or a slow motion that pauses, as if guided by hand."""

    kind: str
    parts: tuple[tuple[tuple[float, float, float], ...], ...] = field(default=())
    hold: float = 1.5

    def at(self, t: float) -> list[float]:
        """Positions of all joints, rad or m."""
        if self.kind in ("sines", "guided"):
            rise = min(1.0, t / 1.5)
            rise = rise**3 * (10 - 15 * rise + 6 * rise**2)
            # Guided motion pauses at the end of each hold.
            pace = 2 * math.pi / self.hold
            s = t if self.kind == "sines" else t - math.sin(pace * t) / pace
            return [
                rise * sum(a * math.sin(w * s + p) for a, w, p in joint) for joint in self.parts
            ]
        k, s = int(t / self.hold), t % self.hold
        positions = []
        for joint in self.parts:
            here, moving, _ = joint[min(k, len(joint) - 1)]
            if self.kind == "pulses":
                positions.append(here * math.sin(math.pi * min(1.0, s / moving)) ** 2)
                continue
            before = joint[k - 1][0] if 0 < k <= len(joint) else 0.0
            x = min(1.0, s / moving)
            positions.append(before + (here - before) * x**3 * (10 - 15 * x + 6 * x**2))
        return positions


def draw_reference(
    rng: np.random.Generator, robot: Robot, duration: float, kind: str, pace: float
) -> Reference:
    """A motion within the robot's travel; `pace` is the highest frequency of the sines, Hz."""
    parts = []
    pace = pace / 4 if kind == "guided" else pace
    hold = 4.0 if kind == "guided" else 1.5
    for link in robot.links:
        if kind in ("sines", "guided"):
            rates = 2 * math.pi * np.exp(rng.uniform(np.log(min(0.1, pace / 3)), np.log(pace), 6))
            sizes = rng.uniform(0.4, 1.0, 6) / (1.0 + (rates / (math.pi * pace)) ** 2)
            sizes *= link.travel / np.sum(sizes) * 1.3
            phases = rng.uniform(0, 2 * math.pi, 6)
            parts.append(tuple(zip(sizes.tolist(), rates.tolist(), phases.tolist(), strict=True)))
        else:
            levels = rng.uniform(-link.travel, link.travel, int(duration / hold) + 2)
            # A pulse goes and returns in this time.
            moving = rng.uniform(0.6, 1.0) * hold
            parts.append(tuple((float(x), moving, 0.0) for x in levels))
    return Reference(kind, tuple(parts), hold)
