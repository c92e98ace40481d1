"""Cases of the benchmark of hidden effects: robots, effects and noise drawn from one seed."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import jaxid
from tests import independent as sim

KINDS = ("single", "double", "clean", "outside")
COLOURS = ("white", "moderate", "strong")
ROBOTS = ("scara", "two_link", "axis")
TRANSMISSIONS = {"joint_elasticity", "backlash"}


@dataclass(frozen=True)
class Wanted:
    """Specification of a case: its number, its seed, the effects' names, the noise.

    `law`: whether the user knows the controller, "known" or "unknown".
    """

    number: int
    kind: str
    seed: int
    effects: tuple[str, ...]
    noise: str
    robot: str = "scara"
    law: str = "known"

    @property
    def label(self) -> str:
        """Name in files and tables."""
        return f"{self.number:03d}_{self.kind}_{'+'.join(self.effects) or self.noise}"


def draw_wanted(
    master: int, quick: bool = False, robot: str = "scara", law: str = "known"
) -> list[Wanted]:
    """The cases of one run in random order, so a part of them represents all.

    With "any" robot, each case has a random robot on which its effects make sense.
    """
    rng = np.random.default_rng(master)
    robots = ROBOTS if robot == "any" else (robot,)
    there = {name for chosen in robots for name in sim.applicable(chosen)}
    known, strange = ([n for n in names if n in there] for names in (sim.CATALOGUE, sim.OUTSIDE))
    if quick:
        names = rng.choice(known, 5, replace=False).tolist()
        plain = [("single", (n,)) for n in names[:3]] + [("double", tuple(names[3:]))]
        plain += [("clean", ()), ("outside", (str(rng.choice(strange)),))]
    else:
        plain = [("single", (name,)) for name in known for _ in range(3)]
        plain += [("double", _pair(rng, known)) for _ in range(20)]
        plain += [("clean", ()) for _ in range(20)]
        again = rng.choice(strange, 5, replace=False).tolist()
        plain += [("outside", (name,)) for name in (*strange, *again)]
    colours = rng.choice(COLOURS, len(plain)).tolist()
    # Half of the clean cases have strongly coloured noise, in which false alarms are most likely.
    clean = [k for k, (kind, _) in enumerate(plain) if kind == "clean"]
    for turn, k in enumerate(clean):
        colours[k] = "strong" if turn % 2 == 0 else str(rng.choice(COLOURS[:2]))
    seeds = rng.integers(1, 2**31, len(plain)).tolist()
    order = rng.permutation(len(plain)).tolist()
    return [
        Wanted(
            number,
            plain[k][0],
            seeds[k],
            plain[k][1],
            colours[k],
            _robot(rng, robots, plain[k][1]),
            law,
        )
        for number, k in enumerate(order)
    ]


def _robot(rng: np.random.Generator, robots: Sequence[str], names: Sequence[str]) -> str:
    """One of the robots on which all these effects make sense."""
    fit = [robot for robot in robots if set(names) <= set(sim.applicable(robot))]
    return str(rng.choice(fit))


def _pair(rng: np.random.Generator, known: Sequence[str]) -> tuple[str, ...]:
    """Two names that can be on one robot, on any joints."""
    while True:
        names = tuple(rng.choice(known, 2, replace=False).tolist())
        if not set(names) <= TRANSMISSIONS:
            return names


def build(wanted: Wanted) -> sim.Case:
    """The case: robot, motions, effects and noise, all from its seed."""
    return sim.make_case(wanted.seed, wanted.effects, wanted.noise, wanted.robot)


def start_model(case: sim.Case, law: str = "known") -> jaxid.ClosedLoop:
    """The starting model of a user: the robot under its controller, without effects."""
    if law == "unknown":
        return dataclasses.replace(start_model(case), controller=jaxid.control.Tracking())
    if case.robot == "scara":
        return jaxid.scara()
    if case.robot == "axis":
        return jaxid.emps()
    law = case.controller
    assert isinstance(law, sim.PD)
    return jaxid.two_link(jaxid.control.PD(Kp=list(law.Kp), Kv=list(law.Kv), Kg=list(law.Kg)))


def read_case(folder: Path, case: sim.Case) -> tuple[jaxid.Recordings, jaxid.Recordings]:
    """The recordings of a case, written to CSV files and read: to fit, and held out."""
    sim.write_case(folder, case)
    fitting = jaxid.read(folder / "fit_1.csv", folder / "fit_2.csv")
    return jaxid.Recordings.of(fitting), jaxid.Recordings.of(jaxid.read(folder / "held_out.csv"))
