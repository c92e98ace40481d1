"""Hidden effects on arms of six and seven joints.

Published URDFs (Universal Robots, Unitree Z1, Kinova, Panda without its fingers) are simulated by
MuJoCo under a law that is computed at 1 kHz from quantised encoders. One effect is hidden, or none.
The user has the URDF, the rotors' data sheet, two recordings of 10 s to fit and one to test, and
does not know the law; or declares it as it is (`--law known`), with the torque that holds the arm
at its start as a feed-forward.

A body at the tip is a part of the last link. It can be identified on all recordings only if the
links are held as drawn; if they are estimated, it is hidden in one recording only. Rotors and
counterbalances would also be absorbed by estimated links, so they are hidden only with held links.
Links that are estimated are drawn wrong by up to a fifth.

python -m benchmarks.six_joints [--seed N] [--count 40] [--law unknown] [--quick] [--jobs 1]
                                [--out DIR] [--case N] [--json FILE]
"""

import argparse
import json
import math
import secrets
import tempfile
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from jaxid.storage.campaign import Campaign, Failed

from ._six_joints_world import (
    ROBOTS,
    TICK,
    Law,
    Plant,
    Run,
    Unstable,
    arm_alone,
    bare,
    inertias,
    limits,
    simulate,
    text,
    torques,
    with_payload,
    with_wrong_bodies,
)
from ._world_physics import Friction, Reference
from .hidden_effects import configure_jax

EFFECTS = (
    "payload",
    "base_tilt",
    "stribeck",
    "load_dependent_friction",
    "rotor_inertia",
    "torque_offset",
    "torque_ripple",
    "shared_shaft",
    "counterbalance",
)
# Effects that estimated links would absorb.
OF_DRAWN = ("rotor_inertia", "counterbalance")
RATE, DURATION, WRONG = 250, 10.0, 0.2
NAMES = ("fit_1", "fit_2", "held_out")
# Number of draws of a case until its law is stable and its joints do not lock.
_DRAWS = 5


# Effects of a quick run; the whole catalogue has a thousand signatures.
_FEW = jaxid.effects.CarriedBody, jaxid.effects.BaseTilt, jaxid.effects.Stribeck


@dataclass(frozen=True)
class Wanted:
    """Specification of a case; no effect if it is clean.

    `law` is the user's knowledge of it. `few`: whether few effects are asked.
    """

    number: int
    seed: int
    robot: str
    effect: str
    bodies: str
    law: str = "unknown"
    few: bool = False

    @property
    def label(self) -> str:
        """Name in files and tables."""
        what = f"{self.robot}_{self.bodies}_{self.effect or 'clean'}"
        return f"{self.number:03d}_{self.law}_{what}"


@dataclass(frozen=True)
class Case:
    """A simulated case: the user's data, and the truth.

    - `joint`: joint of the effect, from 1; None for effects of the whole arm.
    - `size`: its torque over the noise, root mean square, on the joint of the largest ratio.
    """

    loop: jaxid.ClosedLoop
    recordings: tuple[jaxid.Recording, ...]
    joint: int | None
    numbers: dict[str, float]
    size: float


def draw_wanted(master: int, count: int, law: str) -> list[Wanted]:
    """`count` cases, the same for every law: one in five clean, the others with one effect."""
    rng = np.random.default_rng(master)
    found = []
    for number in range(count):
        clean = rng.random() < 0.2
        effect = "" if clean else str(rng.choice(EFFECTS))
        bodies = "drawn" if effect in OF_DRAWN else str(rng.choice(["drawn", "free"]))
        robot = str(rng.choice(list(ROBOTS)))
        found.append(Wanted(number, int(rng.integers(1, 2**31)), robot, effect, bodies, law))
    return found


class SelfLocking(ValueError):
    """A drawn friction above the load on which it depends, so that no link could move its drive."""


def make(wanted: Wanted) -> Case:
    """The case, simulated; drawn again if its law is unstable or its joint locks itself."""
    for seed in range(wanted.seed, wanted.seed + _DRAWS):
        with suppress(Unstable, SelfLocking):
            return _made(replace(wanted, seed=seed))
    raise ValueError(
        f"case {wanted.number} has no stable law, or only joints that lock, in {_DRAWS} draws"
    )


def _made(wanted: Wanted) -> Case:
    rng = np.random.default_rng(wanted.seed)
    root, tip = arm_alone(wanted.robot)
    plant = bare(text(root))
    n = len(plant.rotors)
    home, references = _motions(rng, plant)
    plant, scale = _drive(rng, plant, references[0], home)
    level = rng.uniform(0.003, 0.01, n) * scale
    plants, joint, numbers = _hide(rng, wanted, plant, references[0], home, level)
    if wanted.effect == "payload":
        loaded = text(with_payload(root, tip, numbers["mass"], [numbers[x] for x in "xyz"]))
        which = [not numbers["once"] or name == "fit_2" for name in NAMES]
        plants = [replace(plant, urdf=loaded) if w else plant for w in which]
    bandwidth = 2 * math.pi * rng.uniform(5.0, 9.0, n)
    step = 2 * math.pi / 2 ** int(rng.integers(17, 20))
    runs = [
        simulate(own, reference, home, bandwidth, step, DURATION)
        for own, reference in zip(plants, references, strict=True)
    ]
    drawn = root if wanted.bodies == "drawn" else with_wrong_bodies(root, rng, WRONG)
    sheet = list(plant.rotors)
    if wanted.effect == "rotor_inertia" and joint is not None:
        sheet[joint - 1] *= numbers["told"]
    law = None if wanted.law == "unknown" else _declared(runs[0].law)
    loop = _model(text(drawn), tip, law, sheet, wanted.bodies)
    recordings = tuple(
        _recorded(rng, run, level, name, wanted.law) for run, name in zip(runs, NAMES, strict=True)
    )
    size = float(np.max([np.sqrt(np.mean(run.taken**2, axis=0)) / level for run in runs]))
    return Case(loop, recordings, joint, numbers, size)


def _declared(law: Law) -> jaxid.control.Sampled:
    """The law as a user declares it."""
    return jaxid.control.Sampled(
        jaxid.control.PID(Kp=law.Kp, Ki=law.Ki, Kd=law.Kd),
        every=TICK,
        resolution=np.full(len(law.Kp), law.resolution),
        velocity="difference",
        cutoff=law.cutoff,
    )


def _model(
    urdf: str,
    tip: str,
    law: jaxid.control.Sampled | None,
    rotors: Sequence[float],
    bodies: str,
) -> jaxid.ClosedLoop:
    """The model of a user who assumes drives without offsets and the rotors of the data sheet."""
    loop = jaxid.serial(urdf, law, rotors=rotors, bodies=bodies, tip=tip)
    for j in range(1, loop.joints + 1):
        loop = loop.without("torque_offset", j).hold(f"Ia{j}")
    return loop


def _motions(rng: np.random.Generator, plant: Plant) -> tuple[np.ndarray, list[Reference]]:
    """A pose inside the limits, and sums of sines about it; less than 1.2 rad either way."""
    low, high = limits(plant.model())
    home = (low + high) / 2 + rng.uniform(-0.12, 0.12, len(low)) * (high - low)
    travel = np.minimum(1.2, 0.35 * (high - low))
    pace = math.exp(rng.uniform(math.log(0.4), math.log(1.0)))
    made = []
    for _ in NAMES:
        parts = []
        for span in travel:
            rates = 2 * math.pi * np.exp(rng.uniform(np.log(0.08), np.log(pace), 5))
            sizes = rng.uniform(0.4, 1.0, 5) / (1.0 + (rates / (math.pi * pace)) ** 2)
            sizes *= span / np.sum(sizes)
            phases = rng.uniform(0, 2 * math.pi, 5)
            parts.append(tuple(zip(sizes.tolist(), rates.tolist(), phases.tolist(), strict=True)))
        made.append(Reference("sines", tuple(parts)))
    return home, made


def _drive(
    rng: np.random.Generator, plant: Plant, reference: Reference, home: np.ndarray
) -> tuple[Plant, np.ndarray]:
    """The plant with rotors and friction, and the size of its joints' torques, N·m."""
    import mujoco

    model = plant.model()
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    m = inertias(model, data)
    rotors = np.maximum(rng.uniform(0.2, 0.8, len(m)) * m, 0.01 * m.max())
    plant = replace(plant, rotors=tuple(rotors.tolist()))
    asked = np.sqrt(np.mean(torques(plant, reference, home, DURATION) ** 2, axis=0))
    scale = np.maximum(asked, 0.02 * asked.max())
    speed = np.abs(_speeds(reference)).max(axis=0)
    family = str(rng.choice(["tanh", "root", "arctan", "dry"]))
    frictions = tuple(
        Friction(
            viscous=float(scale[j] / speed[j] * rng.uniform(0.05, 0.2)),
            coulomb=float(scale[j] * rng.uniform(0.1, 0.3)),
            family=family,
            width=float(speed[j] * math.exp(rng.uniform(math.log(0.003), math.log(0.03)))),
        )
        for j in range(len(m))
    )
    return replace(plant, frictions=frictions), scale


def _speeds(reference: Reference) -> np.ndarray:
    positions = np.array([reference.at(t) for t in np.arange(0.0, DURATION, 0.01)])
    return np.gradient(positions, 0.01, axis=0)


def _hide(
    rng: np.random.Generator,
    wanted: Wanted,
    plant: Plant,
    reference: Reference,
    home: np.ndarray,
    level: np.ndarray,
) -> tuple[list[Plant], int | None, dict[str, float]]:
    """The plants of the recordings with the effect, its joint from 1, and its numbers."""
    n = len(home)
    j = int(rng.integers(0, n - (wanted.effect == "shared_shaft")))
    numbers = _numbers(rng, wanted, reference, j)
    if wanted.effect == "base_tilt":
        tilt = numbers["roll"], numbers["pitch"]
        return [replace(plant, tilt=tilt)] * len(NAMES), None, numbers
    if wanted.effect in ("", "payload"):
        return [plant] * len(NAMES), None, numbers
    if wanted.effect == "rotor_inertia":
        return [plant] * len(NAMES), j + 1, numbers
    q = home + np.array([reference.at(t) for t in np.arange(0.0, DURATION, 0.01)])
    through = torques(replace(plant, rotors=(0.0,) * n), reference, home, DURATION)
    one = replace(plant, extra=((wanted.effect, j, {**numbers, "size": 1.0}),))
    rows = zip(q.tolist(), _speeds(reference).tolist(), through.tolist(), strict=True)
    plain = np.sqrt(np.mean(np.array([one.unseen(*row) for row in rows]) ** 2, axis=0))
    # Five to twenty times the noise before parameters absorb a part.
    times = math.exp(rng.uniform(math.log(5), math.log(20)))
    numbers["size"] = float(times * level[j] / plain[j])
    if wanted.effect == "load_dependent_friction" and numbers["size"] >= 1.0:
        raise SelfLocking(f"friction of {numbers['size']:.2g} times the load on joint {j + 1}")
    made = replace(plant, extra=((wanted.effect, j, numbers),))
    return [made] * len(NAMES), j + 1, numbers


def _numbers(
    rng: np.random.Generator, wanted: Wanted, reference: Reference, j: int
) -> dict[str, float]:
    """The shape parameters of an effect."""
    uniform, speed = rng.uniform, float(np.abs(_speeds(reference)).max(axis=0)[j])
    match wanted.effect:
        case "payload":
            once = wanted.bodies == "free" or rng.random() < 0.3
            whole = float(bare(text(arm_alone(wanted.robot)[0])).model().body_mass.sum())
            places = dict(zip("xyz", uniform(-0.1, 0.1, 3).tolist(), strict=True))
            return {"mass": whole * uniform(0.03, 0.12), "once": float(once), **places}
        case "base_tilt":
            angle, way = math.radians(uniform(1.0, 4.0)), uniform(0, 2 * math.pi)
            return {"roll": angle * math.cos(way), "pitch": angle * math.sin(way)}
        case "stribeck":
            velocity = speed * uniform(0.03, 0.12)
            return {"velocity": velocity, "exponent": float(rng.choice([1.0, 2.0]))}
        case "torque_ripple":
            return {"harmonic": float(rng.integers(6, 25)), "phase": uniform(0, 2 * math.pi)}
        case "shared_shaft":
            return {"share": float(rng.choice([-1.0, 1.0])), "viscous": uniform(0.0, 1.0) / speed}
        case "counterbalance":
            return {"angle": uniform(-1, 1), "ratio": uniform(0.1, 0.4), "gas": uniform(0, 0.3)}
        case "rotor_inertia":
            return {"told": uniform(0.0, 0.5)}
    return {}


def _recorded(
    rng: np.random.Generator, run: Run, level: np.ndarray, name: str, law: str
) -> jaxid.Recording:
    """The logged run, with noise in its torque; with the inputs of the law if it is known."""
    every = round(1000 / RATE)
    tau = run.tau[::every]
    noise = level * rng.standard_normal(tau.shape)
    inputs = {}
    if law == "known":
        inputs = {"q_ref": run.q_ref[::every], "tau_ff": np.broadcast_to(run.law.hold, tau.shape)}
    return jaxid.Recording.from_arrays(
        run.time[::every], run.q[::every], tau + noise, name=name, **inputs
    )


def run_case(wanted: Wanted) -> dict[str, Any]:
    """Makes, solves and marks one case."""
    started = time.perf_counter()
    try:
        record = _solve(wanted)
    except Exception:
        record = {"error": traceback.format_exc()}
    return {**asdict(wanted), **record, "seconds": time.perf_counter() - started}


def _solve(wanted: Wanted) -> dict[str, Any]:
    case = make(wanted)
    started, cpu = time.perf_counter(), time.process_time()
    fitting, held_out = case.recordings[:2], case.recordings[2]
    asked = _FEW if wanted.few else jaxid.catalogue
    found = jaxid.discover(
        case.loop,
        jaxid.Recordings.of(fitting),
        validate=held_out,
        catalogue=asked,
        progress=False,
    )
    took = {"took": time.perf_counter() - started, "cpu": time.process_time() - cpu}
    story = found.to_dict()
    return {
        "joint": case.joint,
        "numbers": case.numbers,
        "size": case.size,
        "story": {**story, **took},
        "marks": judge(wanted, case.joint, story),
    }


def judge(wanted: Wanted, joint: int | None, story: dict[str, Any]) -> dict[str, Any]:
    """The marks of a story: the first effect with its joint, or none for a clean case.

    A first place is shared if another effect shares its weight.
    """
    added = [(a["effect"], a["joint"]) for a in story["added"]]
    marks: dict[str, Any] = {"verdict": story["verdict"], "added": added}
    if not wanted.effect:
        return {**marks, "right": not added and story["verdict"] == "adequate"}
    true = wanted.effect, joint
    marks["right"] = added[:1] == [true]
    rivals = story["added"][0]["indistinguishable"] if added else []
    marks["shared"] = true in [(i["effect"], i["joint"]) for i in rivals]
    marks["extra"] = sum(a != true for a in added)
    return marks


def row(record: dict[str, Any]) -> str:
    """One line of the table."""
    head = f"{record['number']:3d} {record['robot']:7s}{record['bodies']:6s}"
    truth = record["effect"] or "-"
    if "error" in record:
        return f"{head}{truth:28s}ERROR {record['error'].strip().splitlines()[-1][:150]}"
    if record["joint"] is not None:
        truth += f"({record['joint']})"
    marks = record["marks"]
    state = "ok" if marks["right"] else "shared" if marks.get("shared") else "NO"
    said = " + ".join(e + ("" if j is None else f"({j})") for e, j in marks["added"]) or "-"
    return f"{head}{truth:28s}{state:7s}{record['story']['cpu']:6.0f} s  {marks['verdict']}: {said}"


def summary(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scores: (right, of)."""
    done = [r for r in records if "marks" in r]
    of = {
        "first effect and joint right": [r for r in done if r["effect"]],
        "clean ones left alone": [r for r in done if not r["effect"]],
        **{name: [r for r in done if r["effect"] == name] for name in EFFECTS},
    }
    table: dict[str, Any] = {
        name: (sum(r["marks"]["right"] for r in rows), len(rows)) for name, rows in of.items()
    }
    table["CPU seconds, median"] = float(np.median([r["story"]["cpu"] for r in done] or [0]))
    table["errors"] = [r["number"] for r in records if "error" in r]
    return table


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="of everything; drawn anew if not given")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="one arm with a body at its tip, and few effects that are asked",
    )
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--law", choices=("unknown", "known"), default="unknown")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder in which a stopped run continues")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--case", type=int, action="append", help="only the case of this number")
    given = parser.parse_args(arguments)
    drawn = 1 if given.quick else secrets.randbits(31)
    seed = drawn if given.seed is None else given.seed
    cases = draw_wanted(seed, given.count, given.law)
    cases = [w for w in cases if given.case is None or w.number in given.case]
    if given.quick:
        cases = [Wanted(0, seed, "ur5", "payload", "drawn", given.law, few=True)]
    out = given.out or Path(tempfile.mkdtemp(prefix="six_joints_"))
    print(f"seed {seed}, law {given.law}, {len(cases)} cases, results in {out}", flush=True)
    configure_jax()
    records = []
    wanted = {case.label: case for case in cases}
    with Campaign(out, {"seed": seed, "law": given.law}) as campaign:
        for label, record in campaign.run(run_case, wanted, jobs=given.jobs):
            if isinstance(record, Failed):
                record = {**asdict(wanted[label]), "error": record.reason}
            print(row(record), flush=True)
            records.append(record)
    scores = summary(records)
    for name, value in scores.items():
        print(f"  {name:48s}{value}")
    if given.json is not None:
        content = {"seed": seed, "law": given.law, "scores": scores, "cases": records}
        given.json.write_text(json.dumps(content, indent=1, default=float) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
