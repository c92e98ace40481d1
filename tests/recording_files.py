"""Signals of no robot, and files of them, for the tests of reading."""

from pathlib import Path

import numpy as np
import pandas as pd
import scipy.io

from jaxid.recording import Recording

SAMPLES = 60


def signals(joints: int = 2) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    time = 0.01 * np.arange(SAMPLES)
    names = ("q_ref", "q", "tau", "v", "tau_ff")
    return {"time": time} | {name: rng.normal(size=(SAMPLES, joints)) for name in names}


def frame(joints: int = 2) -> pd.DataFrame:
    return Recording.from_arrays(**signals(joints)).to_dataframe()


def write(path: Path, table: pd.DataFrame) -> Path:
    table = table.copy()
    table.attrs = {}
    arrays = {str(name): table[name].to_numpy() for name in table}
    match path.suffix:
        case ".parquet":
            table.to_parquet(path)
        case ".mat":
            scipy.io.savemat(path, arrays)
        case ".npz":
            np.savez(path, **arrays)
        case ".txt":
            np.savetxt(path, table, header=" ".join(table), fmt="%.17g")
        case ".tsv":
            table.to_csv(path, index=False, sep="\t")
        case _:
            table.to_csv(path, index=False)
    return path
