"""Properties of recordings without a model: rates, gaps, ranges, resolution, rests, repeats."""

import html
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from ..recording import Recording, Recordings, is_decimal, missing_after, step_of
from .sampling import follows, held, is_followed, period
from .smoothing import even_times, resampled, signal_cutoff, smooth_motion

if TYPE_CHECKING:
    import pandas as pd

# A joint rests below this share of its highest speed.
_REST = 0.01
# A reversal counts if the joint reaches this share in both directions.
_TURN = 0.1
# Two references of equal amplitude count as the same above this correlation.
_SAME = 0.9999


class Inspection(eqx.Module):
    """Result of `inspect`.

    - `signals`: one row for each recording: samples, rate in Hz, duration in s, jitter of times,
      largest time between two samples and number of gaps, whether it has a reference and
      velocities, the period of the reference, and the frequency up to which the motion is known.
    - `joints`: one row for each recording and joint: range of q, top speed, share of time at rest,
      number of reversals, torque, the resolution of q (zero if not detected), and the sampled law:
      `"every 4"` if torque is constant for that many samples, `"each"` if it follows the readings
      sample by sample, `"-"` if none is detected.
    - `repeats`: pairs of recordings whose references are the same.
    - `notes`: problems to correct, and hints.
    """

    signals: "pd.DataFrame"
    joints: "pd.DataFrame"
    repeats: tuple[tuple[str, str], ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        parts = [
            table.to_string(float_format="{:.4g}".format) for table in (self.signals, self.joints)
        ]
        same = [f"{a} and {b} repeat one reference" for a, b in self.repeats]
        return "\n".join([*parts, *same, *self.notes])

    def _repr_html_(self) -> str:
        lines = [f"{a} and {b} repeat one reference" for a, b in self.repeats]
        said = "".join(f"<li>{html.escape(x)}</li>" for x in (*lines, *self.notes))
        return f"{self.signals.to_html()}{self.joints.to_html()}<ul>{said}</ul>"

    def to_dict(self) -> dict[str, Any]:
        """The content as plain JSON."""
        joints = self.joints.reset_index().to_dict("records")
        return {
            "recordings": self.signals.reset_index().to_dict("records"),
            "joints": joints,
            "repeats": [list(pair) for pair in self.repeats],
            "notes": list(self.notes),
        }


def inspect(recordings: Recording | Recordings | Iterable[Recording]) -> Inspection:
    """Describes recordings before they are compared with a model.

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
        repeats_of(recordings),
        tuple(_notes(recordings, table)),
    )


def _times(r: Recording) -> dict[str, Any]:
    steps = np.diff(r.time)
    return {
        "recording": r.name,
        "samples": r.samples,
        "Hz": r.rate,
        "s": r.duration,
        # Rounding errors of times are no jitter.
        "jitter ms": round(1e3 * float(np.quantile(np.abs(steps - r.period), 0.9)), 9),
        "gap ms": 1e3 * float(steps.max()),
        "gaps": int(missing_after(r.time).sum()),
        "q_ref": r.q_ref is not None,
        "v": r.v is not None,
        "repeats s": _period(r),
    }


def _period(r: Recording) -> float:
    """Period of the reference, or of the motion without one, s; zero if it does not repeat."""
    x = resampled(r.time, r.q if r.q_ref is None else r.q_ref, even_times(r))
    found = period(x)
    return 0.0 if found is None else found * r.duration / (r.samples - 1)


def _law(r: Recording, joint: int) -> str:
    """The sampled law that is detected in the torque of a joint."""
    # At a gap, position and torque jump together.
    edges = [0, *(np.flatnonzero(missing_after(r.time)) + 1).tolist(), r.samples]
    whole = max(itertools.pairwise(edges), key=lambda piece: piece[1] - piece[0])
    tau, q = r.tau[slice(*whole), joint], r.q[slice(*whole), joint]
    if (samples := held(tau)) > 1:
        return f"every {samples}"
    # The reference adds no information to that of the encoder.
    return "each" if is_followed(follows(q, tau)) else "-"


def _by_joint(r: Recording, cutoff: float) -> list[dict[str, Any]]:
    smooth = smooth_motion(r, cutoff)
    speed = np.gradient(smooth, even_times(r), axis=0)
    top = np.maximum(np.abs(speed).max(axis=0), 1e-300)
    resting = np.abs(speed) < _REST * top
    rows = []
    for j in range(r.joints):
        moving = np.sign(speed[np.abs(speed[:, j]) > _TURN * top[j], j])
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
                "q step": step_of(r.q[:, j]) or 0.0,
                "law": _law(r, j),
            }
        )
    return rows


def repeats_of(recordings: Recordings) -> tuple[tuple[str, str], ...]:
    """Names of recordings with the same reference, or with the same motion if they have none.

    **Arguments:**

    - `recordings`: of one robot.
    """
    return tuple(
        (one.name, other.name)
        for one, other in itertools.combinations(recordings, 2)
        if _repeat(one, other)
    )


def _repeat(one: Recording, other: Recording) -> bool:
    """Whether two recordings have the same reference (or motion), by time or from its start."""
    x, y = (r.q if r.q_ref is None else r.q_ref for r in (one, other))
    for start in (0.0, one.time[0]):
        s, t = one.time - start, other.time - (start and other.time[0])
        # The sample times of the two differ, but a reference changes little between two samples.
        both = (s >= t[0]) & (s <= t[-1])
        if both.mean() < 0.9 or t[-1] - t[0] > 1.1 * (s[-1] - s[0]):
            continue
        a = x[both] - x[both].mean(axis=0)
        b = np.column_stack([np.interp(s[both], t, column) for column in y.T])
        b -= b.mean(axis=0)
        size = np.linalg.norm(a) * np.linalg.norm(b)
        if size > 0 and float(np.sum((a - b) ** 2)) < 2 * (1 - _SAME) * size:
            return True
    return False


def _notes(recordings: Recordings, joints: "pd.DataFrame") -> list[str]:
    notes = []
    slow, fast = (choose(recordings, key=lambda r: r.rate) for choose in (min, max))
    if fast.rate > 1.01 * slow.rate:
        notes.append(
            f"sample rates differ, from {slow.rate:.4g} Hz ({slow.name}) to {fast.rate:.4g} Hz "
            f"({fast.name}): a discovery needs one rate"
        )
    for j in range(1, recordings.joints + 1):
        rows = joints.xs(j, level="joint")
        if max(rows["turns"].tolist()) < 2:
            notes.append(
                f"joint {j} rarely reverses in any recording, so friction and offset cannot be "
                "separated: record motions in both directions"
            )
        if min(rows["rest %"].tolist()) > 80:
            notes.append(
                f"joint {j} rests for most of every recording: its inertia and friction will be "
                "uncertain"
            )
    notes += [note for r in recordings for note in _notes_on_times(r)]
    notes += _notes_on_clocks(recordings, joints)
    if len(recordings) == 1:
        notes.append("there is only one recording: record another one to be held out of the fit")
    return notes


def _notes_on_times(r: Recording) -> list[str]:
    """Gaps of a recording, and its reference if that repeats or has its own clock."""
    notes = []
    gaps = np.flatnonzero(missing_after(r.time))
    if len(gaps):
        longest = gaps[np.argmax(np.diff(r.time)[gaps])]
        notes.append(
            f"{r.name} has {len(gaps)} gap{'s' * (len(gaps) > 1)}, the longest of "
            f"{r.time[longest + 1] - r.time[longest]:.4g} s after {r.time[longest]:.6g} s: "
            "commands need --gaps allow"
        )
    if every := _period(r):
        what = "motion" if r.q_ref is None else "reference"
        notes.append(
            f"the {what} of {r.name} repeats every {every:.4g} s, {r.duration / every:.3g} times: "
            "differences between periods are noise, or changes with time"
        )
    if r.q_ref is not None:
        samples = max(held(column) for column in r.q_ref.T)
        if samples > 1:
            notes.append(
                f"the reference of {r.name} is held for {samples} samples "
                f"({1e3 * samples * r.period:.4g} ms): its clock differs from that of the log"
            )
    return notes


def _notes_on_clocks(recordings: Recordings, joints: "pd.DataFrame") -> list[str]:
    """Encoder steps and the law's clock, each noted once for all recordings that agree."""
    notes = []
    smallest: dict[str, list[int]] = {}
    for j in range(1, recordings.joints + 1):
        rows = joints.xs(j, level="joint")
        steps = [float(x) for x in rows["q step"].tolist() if x > 0]
        if steps:
            origin = "digits of the file" if is_decimal(min(steps)) else "encoder counts"
            smallest.setdefault(f"{min(steps):.4g}, {origin}", []).append(j)
    for step, numbers in smallest.items():
        notes.append(f"{_listed(numbers)} {_are(numbers)} read in steps of {step}")
    for law, numbers in sorted(_joints_by_law(joints).items()):
        if law == "each":
            notes.append(
                f"the torque of {_listed(numbers)} is computed from the recorded readings, as "
                "coherence shows: a law sampled at the log's rate or above, such as control.Sampled"
            )
        else:
            samples = int(law.removeprefix("every "))
            every = samples * recordings[0].period
            notes.append(
                f"the torque of {_listed(numbers)} is held for {samples} samples: a law sampled "
                f"every {1e3 * every:.4g} ms, such as control.Sampled(every={every:.4g})"
            )
    return notes


def _listed(numbers: list[int]) -> str:
    """Joints by number."""
    return f"joint{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"


def _are(numbers: list[int]) -> str:
    return "are" if len(numbers) > 1 else "is"


def _joints_by_law(joints: "pd.DataFrame") -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for law, joint in zip(joints["law"], joints.index.get_level_values("joint"), strict=True):
        listed = found.setdefault(str(law), [])
        if joint not in listed:
            listed.append(int(joint))
    found.pop("-", None)
    return found
