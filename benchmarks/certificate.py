"""The certificate of robust stability, tested by 1000 random arms for each set of gains.

Computed torque with PID on a two-link arm whose masses are known to a tenth. Every law is examined
by the linear matrix inequality. It is then simulated (independent simulator, 2 ms ticks) twice on
arms with random inertial parameters inside the bound, from errors of 0.3 rad to either side. The
arm survives if the distance of the two runs falls to a tenth. (The tracking error due to a wrong
mass is common to both runs and does not show instability.) The simulations are without and with
errors of friction and gravity, which the certificate does not cover.

python -m benchmarks.certificate [--quick] [--json FILE]
"""

import dataclasses

import numpy as np
import pandas as pd

import jaxid
from jaxid.control import ComputedTorque, certify, holds, mass_error

from ._output import options, report
from .li2023 import TRUE, sim

SPREAD = 0.1
LAWS = {
    "well damped": (300.0, 1000.0, 40.0),
    "three equal poles at 10": (300.0, 1000.0, 30.0),
    "slow, well damped": (12.0, 8.0, 8.0),
    "little damping": (100.0, 100.0, 3.0),
    "next to no damping": (100.0, 100.0, 1.05),
    "unstable on the exact model": (10.0, 100.0, 1.0),
}
INERTIAL = ("p1", "p2", "p3", "p4", "p5")


def drawn(count: int, gravity: bool) -> list[sim.TwoLink]:
    """Frictionless arms with masses inside the bound, or with gravity and friction as well."""
    rng = np.random.default_rng(4)
    arms = []
    for _ in range(count):
        share = dict(zip(INERTIAL, rng.uniform(1 - SPREAD, 1 + SPREAD, 5), strict=True))
        values = {name: getattr(TRUE, name) * share[name] for name in INERTIAL}
        if not gravity:
            values |= {"p4": TRUE.p4, "p5": TRUE.p5, "Fv1": 0.0, "Fc1": 0.0, "Fv2": 0.0, "Fc2": 0.0}
        arms.append(dataclasses.replace(TRUE, **values))
    return arms


def survivors(gains: tuple[float, float, float], arms: list[sim.TwoLink], seconds: float) -> float:
    """Share of arms, %, on which runs from 0.3 rad to either side come within 0.06 rad."""
    kp, ki, kd = ((g, g) for g in gains)
    law = sim.SampledComputedTorque(TRUE, kp, ki, kd, period=0.002, window=1)
    time = 0.002 * np.arange(round(seconds / 0.002) + 1)
    w = np.array([1.3, 2.1])
    angle = np.outer(time, w)
    asked = np.stack([0.5 * np.sin(angle), 0.5 * w * np.cos(angle), -0.5 * w**2 * np.sin(angle)])
    start = np.tile([0.3, -0.3], (len(arms), 1))
    ends = []
    with np.errstate(over="ignore", invalid="ignore"):
        for q0 in (start, -start):
            runs = sim.simulate_batch(arms, asked, law, np.zeros(len(arms)), substeps=1, q0=q0)
            ends.append(runs.q_true[:, -250:])
        apart = np.abs(ends[1] - ends[0]).max(axis=(1, 2))
    return 100 * float(np.mean(apart < 0.06))


def table(quick: bool = False) -> pd.DataFrame:
    """One row for each law."""
    arm = jaxid.arms.TwoLink(**{name: getattr(TRUE, name) for name in INERTIAL})
    bound = mass_error(arm, arm.workspace(), SPREAD)
    count, seconds = (20, 6.0) if quick else (1000, 7.0)
    rows = {}
    for name, gains in LAWS.items():
        kp, ki, kd = ([g, g] for g in gains)
        law = ComputedTorque(arm, Kp=kp, Ki=ki, Kd=kd)
        found = certify(law, bound)
        rows[name] = {
            "Kp, Ki, Kd": ", ".join(f"{g:g}" for g in gains),
            "certified": found.certified,
            "checked": holds(found, law),
            "survive, %": survivors(gains, drawn(count, False), seconds),
            "with gravity and friction, %": survivors(gains, drawn(count, True), seconds),
        }
    return pd.DataFrame(rows).T.rename_axis("law")


def main() -> None:
    """Prints the table."""
    given = options(__doc__)
    report(table(given.quick), given.json, ".1f")


if __name__ == "__main__":
    main()
