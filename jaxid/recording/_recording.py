"""Recordings as arrays in SI."""

import html
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import equinox as eqx
import numpy as np
from jaxtyping import Float64

from ..errors import brief, near
from ._checks import Accept, Clock, Nan, numeric, validate
from ._columns import Picked, pick
from ._description import Columns, Description, Resolution, Scale
from ._problem import problem
from ._steps import quantum
from ._table import from_frame
from ._tables import frame_of
from ._times import Gaps
from ._units import HELD, SIGNALS, Units

if TYPE_CHECKING:
    import pandas as pd


class Recording(eqx.Module):
    """Sampled signals of one experiment, in NumPy arrays of float64 and SI units.

    Made by `jaxid.read`, `Recording.from_arrays` or `Recording.from_table`, which check it.

    **Fields:**

    - `time`: `(samples,)`, s.
    - `q`: measured position, `(samples, joints)`, rad or m.
    - `tau`: the drive's commanded torque as recorded, `(samples, joints)`, N·m or N; V if a motor
      is driven by voltage (`jaxid.effects.DCMotor`).
    - `q_ref`: reference, `(samples, joints)`, rad or m, or None.
    - `v`: measured velocity, `(samples, joints)`, rad/s or m/s, or None.
    - `tau_ff`: known torque added to the controller's output, which `tau` contains,
      `(samples, joints)`, N·m or N, or None.
    - `v_ref`, `kp`, `kd`: velocity reference, rad/s or m/s, and gains that were commanded with
      every sample, in the unit that the law takes, `(samples, joints)`, or None.
    - `supply`: measured supply voltage of the drives, `(samples, joints)`, V, or None.
    - `on`: 1 where a drive is powered, 0 where its motor is open, `(samples, joints)`, or None.
    - `resolution`: encoder step, `(joints,)`, rad or m, or None.
    - `name`: its name in tables and figures.
    """

    time: Float64[np.ndarray, " samples"]
    q: Float64[np.ndarray, "samples joints"]
    tau: Float64[np.ndarray, "samples joints"]
    q_ref: Float64[np.ndarray, "samples joints"] | None = None
    v: Float64[np.ndarray, "samples joints"] | None = None
    tau_ff: Float64[np.ndarray, "samples joints"] | None = None
    v_ref: Float64[np.ndarray, "samples joints"] | None = None
    kp: Float64[np.ndarray, "samples joints"] | None = None
    kd: Float64[np.ndarray, "samples joints"] | None = None
    supply: Float64[np.ndarray, "samples joints"] | None = None
    on: Float64[np.ndarray, "samples joints"] | None = None
    resolution: Float64[np.ndarray, " joints"] | None = None
    name: str = eqx.field(static=True, default="recording")

    @classmethod
    def from_arrays(
        cls,
        time: object,
        q: object,
        tau: object,
        *,
        q_ref: object = None,
        v: object = None,
        tau_ff: object = None,
        v_ref: object = None,
        kp: object = None,
        kd: object = None,
        supply: object = None,
        on: object = None,
        resolution: Resolution | None = None,
        name: str = "recording",
        units: Units | None = None,
        scale: Scale | None = None,
        gaps: Gaps = "refuse",
        nan: Nan = "refuse",
        clock: Clock = "recorded",
    ) -> "Recording":
        """A recording from array-likes, checked.

        **Arguments:**

        - `time`: `(samples,)`, s.
        - `q`, `tau`, `q_ref`, `v`, `tau_ff`: `(samples, joints)`, or `(samples,)` for one joint;
          rad or m, N·m or N.
        - `v_ref`, `kp`, `kd`, `supply`, `on`: as the fields; one number holds for all samples.
        - `resolution`: encoder step, one or one for each joint, rad or m.
        - `name`: its name in tables and figures.
        - `units`, `scale`: unit and factor by signal if it is not SI, as in `jaxid.read`.
        - `gaps`, `nan`, `clock`: as in `jaxid.read`.

        **Raises:** `RecordingError` if they cannot be used.
        """
        given = {"time": time, "q": q, "tau": tau, "q_ref": q_ref, "v": v, "tau_ff": tau_ff}
        given |= {"v_ref": v_ref, "kp": kp, "kd": kd, "supply": supply, "on": on}
        signals = {
            signal: numeric(name, signal, values)
            for signal, values in given.items()
            if values is not None or signal in ("time", "q", "tau")
        }
        told = Description(
            units=units, scale=scale, resolution=resolution, accept=Accept(gaps, nan, clock)
        )
        return build(name, name, Picked(signals, {"time": ["time"]}), told)

    @classmethod
    def from_table(
        cls,
        table: object,
        *,
        columns: Columns | None = None,
        name: str | None = None,
        units: Units | None = None,
        scale: Scale | None = None,
        resolution: Resolution | None = None,
        gaps: Gaps = "refuse",
        nan: Nan = "refuse",
        clock: Clock = "recorded",
    ) -> "Recording":
        """A recording from a table in memory, checked.

        **Arguments:**

        - `table`: one row for each sample, columns as in `jaxid.read`: a pandas DataFrame, an Arrow
          table, or another that Arrow can read (Polars, DuckDB). A column may hold lists with one
          number per joint.
        - `columns`, `units`, `scale`, `gaps`, `nan`, `clock`: as in `jaxid.read`.
        - `name`, `resolution`: as in `from_arrays`; if None, the values stored by `to_dataframe`.

        **Raises:** `RecordingError` if it cannot be used.
        """
        frame = frame_of(str(name or "recording"), table)
        name = str(name or frame.attrs.get("name") or "recording")
        resolution = frame.attrs.get("resolution") if resolution is None else resolution
        told = Description(
            columns=columns,
            units=units,
            scale=scale,
            resolution=resolution,
            accept=Accept(gaps, nan, clock),
        )
        return build(name, name, pick(name, from_frame(name, frame), told), told)

    @classmethod
    def from_dataframe(cls, frame: "pd.DataFrame", **options: Any) -> "Recording":
        """A recording from a pandas DataFrame; options as in `from_table`, which also takes one."""
        return cls.from_table(frame, **options)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.q.shape[0]

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.time[-1] - self.time[0])

    @property
    def period(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.time)))

    @property
    def rate(self) -> float:
        """Sample rate, Hz."""
        return 1 / self.period

    @property
    def held_names(self) -> tuple[str, ...]:
        """Names of the signals that hold from sample to sample."""
        return tuple(name for name in HELD if getattr(self, name) is not None)

    def held_at(
        self, time: Float64[np.ndarray, " times"]
    ) -> dict[str, Float64[np.ndarray, "times joints"]]:
        """Signals that hold from sample to sample, by name, at any times, `(times, joints)`.

        **Arguments:**

        - `time`: s.
        """
        row = np.searchsorted(self.time, time, side="right") - 1
        row = np.clip(row, 0, self.samples - 1)
        return {name: getattr(self, name)[row] for name in self.held_names}

    def slice(self, start_s: float | int | None, stop_s: float | int | None) -> "Recording":
        """The samples with `start_s <= time < stop_s`, their times unchanged.

        **Arguments:**

        - `start_s`, `stop_s`: times, s; None for the recording's own start or end.

        **Raises:** `RecordingError` if the window contains fewer than two samples.
        """
        start = 0 if start_s is None else np.searchsorted(self.time, start_s)
        stop = self.samples if stop_s is None else np.searchsorted(self.time, stop_s)
        if stop - start < 2:
            raise problem(
                self.name,
                f"fewer than two samples lie between {start_s} and {stop_s} s",
                f"choose a window within {self.time[0]:.6g} and {self.time[-1]:.6g} s",
            )
        cut = {signal: values[start:stop] for signal, values in _signals(self).items()}
        return Recording(**cut, resolution=self.resolution, name=self.name)

    def same_samples(self, other: "Recording") -> bool:
        """Whether another recording, of any name, has the same positions and torque."""
        return np.array_equal(self.q, other.q) and np.array_equal(self.tau, other.tau)

    def to_dataframe(self) -> "pd.DataFrame":
        """A table with one row for each sample; `from_table` restores the recording from it."""
        import pandas as pd

        columns = {}
        for signal, values in _signals(self).items():
            if signal == "time":
                columns["time"] = values
            else:
                columns |= {f"{signal}_{k}": column for k, column in enumerate(values.T, start=1)}
        frame = pd.DataFrame(columns)
        frame.attrs["name"] = self.name
        if self.resolution is not None:
            frame.attrs["resolution"] = self.resolution.tolist()
        return frame

    def __repr__(self) -> str:
        joints = "1 joint" if self.joints == 1 else f"{self.joints} joints"
        return (
            f"Recording({self.name!r}: {joints}, {self.samples} samples, "
            f"{self.duration:.1f} s at {self.rate:.4g} Hz)"
        )

    def _repr_html_(self) -> str:
        return f"<code>{html.escape(repr(self))}</code>"


class Recordings(eqx.Module):
    """Several recordings of the same robot with distinct names; made by `of`."""

    recordings: tuple[Recording, ...]

    @classmethod
    def of(cls, recordings: "Recording | Recordings | Iterable[Recording]") -> "Recordings":
        """Recordings from one or several recordings; a repeated name gets a number.

        **Arguments:**

        - `recordings`: a `Recording`, a `Recordings`, or an iterable of `Recording`.

        **Raises:** `RecordingError` if there are none, or their numbers of joints differ.
        """
        if isinstance(recordings, Recordings):
            return recordings
        alone = isinstance(recordings, (Recording, str, Path))
        several = (recordings,) if alone else tuple(recordings)
        if not several:
            raise problem("Recordings", "there is no recording", "give at least one")
        for recording in several:
            if not isinstance(recording, Recording):
                raise problem(
                    "Recordings", f"{brief(recording)} is not a Recording", "use jaxid.read first"
                )
            if recording.joints != several[0].joints:
                raise problem(
                    recording.name,
                    f"it has {recording.joints} joints, but {several[0].name} has "
                    f"{several[0].joints}",
                    "read recordings of different robots separately",
                )
        names = _distinct([recording.name for recording in several])
        return cls(tuple(map(_renamed, several, names)))

    @property
    def joints(self) -> int:
        """Number of joints of each recording."""
        return self.recordings[0].joints

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings, all distinct."""
        return tuple(recording.name for recording in self.recordings)

    def common_period(self) -> float:
        """The common sample period, s, which noise filters require.

        **Raises:** `RecordingError` if periods differ by more than 1 %.
        """
        first = self.recordings[0]
        for other in self.recordings:
            if abs(other.period / first.period - 1) > 0.01:
                raise problem(
                    other.name,
                    f"it has {other.rate:.4g} samples per second, but {first.name} has "
                    f"{first.rate:.4g}, and a noise filter is valid for one rate only",
                    "resample one of them, or use them separately",
                )
        return first.period

    def __iter__(self) -> Iterator[Recording]:
        return iter(self.recordings)

    def __len__(self) -> int:
        return len(self.recordings)

    @overload
    def __getitem__(self, key: int | str) -> Recording: ...

    @overload
    def __getitem__(self, key: slice) -> "Recordings": ...

    def __getitem__(self, key: int | str | slice) -> "Recording | Recordings":
        if isinstance(key, slice):
            return Recordings.of(self.recordings[key])
        if isinstance(key, int):
            return self.recordings[key]
        if key not in self.names:
            raise problem(
                "Recordings",
                f"there is no recording {brief(key)}{near(key, self.names)}",
                f"choose from {brief(list(self.names))}",
            )
        return self.recordings[self.names.index(key)]

    def __repr__(self) -> str:
        return "Recordings(" + ", ".join(map(repr, self.recordings)) + ")"

    def _repr_html_(self) -> str:
        items = "".join(f"<li>{recording._repr_html_()}</li>" for recording in self.recordings)
        return f"<ol>{items}</ol>"


def build(source: str, name: str, picked: Picked, told: Description) -> Recording:
    """A recording from signals, after all checks.

    **Arguments:**

    - `source`: its name in messages, e.g. its path.
    - `name`: the recording's name.
    - `picked`: the signals, in the units of the file.
    - `told`: their units, and which of their faults to accept.

    **Raises:** `RecordingError` if they cannot be used.
    """
    signals = validate(
        source, picked.signals, picked.labels, told.units, told.scale, told.accept, picked.lines
    )
    joints = signals["q"].shape[1]
    step = quantum(signals["q"]) if picked.quantised else None
    if told.resolution is not None:
        step = numeric(source, "resolution", told.resolution)
        if step.shape not in ((), (1,), (joints,)) or not np.all((step > 0) & np.isfinite(step)):
            raise problem(
                source,
                f"resolution is {brief(told.resolution)}",
                f"give one positive step, or {joints}, in rad or m",
            )
        step = np.broadcast_to(step, (joints,)).copy()
    return Recording(**signals, resolution=step, name=name)


def _signals(recording: Recording) -> dict[str, Float64[np.ndarray, "..."]]:
    values = {signal: getattr(recording, signal) for signal in SIGNALS}
    return {signal: value for signal, value in values.items() if value is not None}


def _distinct(names: Sequence[str]) -> list[str]:
    taken, distinct = set(names), []
    for name in names:
        numbered = (f"{name}_{k}" for k in itertools.count(2))
        own = next(n for n in numbered if n not in taken) if name in distinct else name
        taken.add(own)
        distinct.append(own)
    return distinct


def _renamed(recording: Recording, name: str) -> Recording:
    if recording.name == name:
        return recording
    return Recording(**_signals(recording), resolution=recording.resolution, name=name)
