"""The measured double pendulum by every method, compared with the published values.

If a method is not suitable for the recordings, its row has the reason.

python -m benchmarks.double_pendulum [--quick] [--json FILE]
"""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd

import jaxid
from jaxid.control import OpenLoop, Tracking
from jaxid.errors import FitError

from ._output import options, report

DATA = Path(__file__).parents[1].parent / "shared" / "data" / "double_pendulum"
LENGTH = 0.3
WINDOW = 0.5
# One low-pass for every method and recording, so all errors refer to the same torque.
CUTOFF = 8.0
FILTERING = jaxid.Filtering(cutoff=CUTOFF, rate=50.0)
COLUMNS = {
    "time": "time",
    "q": ["pos_meas1", "pos_meas2"],
    "v": ["vel_meas1", "vel_meas2"],
    "tau": ["tau_meas1", "tau_meas2"],
}
# Model 2.1 of Wiebe et al. 2024: m1 0.5594, r1 0.3, I1 0.05347, m2 0.6043, r2 0.1838, I2 0.02392.
AUTHORS = {
    "p1": 0.05347 + 0.6043 * LENGTH**2,
    "p2": 0.02392,
    "p4": 0.5594 * 0.3 + 0.6043 * LENGTH,
    "p5": 0.6043 * 0.1838,
}
# The poles of filtered regressions are at the cutoff of the other methods.
POLE = 2 * np.pi * CUTOFF
COUNT = 3.81e-4
_states = {"states": jaxid.LowPass(FILTERING)}
METHODS = {
    "IDIM": (Tracking(cutoff=CUTOFF), jaxid.IDIM(filtering=FILTERING)),
    "difference": (Tracking(cutoff=CUTOFF), jaxid.DifferenceLS()),
    "filtered": (Tracking(cutoff=CUTOFF), jaxid.FilteredLS(POLE, **_states)),
    "integral": (Tracking(cutoff=CUTOFF), jaxid.IntegralLS(POLE, **_states)),
    "weighted integral": (
        Tracking(cutoff=CUTOFF),
        jaxid.IntegralLS(POLE, **_states, weights="encoder"),
    ),
    "Fourier": (Tracking(cutoff=CUTOFF), jaxid.FourierLS()),
    "OEM, open loop": (OpenLoop(), jaxid.OEM(window=WINDOW)),
    "OEM, tracking": (Tracking(cutoff=CUTOFF), jaxid.OEM()),
}


def recordings(*numbers: int) -> jaxid.Recordings:
    """The measured trajectories of these numbers."""
    files = [DATA / f"trajectory_0{k}.csv.gz" for k in numbers]
    return jaxid.read(*files, columns=COLUMNS, resolution=COUNT)


def authors(fitting: jaxid.Recordings) -> jaxid.Fit:
    """The published inertial values, with friction fitted by IDIM."""
    loop = jaxid.two_link(Tracking(cutoff=CUTOFF), link_length=LENGTH).hold(**AUTHORS)
    return jaxid.fit(loop, fitting, jaxid.IDIM(filtering=FILTERING))


def errors(loop: jaxid.ClosedLoop, unseen: jaxid.Recordings) -> dict[str, float]:
    """Torque error along the recorded motion, position error over open-loop windows."""
    tracking = dataclasses.replace(loop, controller=Tracking(cutoff=CUTOFF))
    torque = jaxid.compare(tracking, unseen).error_percent.iloc[0]
    driven = dataclasses.replace(loop, controller=OpenLoop())
    position = jaxid.compare(driven, unseen, window=WINDOW).error_percent.iloc[0]
    both = {"torque": torque, "position": position}
    return {f"{what} {joint}, %": x for what, row in both.items() for joint, x in row.items()}


def table(quick: bool = False) -> pd.DataFrame:
    """One row for each method: parameters, error on recording 05, iterations, seconds."""
    fitting, unseen = recordings(*((1,) if quick else (1, 2, 3))), recordings(5)
    fits = {"authors": authors(fitting)}
    rows: dict[str, dict[str, object]] = {}
    for name, (law, method) in METHODS.items():
        try:
            fits[name] = jaxid.fit(jaxid.two_link(law, link_length=LENGTH), fitting, method)
        except FitError as error:
            rows[name] = {"note": str(error).split(":")[0]}
    for name, found in fits.items():
        values = {p.name: float(p.where(found.loop)) for p in found.loop.parameters}
        kept = {k: x for k, x in values.items() if not k.startswith("eps")}
        took = {"iterations": found.iterations, "seconds": round(found.seconds, 1)}
        rows[name] = kept | took
        try:
            rows[name] |= errors(found.loop, unseen)
        except FitError as error:
            rows[name]["note"] = str(error).split(":")[0]
    return pd.DataFrame(rows).rename_axis("recording 05").T.rename_axis("method")


def main() -> None:
    """Prints the table."""
    given = options(__doc__)
    report(table(given.quick), given.json, ".4f")


if __name__ == "__main__":
    main()
