"""Measured six-joint arms: rigid models, models with the missing effect, and `discover`.

KUKA KR300 (Weigand et al. 2021): fitted on recording A, tested on B; the model with bodies as drawn
lacks the counterbalance at joint 2. Bodies near the drawing, and free, for comparison. Stäubli TX40
(FIGAROH): fitted on the first 5 s, tested on the remaining time; the model lacks the shaft that
joints 5 and 6 share.

python -m benchmarks.real_arms [--quick] [--json FILE]
"""

import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

import jaxid
from jaxid.control import Tracking
from jaxid.effects import AbstractEffect, Counterbalance, SharedShaft, Spring

from ._output import options, records, show, write

DATA = Path(__file__).parents[1].parent / "shared" / "data"
# As in the published figures: 5 Hz, and 100 Hz before rows are thinned.
KR300_CUTOFF, TX40_CUTOFF, TX40_EVERY = 5.0, 100.0, 20


def kr300(bodies: str = "drawn") -> tuple[jaxid.ClosedLoop, jaxid.Recording, jaxid.Recording]:
    """The arm with its rotors, recording A and recording B."""
    folder = DATA / "kr300"
    model = json.loads((folder / "kr300_model.json").read_text(encoding="utf-8"))
    rotors = []
    for joint in model["joints"]:
        above, below = (float(x) for x in f"{joint['gear_ratio']}/1".split("/")[:2])
        rotors.append(joint["motor_inertia"] * (above / below) ** 2)
    law = Tracking(cutoff=KR300_CUTOFF)
    loop = jaxid.serial(folder / "kr300.urdf", law, rotors=tuple(rotors), bodies=bodies)
    a, b = jaxid.read(folder / "kr300_A.csv.gz", folder / "kr300_B.csv.gz", columns={"time": "t"})
    return loop, a, b


def tx40(bodies: str) -> tuple[jaxid.ClosedLoop, jaxid.Recording, jaxid.Recording, jaxid.Recording]:
    """The arm with its gears; the whole recording, its first 5 s, and the remaining time."""
    with np.load(DATA / "tx40" / "tx40.npz") as found:
        signals = {name: found[name] for name in ("dt", "q", "tau", "G")}
    step = float(signals["dt"])
    low = scipy.signal.butter(4, TX40_CUTOFF, fs=1 / step, output="sos")
    # The zero positions of the file differ from those of the robot.
    q = signals["q"] + np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])
    q, tau = (scipy.signal.sosfiltfilt(low, x, axis=0)[::TX40_EVERY] for x in (q, signals["tau"]))
    at = np.arange(len(q)) * step * TX40_EVERY
    parts = {"all": slice(None), "first 5 s": at < 5, "the rest": at >= 5}
    whole, first, rest = (
        jaxid.Recording.from_arrays(at[rows] - at[rows][0], q[rows], tau[rows], name=name)
        for name, rows in parts.items()
    )
    gears = tuple(tuple(row) for row in signals["G"].tolist())
    file = DATA / "tx40" / "tx40_mdh_modified.urdf"
    return jaxid.serial(file, gears=gears, bodies=bodies), whole, first, rest


def row(
    loop: jaxid.ClosedLoop,
    fitting: jaxid.Recording,
    unseen: jaxid.Recording | None = None,
    effect: AbstractEffect | None = None,
) -> dict[str, float]:
    """Torque error by joint of a fit, on its recording and on a held-out one, %."""
    started = time.perf_counter()
    fit = jaxid.fit(loop if effect is None else loop.add(effect), fitting)
    found = {f"{j} fit": float(x) for j, x in enumerate(fit.error_percent.iloc[0], start=1)}
    if unseen is not None:
        found |= unseen_error(jaxid.compare(fit.loop, unseen))
    return found | {"seconds": time.perf_counter() - started}


def unseen_error(comparison: jaxid.Comparison) -> dict[str, float]:
    """Torque error by joint, %."""
    torque = comparison.error_percent.iloc[0]
    return {f"{j} unseen": float(x) for j, x in enumerate(torque, start=1)}


def fits(quick: bool) -> pd.DataFrame:
    """One row for each model: torque error by joint, %."""
    loop, a, b = kr300()
    # The preload of a spring is the offset.
    sprung = loop.without("torque_offset", 2)
    rows = {
        ("KR300", "bodies as drawn"): row(loop, a, b),
        ("KR300", "and a spring on joint 2"): row(sprung, a, b, Spring(joint=2)),
        ("KR300", "and a counterbalance"): row(loop, a, b, Counterbalance(joint=2, angle=0.1)),
    }
    for bodies, said in () if quick else (("near", "near the drawing"), ("free", "free")):
        loop, *_ = kr300(bodies)
        rows["KR300", f"bodies {said}"] = row(loop, a, b)
        more = Counterbalance(joint=2, angle=0.1)
        rows["KR300", f"bodies {said}, counterbalance"] = row(loop, a, b, more)
    shaft = SharedShaft(joint=5, driven=6, smoothing=1e-4)
    loop, whole, first, rest = tx40("drawn" if quick else "free")
    what = "bodies as drawn" if quick else "base parameters free"
    rows |= {
        ("TX40, all of it", what): row(loop, whole),
        ("TX40, all of it", f"{what}, shaft"): row(loop, whole, effect=shaft),
        ("TX40, first 5 s", what): row(loop, first, rest),
        ("TX40, first 5 s", f"{what}, shaft"): row(loop, first, rest, shaft),
    }
    return pd.DataFrame(rows).T.rename_axis(["arm", "model"])


def discoveries() -> pd.DataFrame:
    """One row for each step of a discovery: torque error by joint on held-out data, %."""
    rows: dict[tuple[str, str], dict[str, object]] = {}
    loop, a, b = kr300()
    shafted, _, first, rest = tx40("drawn")
    for arm, (model, fitting, unseen) in {
        "KR300": (loop, a, b),
        "TX40": (shafted, first, rest),
    }.items():
        started = time.perf_counter()
        story = jaxid.discover(model, fitting, unseen, progress=False)
        took = time.perf_counter() - started
        print(story, "\n")
        for step in story.steps:
            assert step.held_out is not None
            said = unseen_error(step.held_out)
            rows[(arm, step.label)] = said | {"verdict": story.verdict, "seconds": took}
    return pd.DataFrame(rows).T.rename_axis(["arm", "step"])


def main() -> None:
    """Prints both tables."""
    given = options(__doc__)
    table = fits(given.quick)
    show(table, ".1f")
    found = records(table)
    if not given.quick:
        steps = discoveries()
        show(steps, ".1f")
        found += records(steps)
    write(found, given.json)


if __name__ == "__main__":
    main()
