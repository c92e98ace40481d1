"""A fleet of simulated axes: one table from processes, from Dask, and from a run that was killed.

Each robot is an axis with a mass and friction of its own, whose model knows neither. Some have a
worn joint: a spring (a cable that pulls) or Stribeck friction. The recordings of one robot contain
no torque. Every discovery is done by the default executor; by Dask, if `distributed` is installed;
and by the default executor with a folder for the results, ended by SIGKILL in the middle and begun
again. The tables must say the same; numbers may differ by rounding, since workers of Dask give
linear algebra one thread.

python -m benchmarks.fleet [--quick] [--json FILE]
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import jaxid
from jaxid.control import Tracking
from jaxid.effects import Coulomb, TorqueOffset, Viscous

from ._output import options, records, show, write

ROBOTS, FEW, JOBS = 24, 4, 2
# By number: what is worn, and the robot whose torque was not recorded.
WORN = {2: "spring", 9: "stribeck", 17: "spring", 22: "stribeck"}
BROKEN = 1
SETTINGS: dict[str, Any] = {"progress": False}


def recorded(robot: int, run: int) -> jaxid.Recording:
    """One motion of one robot; its force is written out and shares no code with jaxid."""
    rng = np.random.default_rng([robot, run])
    own = np.random.default_rng(robot)
    mass, drag, dry = own.uniform((4.0, 3.0, 2.0), (6.0, 5.0, 4.0))
    time_s = np.arange(0.0, 6.0, 0.005)
    rates = 2 * np.pi * np.array([0.23, 0.61, 1.3])
    sizes, phases = np.array([0.08, 0.03, 0.01]), rng.uniform(0, 6, 3)

    def motion(order: int) -> np.ndarray:
        turned = time_s[:, None] * rates + phases + order * np.pi / 2
        return (sizes * rates**order * np.sin(turned)).sum(axis=1)

    q, v, a = map(motion, range(3))
    sign = 2 / np.pi * np.arctan(v / 0.01)
    force = mass * a + drag * v + dry * sign
    worn = WORN.get(robot)
    if worn == "spring":
        force += 8.0 * q
    elif worn == "stribeck":
        force += 2.0 * np.exp(-((v / 0.05) ** 2)) * sign
    force += 0.02 * rng.standard_normal(len(time_s))
    if robot == BROKEN:
        force = np.full(len(time_s), 1e-9) * rng.standard_normal(len(time_s))
    return jaxid.Recording.from_arrays(time_s, q, force, name=f"robot_{robot:02}_{run}")


def problems(count: int) -> dict[str, jaxid.FleetRobot]:
    """The robots, by name, each with two recordings to fit and one that judges."""
    effects = Viscous(1, 1.0), Coulomb(1, 1.0), TorqueOffset(1)
    loop = jaxid.ClosedLoop(jaxid.arms.Axis(M=5.0), Tracking(cutoff=20.0), effects, name="axis")
    return {
        f"robot {k:02}": jaxid.FleetRobot(
            loop, [recorded(k, run) for run in (0, 1)], [recorded(k, 2)]
        )
        for k in range(count)
    }


def found_by(
    count: int, executor: Executor | None = None, folder: Path | None = None
) -> jaxid.Fleet:
    """What a whole run finds."""
    return jaxid.discover_all(problems(count), executor, jobs=JOBS, resume=folder, **SETTINGS)


def by_dask(count: int) -> jaxid.Fleet | None:
    """The same by Dask; None if it is not installed."""
    try:
        from distributed import Client
    except ImportError:
        return None
    with Client(
        n_workers=JOBS, threads_per_worker=1, dashboard_address=None, silence_logs=40
    ) as client:
        return found_by(count, client.get_executor())


def killed_once(count: int) -> tuple[jaxid.Fleet, int]:
    """The same, ended by SIGKILL once a third is done, and begun again; how many were done."""
    with tempfile.TemporaryDirectory() as folder:
        steps = Path(folder) / "steps"
        command = [sys.executable, "-m", "benchmarks.fleet", "--into", str(steps), str(count)]
        process = subprocess.Popen(command)
        while len(list(steps.glob("*.piece"))) < max(1, count // 3):
            if process.poll() is not None:
                raise RuntimeError("the fleet ended before it could be killed")
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        done = len(list(steps.glob("*.piece")))
        return found_by(count, folder=steps), done


def differences(table: pd.DataFrame, first: pd.DataFrame) -> dict[str, Any]:
    """Whether two tables say the same, and by how much their numbers differ, relatively."""
    said, numbers = ["verdict", "effects", "parameters"], ["before", "after"]
    one, other = (x[numbers].astype(float).fillna(0.0).to_numpy() for x in (table, first))
    apart = np.max(np.abs(one - other) / np.where(other == 0, 1.0, other))
    return {"same": table[said].equals(first[said]), "numbers_apart": float(apart)}


def compared(count: int) -> tuple[pd.DataFrame, list[dict[str, Any]]]:
    """The table of the default executor, and a row for each way to run the fleet."""
    rows, first = [], None
    for way in ("processes", "Dask", "killed and resumed"):
        began, note = time.perf_counter(), ""
        if way == "processes":
            fleet = found_by(count)
        elif way == "Dask":
            fleet = by_dask(count)
        else:
            fleet, done = killed_once(count)
            note = f"killed after {done} of {count}"
        if fleet is None:
            rows.append({"way": way, "note": "distributed is not installed"})
            continue
        first = fleet if first is None else first
        rows.append(
            {
                "way": way,
                "seconds": time.perf_counter() - began,
                "failed": len(fleet.failed),
                **differences(fleet.table(), first.table()),
                "note": note,
            }
        )
        print(rows[-1], flush=True)
    assert first is not None
    return first.table(), rows


def main() -> None:
    """Prints the fleet, and whether every way finds the same."""
    if sys.argv[1:2] == ["--into"]:
        found_by(int(sys.argv[3]), folder=Path(sys.argv[2]))
        return
    given = options(__doc__)
    table, ways = compared(FEW if given.quick else ROBOTS)
    with pd.option_context("display.width", 150, "display.max_colwidth", 60):
        print(table.drop(columns="said").to_string(float_format=lambda x: f"{x:.3g}"), "\n")
    show(pd.DataFrame(ways).set_index("way"), ".3g")
    write(records(table, about="robots") + [{"about": "ways", **row} for row in ways], given.json)


if __name__ == "__main__":
    main()
