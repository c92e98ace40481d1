"""Write the recordings that the package's demo ships: python -m tests.independent.demo OUTDIR."""

from __future__ import annotations

import argparse
from pathlib import Path

from .cases import make_case, remaining_after_refit, write_csv
from .effects import Stribeck

SEED = 2016
# Somewhat larger than the joint's Coulomb friction, and gone at a quarter of its usual speed.
HIDDEN = Stribeck(joint=2, torque=0.08, velocity=0.4)
# Enough for 40 000 counts per turn and for the noise, and no more: the files are shipped.
DECIMALS = (5, 5, 5)


def write(folder: Path) -> None:
    """Write clean/ and hidden/, the same arm and motions without and with Stribeck friction."""
    for name, effects in (("clean", []), ("hidden", [HIDDEN])):
        case = make_case(SEED, effects, duration=10.0)
        for recording, signals in case.recordings.items():
            write_csv(folder / name / f"{recording}.csv", signals, DECIMALS)
        print(name, case.effects, "left after a refit:", remaining_after_refit(case))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    write(parser.parse_args().folder)
