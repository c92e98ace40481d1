"""What recordings are like before any model: rates, gaps, ranges, quantisation, rests, repeats."""

import html
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from ..recording import Recording, Recordings
from .smoothing import even_times, signal_cutoff, smooth_motion

if TYPE_CHECKING:
    import pandas as pd

# Share of its highest speed below which a joint rests.
_REST = 0.01
# Share of it that a joint reaches in both directions where it turns.
_TURN = 0.1
# Correlation from which two references are one.
_SAME = 0.9999


class Inspection(eqx.Module):
    """What `inspect` found.

    - `signals`: one row for each recording: samples, rate in Hz, duration in s, jitter of its times
      and largest time between two, whether it has a reference and velocities, and the frequency up
      to which its motion is known.
    - `joints`: one row for each recording and joint: range of q, top speed, share of time at rest,
      how often it turns, torque, and the smallest step between two readings of q.
    - `repeats`: pairs of recordings whose references are the same.
    - `notes`: what to mend, or to know.
    """

    signals: "pd.DataFrame"
    joints: "pd.DataFrame"
    repeats: tuple[tuple[str, str], ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        import pandas as pd

        with pd.option_context("display.width", 80, "display.precision", 4):
            parts = [self.signals.to_string(), self.joints.to_string()]
        same = [f"{a} and {b} repeat one reference" for a, b in self.repeats]
        return "\n".join([*parts, *same, *self.notes])

    def _repr_html_(self) -> str:
        lines = [f"{a} and {b} repeat one reference" for a, b in self.repeats]
        said = "".join(f"<li>{html.escape(x)}</li>" for x in (*lines, *self.notes))
        return f"{self.signals.to_html()}{self.joints.to_html()}<ul>{said}</ul>"

    def to_dict(self) -> dict[str, Any]:
        """The same as plain JSON."""
        joints = self.joints.reset_index().to_dict("records")
        return {
            "recordings": self.signals.reset_index().to_dict("records"),
            "joints": joints,
            "repeats": [list(pair) for pair in self.repeats],
            "notes": list(self.notes),
        }


def inspect(recordings: Recording | Recordings | Iterable[Recording]) -> Inspection:
    """Describes recordings: what a user should see before a model is held against them.

    **Arguments:**

    - `recordings`: one or several of the same robot.
    """
    import pandas as pd

    recordings = Recordings.of(recordings)
    signals, joints = [], []
    for r in recordings:
        cutoff = signal_cutoff(r)
        signals.append(_times(r) | {"known Hz": cutoff})
        joints += _by_joint(r, cutoff)
    table = pd.DataFrame(joints).set_index(["recording", "joint"])
    return Inspection(
        pd.DataFrame(signals).set_index("recording"),
        table,
        repeated(recordings),
        tuple(_notes(recordings, table)),
    )


def _times(r: Recording) -> dict[str, Any]:
    steps = np.diff(r.time)
    return {
        "recording": r.name,
        "samples": r.samples,
        "Hz": r.rate,
        "s": r.duration,
        "jitter ms": 1e3 * float(np.quantile(np.abs(steps - r.period), 0.9)),
        "gap ms": 1e3 * float(steps.max()),
        "q_ref": r.q_ref is not None,
        "v": r.v is not None,
    }


def _by_joint(r: Recording, cutoff: float) -> list[dict[str, Any]]:
    smooth = smooth_motion(r, cutoff)
    speed = np.gradient(smooth, even_times(r), axis=0)
    top = np.maximum(np.abs(speed).max(axis=0), 1e-300)
    resting = np.abs(speed) < _REST * top
    rows = []
    for j in range(r.joints):
        moving = np.sign(speed[np.abs(speed[:, j]) > _TURN * top[j], j])
        moves = np.abs(np.diff(r.q[:, j]))
        rows.append(
            {
                "recording": r.name,
                "joint": j + 1,
                "from": r.q[:, j].min(),
                "to": r.q[:, j].max(),
                "speed": top[j],
                "rest %": 100 * float(np.mean(resting[:, j])),
                "turns": int(np.sum(moving[1:] != moving[:-1])),
                "tau rms": float(np.sqrt(np.mean(r.tau[:, j] ** 2))),
                "tau peak": float(np.abs(r.tau[:, j]).max()),
                "q step": float(np.min(moves[moves > 0], initial=np.inf)),
            }
        )
    return rows


def repeated(recordings: Recordings) -> tuple[tuple[str, str], ...]:
    """Names of recordings that follow the same reference, or the same motion where none is given.

    **Arguments:**

    - `recordings`: of one robot.
    """
    found = []
    for k, one in enumerate(recordings):
        for other in list(recordings)[k + 1 :]:
            pair = [x.q if x.q_ref is None else x.q_ref for x in (one, other)]
            length = min(len(x) for x in pair)
            if abs(one.period / other.period - 1) > 0.01 or length < 0.9 * max(map(len, pair)):
                continue
            a, b = (x[:length] - x[:length].mean(axis=0) for x in pair)
            size = np.linalg.norm(a) * np.linalg.norm(b)
            if size > 0 and float(np.sum(a * b)) > _SAME * size:
                found.append((one.name, other.name))
    return tuple(found)


def _notes(recordings: Recordings, joints: "pd.DataFrame") -> list[str]:
    notes = []
    if len({round(r.rate, 1) for r in recordings}) > 1:
        rates = ", ".join(f"{r.name} {r.rate:.4g} Hz" for r in recordings)
        notes.append(f"sample rates differ ({rates}): a discovery needs one rate")
    for j in range(1, recordings.joints + 1):
        rows = joints.xs(j, level="joint")
        if max(rows["turns"].tolist()) < 2:
            notes.append(
                f"joint {j} hardly reverses in any recording, so friction and offset cannot be "
                "told apart: record motions to and fro"
            )
        if min(rows["rest %"].tolist()) > 80:
            notes.append(
                f"joint {j} rests for most of every recording: its inertia and friction will be "
                "known badly"
            )
    if len(recordings) == 1:
        notes.append("one recording alone: record another to be held out of the fit")
    return notes
