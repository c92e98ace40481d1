"""How well a model predicts recordings, and where it fails."""

import dataclasses
import html
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from ..control import OpenLoop
from ..display.shown import AbstractShown
from ..errors import FitError, RecordingError
from ..estimate import Filtering, Fit
from ..estimate.converge import from_best_starts
from ..estimate.oem import OEM, oem_of
from ..estimate.pieces import pieces_of
from ..estimate.regression import filtered
from ..estimate.result import errors_to_dict, joint_columns, relative_errors
from ..noise import autocorrelation
from ..recording import Recording, Recordings
from ..signals.smoothing import Band
from ..simulation.batch import band_of, compared_torques, prepare
from ..simulation.integration import reason
from ..simulation.loop import ClosedLoop
from ..simulation.runs import BY_SAMPLE, Simulated, by_recording, simulate_batch
from ..simulation.sharing import with_one_blas_thread
from ..simulation.steps import with_substeps
from ..storage.saved import save

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


# Signals of a run that figures show; tables have been made of them.
_DRAWN = ("q", "v", "a", "tau", "delivered")


class Comparison(AbstractShown):
    """Measured and simulated signals.

    - `runs`: the simulated signals, one entry per recording.
    - `errors`: 100 · ‖measured - simulated‖ / ‖measured‖ by recording, signal and joint.
    """

    loop: ClosedLoop
    recordings: Recordings
    runs: tuple[Simulated, ...]
    errors: "pd.DataFrame"

    @property
    def signal(self) -> str:
        """The signal that is compared: torque, or position if the torque adds no information."""
        return self.loop.controller.judged

    @property
    def error_percent(self) -> "pd.DataFrame":
        """Relative error by recording and joint, % (Table 3 of Brunot et al. 2016)."""
        import pandas as pd

        table = self.errors.xs(self.signal, level="signal")
        assert isinstance(table, pd.DataFrame)
        return table

    def judged(self, recording: int | str = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time, measured and simulated signal as they are compared, `(samples, joints)`.

        If the control law is unknown, both signals are low-passed and their ends are removed. They
        are zero while a joint is at rest, if its standstill is left out.

        **Arguments:**

        - `recording`: number from 0, or name.
        """
        k = self._index(recording)
        record, run = self.recordings[k], self.runs[k]
        if self.signal == "position":
            return record.time, record.q, np.asarray(run.q)
        band = band_of(self.loop, self.recordings)
        torques = [np.asarray(x.tau) for x in self.runs]
        both = compared_torques(self.loop, self.recordings, torques)
        measured, simulated = (signals[k] for signals in both)
        return record.time[_rows(band, k)], measured, simulated

    def compared_motion(self, recording: int | str = 0) -> tuple[np.ndarray, ...]:
        """Simulated position, velocity and acceleration as compared, each `(samples, joints)`.

        **Arguments:**

        - `recording`: number from 0, or name.
        """
        k = self._index(recording)
        run, rows = self.runs[k], _rows(band_of(self.loop, self.recordings), k)
        return tuple(np.asarray(x)[rows] for x in (run.q, run.v, run.a))

    def shown(self, recording: int | str = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `judged`, for a figure: NaN while a joint is at rest and is not compared.

        **Arguments:**

        - `recording`: number from 0, or name.
        """
        time, measured, simulated = self.judged(recording)
        blank = np.where((measured == 0) & (simulated == 0), np.nan, 0.0)
        return time, measured + blank, simulated + blank

    def stored(self) -> "Comparison":
        """The same for a file: what figures show in single precision, and no states."""
        runs = []
        for run in self.runs:
            rest = {name: np.asarray(getattr(run, name), np.float32) for name in _DRAWN}
            empty = np.zeros((*run.states.shape[:-1], 0))
            runs.append(dataclasses.replace(run, states=empty, **rest))
        return dataclasses.replace(self, runs=tuple(runs))

    @property
    def residuals(self) -> tuple[Float[np.ndarray, "_samples joints"], ...]:
        """Measured minus simulated signal as compared, one `(samples, joints)` per recording."""
        if self.signal == "position":
            pairs = zip(self.recordings, self.runs, strict=True)
            return tuple(record.q - np.asarray(run.q) for record, run in pairs)
        torques = [np.asarray(x.tau) for x in self.runs]
        both = compared_torques(self.loop, self.recordings, torques)
        return tuple(measured - simulated for measured, simulated in zip(*both, strict=True))

    def autocorrelation(
        self, recording: int | str = 0, lags: int = 38
    ) -> tuple[Float[np.ndarray, "lags_and_zero joints"], float]:
        """Autocorrelation of each joint's residual from lag 0, and the two-sigma bound."""
        _, measured, simulated = self.judged(recording)
        residual = measured - simulated
        columns = [autocorrelation([x - x.mean()], lags) for x in residual.T]
        return np.stack([c for c, _ in columns], axis=1), columns[0][1]

    def _index(self, recording: int | str) -> int:
        if isinstance(recording, int):
            return range(len(self.recordings))[recording]
        if recording not in self.recordings.names:
            raise RecordingError(
                f"there is no recording {recording!r} in this comparison: it has "
                f"{', '.join(self.recordings.names)}"
            )
        return self.recordings.names.index(recording)

    def plot(self, recording: int | str = 0) -> "go.Figure":
        """Measured, simulated and residual of one recording, with the residual's autocorrelation.

        **Arguments:**

        - `recording`: number from 0, or name.
        """
        from ..display import figures

        k = self._index(recording)
        time, measured, simulated = self.shown(k)
        acf, bound = self.autocorrelation(k)
        torque, position = self.loop.arm.units()
        units = position if self.signal == "position" else torque
        record = self.recordings[k]
        percent = self.error_percent.iloc[k]
        joints = [f"{label} ({percent[label]:.2f} %)" for label in percent.index]
        return figures.comparison(
            time,
            measured,
            simulated,
            measured - simulated,
            acf,
            bound,
            joints,
            list(units),
            f"{record.name}: {self.signal}, measured and simulated",
        )

    def plot_errors(self) -> "go.Figure":
        """Relative errors of all recordings as bars."""
        from ..display import figures

        table = self.error_percent
        return figures.error_bars(list(table.columns), list(table.index), table.to_numpy())

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the comparison to one file, which `jaxid.load` reads.

        **Arguments:**

        - `path`: by convention with the ending `.jaxid`; an existing file is replaced.

        **Raises:** `SaveError` if it cannot be written.
        """
        return save(self, path)

    def to_dict(self) -> dict[str, Any]:
        """Relative errors as plain JSON."""
        return {
            "robot": self.loop.name,
            "error_percent": errors_to_dict(self.error_percent),
            "errors": {
                signal: errors_to_dict(self.errors.xs(signal, level="signal"))  # type: ignore[arg-type]
                for signal in self.errors.index.unique("signal")
            },
        }

    def __repr__(self) -> str:
        table = self.errors.to_string(float_format=lambda x: f"{x:.4g}")
        return f"{self.loop.name}, relative error in %:\n{table}"

    def _repr_html_(self) -> str:
        head = html.escape(f"{self.loop.name}, relative error in %")
        return f"<p>{head}</p>{self.errors.to_html(float_format='%.4g')}"


def _rows(band: Band | None, recording: int) -> slice | Int[np.ndarray, " rows"]:
    """The compared samples of a recording."""
    if band is None:
        return slice(None)
    return np.asarray(band.rows)[recording][np.asarray(band.keep)[recording]]


@with_one_blas_thread
def compare(
    model: Fit | ClosedLoop,
    recordings: Recording | Recordings | Iterable[Recording],
    *,
    window: float | None = None,
) -> Comparison:
    """Simulates a model along recordings and compares it with the measured signals.

    The simulation of a recording that does not start at rest starts from the state with the
    smallest error, unless the fit trusted the first sample (`OEM(initial="rest")`).

    **Arguments:**

    - `model`: a fit or a loop.
    - `recordings`: used for the fit or not.
    - `window`: length of pieces that each start from the measured state, s; by default that of
      the fit, otherwise whole recordings.

    **Raises:** `RecordingError`, `ModelError` if model and recordings do not match; `FitError` if
    the loop cannot be simulated.
    """
    loop = model.loop if isinstance(model, Fit) else model
    recordings = Recordings.of(recordings)
    method = oem_of(model)
    window = method.window if window is None else window
    runs = _simulate_in_windows(method, loop, recordings, window)
    for run, recording in zip(runs, recordings, strict=True):
        if not np.isfinite(run.tau).all() or not np.isfinite(run.q).all():
            raise FitError(
                f"the loop {loop.name} diverges when it is simulated along {recording.name} "
                f"({reason(run.result)}): check this recording, fit the loop first or from other "
                "values, or use smaller steps (jaxid.Stepping(substeps=...))"
            )
    return Comparison(
        loop=loop, recordings=recordings, runs=runs, errors=_errors(loop, recordings, runs)
    )


def _simulate_in_windows(
    method: OEM, loop: ClosedLoop, recordings: Recordings, window: float | None
) -> tuple[Simulated, ...]:
    if window is None:
        batch = prepare(loop, recordings)
        loop = with_substeps(loop, recordings)
        batch = from_best_starts(method, loop, tuple(recordings), batch)
        return by_recording(simulate_batch(loop, batch), recordings)
    runs = []
    for recording in recordings:
        # Windows keep the recording's name, because effects on named recordings need it.
        pieces = pieces_of(Recordings.of(recording), window)
        batch = prepare(loop, pieces)
        stepped = with_substeps(loop, Recordings.of(recording))
        parts = by_recording(simulate_batch(stepped, batch), pieces)
        cut = [(0 if k == 0 else 1) for k in range(len(parts))]
        whole = {
            name: np.concatenate(
                [getattr(part, name)[first:] for part, first in zip(parts, cut, strict=True)]
            )
            for name in BY_SAMPLE
        }
        worst = max(int(part.result) for part in parts)
        runs.append(_padded(Simulated(**whole, result=np.asarray(worst, np.int32)), recording))
    return tuple(runs)


def _padded(run: Simulated, recording: Recording) -> Simulated:
    """Appends the last samples, too few for a window, as measured."""
    missing = recording.samples - len(run.time)
    if missing == 0:
        return run
    values: dict[str, Any] = {"result": run.result}
    for name in BY_SAMPLE:
        had = getattr(run, name)
        measured = getattr(recording, name, None)
        tail = np.repeat(had[-1:], missing, axis=0) if measured is None else measured[-missing:]
        values[name] = np.concatenate([had, tail])
    return Simulated(**values)


def _errors(
    loop: ClosedLoop, recordings: Recordings, runs: tuple[Simulated, ...]
) -> "pd.DataFrame":
    """Relative errors of position, velocity and torque by recording."""
    import pandas as pd

    tables = {}
    pairs = list(zip(recordings, runs, strict=True))
    position = [r.q for r in recordings]
    tables["position"] = relative_errors(
        recordings, position, [r.q - np.asarray(run.q) for r, run in pairs]
    )
    # If velocity was not measured, it is derived from position without delay, at every sample.
    velocity = [
        filtered(r, Filtering(cutoff=r.rate / 10, rate=r.rate, trim=0.0)).v if r.v is None else r.v
        for r in recordings
    ]
    tables["velocity"] = relative_errors(
        recordings,
        [np.asarray(v) for v in velocity],
        [np.asarray(v) - np.asarray(run.v) for v, run in zip(velocity, runs, strict=True)],
    )
    if not isinstance(loop.controller, OpenLoop):
        both = compared_torques(loop, recordings, [np.asarray(run.tau) for run in runs])
        torque, left = both[0], [x - y for x, y in zip(*both, strict=True)]
        tables["torque"] = relative_errors(recordings, torque, left)
    together = pd.concat(tables, names=["signal"]).reorder_levels(["recording", "signal"])
    columns = joint_columns(loop.joints)
    order = [(r.name, s) for r in recordings for s in tables]
    return together.loc[order, columns]
