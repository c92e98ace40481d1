"""Cases of the worlds benchmark: robot, friction, noise, law and effect, from one seed."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal

import jaxid

from ._world_departures import (
    WORLDS,
    draw_length,
    draw_motions,
    draw_world,
    logged_ticks,
)
from ._world_physics import (
    EFFECTS,
    FRICTIONS,
    LARGER,
    OUTSIDE,
    ROBOTS,
    TURNING,
    Friction,
    Hidden,
    Robot,
    draw_reference,
    draw_robot,
    draw_shape,
)
from ._world_simulation import Law, Signals, Undrawable, inertias, simulate

KINDS = ("single", "double", "clean", "outside")
LAWS = ("unknown", "sampled", "continuous")
NOISES = ("white", "coloured", "heavy", "bursts")
NAMES = ("fit_1", "fit_2", "held_out")
# Draws of a case, until one can be simulated and its effects act.
_DRAWS = 20
# Torque of a stable run over that of the first one without the effect, at most.
_UNSTABLE = 30.0


@dataclass(frozen=True)
class Wanted:
    """Specification of a case; `law` is the user's knowledge of the controller."""

    number: int
    kind: str
    seed: int
    effects: tuple[str, ...]
    robot: str
    friction: str
    noise: str
    law: str
    # Joint of the effects, from 1; None for a random one.
    joint: int | None = None
    world: str = "plain"

    @property
    def label(self) -> str:
        """Name in files and tables."""
        return f"{self.number:03d}_{self.law}_{self.kind}_{'+'.join(self.effects) or 'nothing'}"


@dataclass(frozen=True)
class Case:
    """A simulated case; torques of the noise as in the recordings."""

    robot: Robot
    law: Law
    hidden: tuple[Hidden, ...]
    drawn: str
    recordings: dict[str, dict[str, np.ndarray]]
    # Size of the effect's torque and of the noise, root mean square on its joint.
    strength: tuple[tuple[float, float], ...]
    # Each effect's torque on its joint along each recording, `(samples,)`.
    torques: tuple[dict[str, np.ndarray], ...]
    # Whether samples are missing.
    uneven: bool = False


def draw_wanted(
    master: int,
    count: int,
    laws: Sequence[str],
    robot: str = "any",
    effect: str | None = None,
    joint: int | None = None,
    frictions: Sequence[str] = FRICTIONS,
    world: str = "plain",
) -> list[Wanted]:
    """`count` cases, each with every law: six of ten with one effect, two of ten clean; all of one
    effect if it is given.

    A quarter of the robots outside the plain world have three joints.
    """
    rng = np.random.default_rng(master)
    # Cases of the plain world do not depend on the draws of the others.
    others = np.random.default_rng([master, 1])
    wanted = []
    for number in range(count):
        kind = KINDS[int(rng.choice(4, p=(0.6, 0.1, 0.2, 0.1)))]
        if effect is not None:
            kind = "outside" if effect in OUTSIDE else "single"
        chosen = str(rng.choice(ROBOTS)) if robot == "any" else robot
        where, larger = str(others.choice(WORLDS)), others.random() < 0.25
        where = where if world == "any" else world
        turns = chosen not in ("axis", "gantry")
        known = [e for e in EFFECTS if turns or e not in TURNING]
        strange = [e for e in OUTSIDE if chosen not in ("axis", "pendulum") or e != "cross_bump"]
        size = {"single": 1, "double": 2, "clean": 0, "outside": 1}[kind]
        names = rng.choice(strange if kind == "outside" else known, size, replace=False).tolist()
        names = names if effect is None else [effect]
        seed, friction, noise = (
            int(rng.integers(1, 2**31)),
            str(rng.choice(list(frictions))),
            str(rng.choice(NOISES)),
        )
        noise = "drifting" if where == "drift" else noise
        if robot == "any" and where != "plain" and larger:
            chosen = str(others.choice(LARGER))
        wanted += [
            Wanted(number, kind, seed, tuple(names), chosen, friction, noise, law, joint, where)
            for law in laws
        ]
    return wanted


def make(wanted: Wanted) -> Case:
    """The case, simulated; the same for every law; drawn again if it is not usable."""
    for seed in range(wanted.seed, wanted.seed + _DRAWS):
        with suppress(Undrawable):
            return _made(replace(wanted, seed=seed))
    raise Undrawable(f"case {wanted.number} is not usable in {_DRAWS} draws")


def _made(wanted: Wanted) -> Case:
    rng = np.random.default_rng(wanted.seed)
    others = np.random.default_rng([wanted.seed, 1])
    robot = draw_robot(rng, wanted.robot)
    m = inertias(robot)
    rate, duration = int(rng.choice([200, 250, 500])), float(rng.uniform(10.0, 20.0))
    pace = math.exp(rng.uniform(math.log(0.6), math.log(2.0)))
    kinds = rng.permutation(["sines", "sines", "moves"]).tolist()
    if wanted.world != "plain":
        rate, duration = draw_length(others)
        kinds = draw_motions(others)
    references = [draw_reference(rng, robot, duration, kind, pace) for kind in kinds]
    speeds = [_speed(reference, duration) for reference in references]
    speed = np.max(speeds, axis=0)
    load = m * speed * 2 * math.pi * pace
    frictions = tuple(
        Friction(
            viscous=float(load[j] / speed[j] * rng.uniform(0.05, 0.2)),
            coulomb=float(load[j] * rng.uniform(0.1, 0.4)),
            family=wanted.friction,
            # From too sharp to be visible, to clearly rounded; stable at 0.1 ms.
            width=float(speed[j] * math.exp(rng.uniform(math.log(0.002), math.log(0.03)))),
        )
        for j in range(len(m))
    )
    world = draw_world(others, wanted.world, robot, frictions, m, speed, load, duration)
    bandwidth = 2 * math.pi * rng.uniform(4.0, 9.0, len(m))
    integral = float(rng.choice([0.0, 0.3]))
    law = Law(
        tuple((m * bandwidth**2).tolist()),
        tuple((integral * m * bandwidth**3).tolist()),
        tuple((1.4 * m * bandwidth).tolist()),
        tuple(
            link.travel * math.exp(rng.uniform(math.log(1e-7), math.log(3e-6)))
            for link in robot.links
        ),
        delay=world.delay,
    )
    clean = simulate(robot, world.frictions, law, references[0], duration, world.beside)
    level = rng.uniform(0.004, 0.02) * np.std(clean.tau, axis=0)
    hidden = _hidden(rng, wanted, robot, frictions, speed, duration, clean, level)
    acting = (*world.beside, *hidden)
    runs = [simulate(robot, world.frictions, law, r, duration, acting) for r in references]
    if any(np.any(np.std(r.tau, axis=0) > _UNSTABLE * np.std(clean.tau, axis=0)) for r in runs):
        raise Undrawable(f"the control of {robot.name} is unstable with {wanted.effects}")
    logged = [
        logged_ticks(others, len(run.time), 1000 // rate, uneven=world.uneven) for run in runs
    ]
    recordings = {
        name: _recorded(rng, run, ticks, rate, level, wanted.noise)
        for name, run, ticks in zip(NAMES, runs, logged, strict=True)
    }
    wrong = rng.uniform(0.8, 1.25, (len(m), 3))
    along = [[_along(e, run) for run in runs] for e in hidden]
    strength = tuple(
        (float(np.sqrt(np.mean(waves[0] ** 2))), float(level[e.joint]))
        for e, waves in zip(hidden, along, strict=True)
    )
    torques = tuple(
        {name: wave[ticks] for name, wave, ticks in zip(NAMES, waves, logged, strict=True)}
        for waves in along
    )
    return Case(robot, law, hidden, robot.urdf(wrong), recordings, strength, torques, world.uneven)


def _speed(reference, duration: float) -> np.ndarray:
    positions = np.array([reference.at(t) for t in np.arange(0.0, duration, 0.005)])
    return np.abs(np.gradient(positions, 0.005, axis=0)).max(axis=0)


def _along(effect: Hidden, run: Signals) -> np.ndarray:
    """The effect's torque along a run, `(ticks,)`."""
    effect.reset()
    rows = zip(run.time, run.q.tolist(), run.speed.tolist(), run.tau.tolist(), strict=True)
    return np.array([effect.torque(t, q, v, tau, 1e-3) for t, q, v, tau in rows])


def _hidden(rng, wanted, robot, frictions, speed, duration, clean, level) -> tuple[Hidden, ...]:
    """The effects, each 3 to 12 times the noise before parameters absorb a part.

    **Raises:** `Undrawable` if one does not act in the first recording.
    """
    found = []
    for name in wanted.effects:
        places = [j for j, link in enumerate(robot.links) if not (link.slides and name in TURNING)]
        j = int(rng.choice(places)) if wanted.joint is None else wanted.joint - 1
        shape = draw_shape(rng, name, duration)
        link = robot.links[j]
        effect = Hidden(name, j, frictions[j], link.travel, float(speed[j]), shape, link.slides)
        plain = np.sqrt(np.mean(_along(effect, clean) ** 2))
        if plain == 0.0:
            raise Undrawable(f"{name} on joint {j + 1} does not act in the first recording")
        effect.size = float(level[j] * math.exp(rng.uniform(math.log(3), math.log(12))) / plain)
        if name == "asymmetric_friction":
            effect.size *= float(rng.choice([-1.0, 1.0]))
        found.append(effect)
    return tuple(found)


def _recorded(
    rng: np.random.Generator,
    run: Signals,
    ticks: np.ndarray,
    rate: int,
    level: np.ndarray,
    noise: str,
) -> dict[str, np.ndarray]:
    """The logged run: at these ticks, with noise in the torque.

    `aliased` is the part of the logged torque, without noise, that is due to frequencies too high
    for `rate`: a law on encoder steps has a broad spectrum, of which a logger without an
    anti-aliasing filter takes samples.
    """
    tau = run.tau[ticks]
    errors = _noise(rng, tau.shape, noise) * level
    sections = signal.butter(8, 0.4 * rate, fs=1000, output="sos")
    resolved = signal.sosfiltfilt(sections, run.tau, axis=0)[ticks]
    return {
        "time": run.time[ticks],
        "q": run.q[ticks],
        "tau": tau + errors,
        "q_ref": run.q_ref[ticks],
        "noise": errors,
        "aliased": tau - resolved,
    }


def _noise(rng: np.random.Generator, shape: tuple[int, ...], kind: str) -> np.ndarray:
    """Noise with a standard deviation of one."""
    white = rng.standard_normal(shape)
    if kind == "coloured":
        pole = rng.uniform(0.5, 0.9)
        return signal.lfilter([math.sqrt(1 - pole**2)], [1.0, -pole], white, axis=0)
    if kind == "drifting":
        # Half of it changes within some hundred samples.
        pole = 1.0 - 1.0 / rng.uniform(100.0, 400.0)
        slow = signal.lfilter([math.sqrt(1 - pole**2)], [1.0, -pole], white, axis=0)
        return math.sqrt(0.5) * (slow + rng.standard_normal(shape))
    if kind == "heavy":
        return rng.standard_t(4.0, shape) / math.sqrt(2.0)
    if kind == "bursts":
        loud = np.repeat(rng.random((shape[0] // 50 + 1, 1)) < 0.1, 50, axis=0)[: shape[0]]
        return white * np.where(loud, 2.5, 0.65)
    return white


def unexplained(signals: dict[str, np.ndarray], *, along_motion: bool) -> np.ndarray:
    """The part of a recorded torque that no model explains, `(samples, joints)`, N·m or N.

    Models that give the torque along the recorded motion do not give its aliases. A simulation of
    the law gives both.
    """
    return signals["noise"] + (signals["aliased"] if along_motion else 0.0)


def start_model(case: Case, law: str) -> jaxid.ClosedLoop:
    """The model of a user: the drawn URDF, bodies to be fitted, the law if it is known."""
    known = case.law
    pid = jaxid.control.PID(Kp=list(known.Kp), Ki=list(known.Ki), Kd=list(known.Kd))
    controller = {
        "unknown": None,
        "continuous": pid,
        "sampled": jaxid.control.Sampled(
            pid,
            every=0.001,
            resolution=np.array(known.resolution),
            velocity="difference",
            cutoff=known.cutoff,
            delay=known.delay,
        ),
    }[law]
    return jaxid.serial(case.drawn, controller, bodies="free")


def read_case(folder: Path, case: Case) -> tuple[jaxid.Recordings, jaxid.Recordings]:
    """The recordings of a case, written to CSV files and read: to fit, and held out."""
    folder.mkdir(parents=True, exist_ok=True)
    n = len(case.robot.links)
    for name, signals in case.recordings.items():
        columns = ["time"] + [f"{s}_{j}" for s in ("q", "tau", "q_ref") for j in range(1, n + 1)]
        table = np.column_stack([signals[s] for s in ("time", "q", "tau", "q_ref")])
        np.savetxt(
            folder / f"{name}.csv", table, "%.8g", ",", header=",".join(columns), comments=""
        )
    files = [folder / f"{name}.csv" for name in NAMES]
    # What a user passes who has read that samples are missing.
    gaps = "allow" if case.uneven else "refuse"
    fitting, held_out = jaxid.read(*files[:2], gaps=gaps), jaxid.read(files[2], gaps=gaps)
    return jaxid.Recordings.of(fitting), jaxid.Recordings.of(held_out)
