"""Accuracy of fits: 20 simulated SCARAs with random parameters and motions.

Each draw: base parameters within 12 % of the published ones, two recordings of 20 s by the
independent simulator of tests/independent, encoders of 40 000 counts, coloured torque noise of
1.5 %. The fit starts from CAD.

python -m benchmarks.recover [--quick] [--json FILE]
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

import jaxid

from ._output import options, report

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import independent as sim

DRAWS = 20
FIRST_SEED = 100


def draw(seed: int) -> tuple[jaxid.Recordings, dict[str, float], sim.Case]:
    """Two recordings of a random arm on random references, and its base parameters."""
    case = sim.make_case(seed)
    found = []
    for name in ("fit_1", "fit_2"):
        r = case.recordings[name]
        found.append(
            jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name=name)
        )
    truth = {name: getattr(case.plant, name) for name in case.plant.base}
    return jaxid.Recordings.of(found), truth, case


def row(seed: int, controller: jaxid.control.AbstractController | None = None) -> dict[str, object]:
    """One fit: distance from the truth in its own standard deviations, status and time."""
    recordings, truth, _ = draw(seed)
    found = jaxid.fit(jaxid.scara(controller), recordings)
    away = (found.theta - np.array([truth[name] for name in found.names])) / found.std
    result: dict[str, object] = dict(zip(found.names, away.tolist(), strict=True))
    result |= {"worst": float(np.abs(away).max()), "status": found.status.name}
    return result | {"iterations": found.iterations, "seconds": round(found.seconds, 2)}


def table(draws: int = DRAWS) -> pd.DataFrame:
    """One row for each draw."""
    rows = {FIRST_SEED + k: row(FIRST_SEED + k) for k in range(draws)}
    return pd.DataFrame(rows).T.rename_axis("draw")


def main() -> None:
    """Prints the table, and the root mean square error in deviations: 1 if these are correct."""
    given = options(__doc__)
    found = table(3 if given.quick else DRAWS)
    report(found, given.json, ".2f")
    away = found.drop(columns=["worst", "status", "iterations", "seconds"]).to_numpy(float)
    print(f"within 4 deviations: {np.sum(np.abs(away).max(axis=1) < 4)} of {len(found)}")
    print(f"root mean square of all: {np.sqrt(np.mean(away**2)):.2f}")


if __name__ == "__main__":
    main()
