"""Duration and memory of a fit of one recording, over its length.

python -m benchmarks.memory [--quick] [--json FILE]

Each fit runs in a separate process, which reads the recording from a file, so making the recording
does not count. Memory is the largest resident set minus that of the process before the fit.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import jaxid

from ._output import options, report
from ._problem import cad, machine, peak_memory, recordings

PERIOD = 1e-3


def written(seconds: float, folder: Path) -> Path:
    """A file with one recording at 1 kHz."""
    (recording,) = recordings(1, seconds, period=PERIOD)
    path = folder / "recording.npz"
    np.savez(path, time=recording.time, q=recording.q, tau=recording.tau, q_ref=recording.q_ref)
    return path


def fitted(path: str) -> None:
    """Prints duration and memory of a first fit of the recording, and of a second one."""
    held = dict(np.load(path))
    recording = jaxid.Recording.from_arrays(
        held["time"], held["q"], held["tau"], q_ref=held["q_ref"]
    )
    loop = jaxid.ClosedLoop(
        cad().arm, cad().controller, cad().effects, stepping=jaxid.Stepping(substeps=1)
    )
    before, seconds = peak_memory(), []
    for _ in range(2):
        begun = time.perf_counter()
        fit = jaxid.fit(loop, recording, jaxid.OEM(progress=False))
        seconds.append(time.perf_counter() - begun)
    found = {"succeeded": fit.succeeded, "iterations": fit.iterations}
    found |= {
        "cold_s": seconds[0],
        "warm_s": seconds[1],
        "before_MiB": before,
        "peak_MiB": peak_memory(),
    }
    print(json.dumps(found))


def row(minutes: float) -> dict[str, Any]:
    """The row of a recording of that length."""
    with tempfile.TemporaryDirectory() as folder:
        made = f"from benchmarks.memory import *; written({60 * minutes}, Path({folder!r}))"
        subprocess.run([sys.executable, "-c", made], check=True)
        code = f"from benchmarks.memory import fitted; fitted({folder + '/recording.npz'!r})"
        out = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
    found = json.loads(out.stdout.splitlines()[-1])
    samples = round(60 * minutes / PERIOD)
    found["us_per_sample"] = 1e6 * found["warm_s"] / samples
    found["bytes_per_sample"] = 2**20 * (found["peak_MiB"] - found["before_MiB"]) / samples
    return {"minutes": minutes, "samples": samples, **found}


def main() -> None:
    """Prints one table."""
    given = options(__doc__)
    print(machine())
    rows = [row(m) for m in ((0.05, 0.1) if given.quick else (1.0, 10.0, 60.0))]
    report(pd.DataFrame(rows).set_index("minutes"), given.json)


if __name__ == "__main__":
    main()
