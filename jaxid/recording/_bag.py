"""ROS 2 bags: messages about joints, as streams by topic, field and joint."""

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from ..errors import JaxidWarning, require
from ._messages import Kind, kinds
from ._problem import problem
from ._streams import Stream
from ._table import Table


class _Topic(eqx.Module):
    """Messages of one topic in order of arrival: stamp, and joint names and values by field."""

    kind: Kind = eqx.field(static=True)
    stamps: list[int] = eqx.field(default_factory=list)
    received: list[int] = eqx.field(default_factory=list)
    fields: list[dict[str, tuple[tuple[str, ...], np.ndarray]]] = eqx.field(default_factory=list)


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 2 bag: its folder, or one of its files."""
    if path.is_dir():
        return any(f.name == "metadata.yaml" or _is_storage(f) for f in path.iterdir())
    return _is_storage(path)


def _is_storage(path: Path) -> bool:
    return path.suffix.lower() in (".db3", ".mcap")


def bag_table(source: str, path: Path, largest: int, refuse: Callable[[int], Exception]) -> Table:
    """Streams of every joint in a bag, with those that are the signals by default.

    **Arguments:**

    - `largest`: most bytes of joint messages to read; `refuse` makes the error for more.

    **Raises:** `RecordingError` for a bag without such messages, or with contradictory ones;
        `MissingExtraError` without the extra `ros`.
    """
    reader = require("rosbags.rosbag2", "ros").Reader
    if path.is_dir() and not (path / "metadata.yaml").exists():
        files = [f for f in path.iterdir() if _is_storage(f)]
        if len(files) > 1:
            raise problem(
                source,
                f"has {len(files)} bag files and no metadata.yaml",
                "run ros2 bag reindex on the folder, or name one of the files",
            )
        path = files[0]
    with reader(path) as bag:
        topics = _messages(source, bag, largest, refuse)
        others = {c.topic: c.msgtype for c in bag.connections if c.topic not in topics}
    topics = {name: topic for name, topic in topics.items() if topic.fields}
    if not topics:
        listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(others.items()))
        raise problem(
            source,
            f"no topic has messages about joints, there are {listed or 'no topics'}",
            "record sensor_msgs/msg/JointState, for example /joint_states",
        )
    columns: dict[str, Stream] = {}
    about = []
    for name, topic in sorted(topics.items()):
        streams = _streams(source, name, topic)
        columns |= streams
        about.append(_about(name, topic, streams))
    about += [f"{name}: {kind}, not read" for name, kind in sorted(others.items())]
    defaults, unclear = _defaults(topics, columns)
    return Table(dict(columns), defaults=defaults, unclear=unclear, about=tuple(about))


def _messages(
    source: str, bag: Any, largest: int, refuse: Callable[[int], Exception]
) -> dict[str, _Topic]:
    known = kinds()
    wanted = [c for c in bag.connections if c.msgtype in known]
    topics = {c.topic: _Topic(known[c.msgtype]) for c in wanted}
    readable = _typestore(source, wanted)
    size = 0
    # Without connections a reader returns the messages of all connections.
    for connection, received, data in bag.messages(wanted) if wanted else ():
        size += len(data)
        if size > largest:
            raise refuse(size)
        topic = topics[connection.topic]
        try:
            message = readable(data, connection.msgtype)
            header = getattr(message, "header", None)
            stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
            topic.fields.append(_fields(topic.kind, message))
        except Exception as error:  # a damaged message may raise any exception
            raise problem(
                source,
                f"message {len(topic.stamps) + 1} of {connection.topic} cannot be read "
                f"({type(error).__name__}: {error})",
                "record it again, or convert the bag with ros2 bag convert",
            ) from error
        topic.stamps.append(stamp)
        topic.received.append(received)
    return topics


def _typestore(source: str, connections: list[Any]) -> Callable[[bytes, str], Any]:
    """The deserialiser of messages, by the definitions in the bag or those of ROS."""
    typesys = require("rosbags.typesys", "ros")
    formats = require("rosbags.interfaces", "ros").MessageDefinitionFormat
    common = typesys.get_typestore(typesys.Stores.LATEST)
    stores = {}
    for kind in {c.msgtype for c in connections}:
        own = next(
            (
                c.msgdef
                for c in connections
                if c.msgtype == kind and c.msgdef.format != formats.NONE
            ),
            None,
        )
        if own is not None and own.format == formats.MSG:
            stores[kind] = typesys.get_typestore(typesys.Stores.EMPTY)
            stores[kind].register(typesys.get_types_from_msg(own.data, kind))
        elif kind in common.fielddefs:
            stores[kind] = common
        else:
            raise problem(
                source,
                f"the bag has messages of {kind} and does not define them",
                "record with ROS 2 Iron or later or as MCAP, or leave that topic out",
            )
    return lambda data, kind: stores[kind].deserialize_cdr(data, kind)


def _fields(kind: Kind, message: Any) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    found = {}
    for field, names, values in kind.fields(message):
        values = np.asarray(values, dtype=np.float64)
        if len(values) not in (0, len(names)):
            raise ValueError(f"{field} has {len(values)} values for {len(names)} joints")
        if len(set(names)) < len(names):
            raise ValueError("a joint is named twice")
        if len(values):
            found[field] = (tuple(names), values)
    return found


def _streams(source: str, name: str, topic: _Topic) -> dict[str, Stream]:
    stamps = _stamps(source, name, topic)
    once = _once(source, name, topic, stamps)
    rows: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for row in once:
        for field, (names, _) in topic.fields[row].items():
            rows.setdefault((field, names), []).append(row)
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for (field, names), chosen in rows.items():
        values = np.array([topic.fields[row][field][1] for row in chosen])
        for joint, column in zip(names, values.T, strict=True):
            parts.setdefault(f"{name}/{field}/{joint}", []).append((np.array(chosen), column))
    streams = {}
    for column, several in parts.items():
        # Messages with other joint orders came between these.
        order = np.concatenate([chosen for chosen, _ in several])
        values = np.concatenate([value for _, value in several])
        sort = np.argsort(order, kind="stable")
        streams[column] = Stream(stamps[order[sort]], values[sort], name)
    return streams


def _stamps(source: str, name: str, topic: _Topic) -> np.ndarray:
    stamps = np.array(topic.stamps, dtype=np.int64)
    blank = int((stamps == 0).sum())
    if not blank:
        return stamps
    warnings.warn(
        f"{source}: {blank} of {len(stamps)} messages of {name} have no stamp in their header, so "
        "the times at which the bag received them are used, which jitter and are late; set the "
        "stamps where messages are sampled.",
        JaxidWarning,
        stacklevel=8,
    )
    return np.array(topic.received, dtype=np.int64)


def _once(source: str, name: str, topic: _Topic, stamps: np.ndarray) -> list[int]:
    """Rows of the messages without duplicates."""
    seen: dict[int, int] = {}
    once = []
    for row, stamp in enumerate(stamps.tolist()):
        if stamp in seen and _same(topic.fields[seen[stamp]], topic.fields[row]):
            continue
        seen[stamp] = row
        once.append(row)
    if len(once) < len(stamps):
        warnings.warn(
            f"{source}: {len(stamps) - len(once)} of {len(stamps)} messages of {name} repeat "
            "another one, stamp included, and are left out; two recorders or publishers may have "
            "run.",
            JaxidWarning,
            stacklevel=8,
        )
    return once


def _same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        one[f][0] == other[f][0] and np.array_equal(one[f][1], other[f][1], equal_nan=True)
        for f in one
    )


def _about(name: str, topic: _Topic, streams: dict[str, Stream]) -> str:
    kind = next(kind for kind, known in kinds().items() if known.fields is topic.kind.fields)
    first = next(iter(streams.values()), None)
    if first is None:
        return f"{name}: {kind}, {len(topic.stamps)} messages without values"
    parts = [column.removeprefix(f"{name}/").rpartition("/") for column in streams]
    fields, joints = (list(dict.fromkeys(p[k] for p in parts)) for k in (0, 2))
    steps = np.diff(first.stamps)
    rate = f", {1e9 / max(float(np.median(steps)), 1.0):.4g} Hz" if len(steps) else ""
    return (
        f"{name}: {kind}, {len(topic.stamps)} messages{rate}, joints {', '.join(joints)}; "
        f"{', '.join(fields)}"
    )


def _defaults(
    topics: dict[str, _Topic], columns: dict[str, Stream]
) -> tuple[dict[str, dict[str, str]], dict[str, str]]:
    """Columns by signal and joint, and notes on signals that several topics could supply."""
    defaults, unclear = {}, {}
    for signal in ("q", "tau", "q_ref", "v"):
        found: dict[str, str] = {}
        for name, by_joint in _offers(signal, topics, columns):
            twice = sorted(found.keys() & by_joint)
            if twice:
                rival = found[twice[0]].removesuffix(f"/{twice[0]}")
                unclear[signal] = f"both {rival} and {name} have joint {twice[0]}"
                found = {}
                break
            found |= by_joint
        if found:
            defaults[signal] = found
    return defaults, unclear


def _offers(
    signal: str, topics: dict[str, _Topic], columns: dict[str, Stream]
) -> Iterator[tuple[str, dict[str, str]]]:
    """Topics that offer a signal, of the first kind that has any, with columns by joint."""
    for kind in kinds().values():
        offered = []
        for name in sorted(n for n, topic in topics.items() if topic.kind.fields is kind.fields):
            for field in kind.roles.get(signal, ()):
                stem = f"{name}/{field}/"
                there = {c.removeprefix(stem): c for c in columns if c.startswith(stem)}
                if there:
                    offered.append((f"{name}/{field}", there))
                    break
        if offered:
            yield from offered
            return


def bag_name(path: str | os.PathLike[str]) -> str:
    """Name of a recording from a bag: that of the folder or the file, without extension."""
    given = Path(path)
    return given.name if given.is_dir() else given.stem
