"""Resampling of signals with different sample times to those of one of them."""

import warnings
from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float64, Int64

from ..errors import JaxidWarning
from ._problem import problem
from ._times import missing_after

# Time steps by which a message may arrive after one with a later stamp.
_LATE = 10


class Stream(eqx.Module):
    """One quantity of a joint with the stamps of its samples, ns, and the topic it comes from."""

    stamps: Int64[np.ndarray, " samples"]
    values: Float64[np.ndarray, " samples"]
    topic: str = ""


def aligned(
    source: str, columns: Mapping[str, object], labels: Mapping[str, Sequence[str]]
) -> dict[str, object]:
    """Columns with the signals' streams resampled to the times of the first position.

    Streams with other stamps are interpolated linearly, and are empty inside their gaps. Samples
    before the start or after the end of any stream are left out.

    **Arguments:**

    - `source`: name of the file in messages.
    - `columns`: arrays and streams by name.
    - `labels`: the columns of each signal; `"time"` is the time since the first position, s.

    **Raises:** `RecordingError` if streams have no time in common.
    """
    named = [factor.strip() for names in labels.values() for n in names for factor in n.split("*")]
    used = {n: x for n in named if isinstance(x := columns.get(n), Stream)}
    if not used:
        return dict(columns)
    first = next((n for n in labels["q"] if n in used), next(iter(used)))
    base = _in_order(source, used[first])
    streams = {name: _in_order(source, stream) for name, stream in used.items()}
    others = {n: s for n, s in streams.items() if not np.array_equal(s.stamps, base.stamps)}
    start = max(int(s.stamps.min()) for s in streams.values())
    stop = min(int(s.stamps.max()) for s in streams.values())
    kept = (
        (base.stamps >= start) & (base.stamps <= stop) if others else np.full(len(base.stamps), 1)
    )
    at = base.stamps[kept.astype(bool)]
    if len(at) < 2:
        raise problem(
            source,
            f"{base.topic} and {', '.join(sorted({s.topic for s in others.values()}))} have no "
            "times in common",
            "record them together, with stamps of one clock",
        )
    if others:
        _say(source, base, others)
    made = {
        n: _at(s, at) if n in others else s.values[kept.astype(bool)] for n, s in streams.items()
    }
    return {**columns, "time": (at - at[0]) / 1e9, **made}


def _in_order(source: str, stream: Stream) -> Stream:
    """The stream sorted by its stamps, if messages only arrived in another order."""
    steps = np.diff(stream.stamps)
    back = -int(steps.min(initial=0))
    # A clock that was set back is a different fault, which the checks of times report.
    if back <= 0 or back > _LATE * np.median(np.abs(steps)):
        return stream
    order = np.argsort(stream.stamps, kind="stable")
    return Stream(stream.stamps[order], stream.values[order], stream.topic)


def _at(stream: Stream, at: Int64[np.ndarray, " times"]) -> Float64[np.ndarray, " times"]:
    """Values at other stamps, NaN inside gaps of the stream."""
    # Differences of integers, since a current stamp in ns has more digits than a float.
    own, wanted = ((x - stream.stamps[0]).astype(np.float64) for x in (stream.stamps, at))
    values = np.interp(wanted, own, stream.values)
    if len(own) > 2:
        before = np.clip(np.searchsorted(own, wanted) - 1, 0, len(own) - 2)
        inside = (wanted > own[before]) & (wanted < own[before + 1])
        values[missing_after(own)[before] & inside] = np.nan
    return values


def _say(source: str, base: Stream, others: Mapping[str, Stream]) -> None:
    def rate(stream: Stream) -> str:
        return f"{stream.topic} ({1e9 / max(float(np.median(np.diff(stream.stamps))), 1):.4g} Hz)"

    there = sorted({rate(stream) for stream in others.values()})
    warnings.warn(
        f"{source}: {', '.join(there)} has other stamps than {rate(base)} and is interpolated at "
        "its times; record both at one rate if they must be aligned to the sample.",
        JaxidWarning,
        stacklevel=7,
    )
