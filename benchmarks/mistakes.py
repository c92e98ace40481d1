"""Recordings with a user error: the verdict must not be `adequate` or `explained`.

Robots of the worlds benchmark (MuJoCo) are read with one error: a wrong sign of torque, a position
in degrees or millimetres, the torques of two joints swapped, a clock twice as fast, torque that is
noise, a joint at rest, the URDF of another robot, or a drive that is at its limit for most of the
time. The law is unknown. Free bodies absorb some of these errors: a clock twice as fast is the same
as a quarter of the inertia. With `--bodies drawn` the bodies are those of the URDF, wrong by up to
a quarter.

python -m benchmarks.mistakes [--quick] [--json FILE] [--seed N] [--count 24]
                              [--bodies free|drawn]
"""

import argparse
import dataclasses
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import jaxid
from jaxid.errors import JaxidError

from ._output import show, write
from ._world_cases import Case, draw_wanted, make, read_case, start_model
from .hidden_effects import configure_jax

Signals = dict[str, np.ndarray]
Mistake = Callable[[Signals, int], Signals]


def _scaled(name: str, factor: float) -> Mistake:
    def change(r: Signals, j: int) -> Signals:
        by = np.where(np.arange(r["q"].shape[1]) == j, factor, 1.0)
        names = ("q", "q_ref") if name == "q" else (name,)
        return r | {n: r[n] * by for n in names}

    return change


def _swapped(r: Signals, j: int) -> Signals:
    return r | {"tau": r["tau"][:, ::-1]}


def _clock(r: Signals, j: int) -> Signals:
    return r | {"time": r["time"] / 2}


def _noise(r: Signals, j: int) -> Signals:
    rng = np.random.default_rng(j)
    return r | {"tau": rng.standard_normal(r["tau"].shape) * np.std(r["tau"], axis=0)}


def _still(r: Signals, j: int) -> Signals:
    q = r["q"].copy()
    q[:, j] = q[0, j] + 1e-6 * np.random.default_rng(j).standard_normal(len(q))
    return r | {"q": q}


def _limited(r: Signals, j: int) -> Signals:
    """The logged torque is limited, the motion is that of the command."""
    most = 0.4 * np.std(r["tau"][:, j])
    tau = r["tau"].copy()
    tau[:, j] = np.clip(tau[:, j], -most, most)
    return r | {"tau": tau}


def _same(r: Signals, j: int) -> Signals:
    return r


# By name: the change of a recording, and words of which a correct reason contains one.
MISTAKES: dict[str, tuple[Mistake, tuple[str, ...]]] = {
    "sign of torque": (_scaled("tau", -1.0), ("sign",)),
    "degrees or millimetres": (_scaled("q", 57.3), ("in degrees", "in mm", "unit of the position")),
    "torques swapped": (_swapped, ("swapped",)),
    "clock twice as fast": (_clock, ("clock", "time stamps")),
    "torque of noise": (_noise, ("noise", "no better than none", "units")),
    "joint that stands still": (_still, ("moves by",)),
    "another robot": (_same, ("robot", "check")),
    "drive at its limit": (_limited, ("limit", "saturat")),
}
_TWO_JOINTS = ("planar", "scara", "gantry", "polar")


def broken(case: Case, name: str, joint: int) -> Case:
    """A case in which all recordings have an error."""
    change = MISTAKES[name][0]
    recordings = {key: change(r, joint) for key, r in case.recordings.items()}
    return dataclasses.replace(case, recordings=recordings)


def run_case(seed: int, number: int, name: str, bodies: str) -> dict[str, Any]:
    """The result of a discovery for one case.

    **Arguments:**

    - `number`: determines robot and joint, with the seed. `name`: name of the error.
    - `bodies`: "free" or "drawn".
    """
    rng = np.random.default_rng([seed, number])
    robot = str(rng.choice(_TWO_JOINTS))
    joint = int(rng.integers(2))
    wanted = draw_wanted(seed + number, 1, ("unknown",), robot)[0]
    wanted = dataclasses.replace(wanted, kind="clean", effects=())
    case = make(wanted)
    loop = start_model(case, "unknown")
    if name == "another robot":
        other = dataclasses.replace(wanted, robot="gantry" if robot != "gantry" else "planar")
        loop = start_model(make(other), "unknown")
    if bodies == "drawn":
        loop = jaxid.serial(case.drawn, None, bodies="drawn")
    made = broken(case, name, joint)
    with tempfile.TemporaryDirectory() as folder:
        fitting, held_out = read_case(Path(folder), made)
    started, cpu = time.perf_counter(), time.process_time()
    try:
        story = jaxid.discover(loop, fitting, held_out, progress=False)
        verdict, said = story.verdict, f"{story.sentence} {' '.join(story.notes)}"
        left = float(story.fit.error_percent.to_numpy().max())
    except JaxidError as error:
        verdict, said, left = "refused", str(error), np.nan
    return {
        "mistake": name,
        "robot": robot,
        "joint": joint + 1,
        "verdict": verdict,
        "sure": verdict in ("adequate", "explained"),
        "named": any(word in said for word in MISTAKES[name][1]),
        "left": left,
        "seconds": time.perf_counter() - started,
        "cpu": time.process_time() - cpu,
        "said": said,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one case of two mistakes")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--bodies", choices=("free", "drawn"), default="free")
    given = parser.parse_args(arguments)
    configure_jax()
    names = list(MISTAKES)[:2] if given.quick else list(MISTAKES)
    count = 2 if given.quick else given.count
    rows = []
    for number in range(count):
        row = run_case(given.seed, number, names[number % len(names)], given.bodies)
        print(json.dumps(row)[:400], flush=True)
        rows.append(row)
    table = pd.DataFrame(rows)
    means = table.groupby("mistake")[["sure", "named", "left", "seconds", "cpu"]].mean()
    show(means.assign(cases=table.groupby("mistake").size()))
    write(rows, given.json)


if __name__ == "__main__":
    main()
