"""Messages about recordings."""

from collections.abc import Mapping, Sequence

from ..errors import RecordingError, sentence

Labels = Mapping[str, Sequence[str]]
Lines = Sequence[int]


def problem(source: str, what: str, remedy: str) -> RecordingError:
    """The error for one problem: one printable sentence, whatever the file contains.

    **Arguments:**

    - `source`: the file, or the name of the recording.
    - `what`: what is wrong, and where.
    - `remedy`: what to do about it.
    """
    return RecordingError(sentence(source, what, remedy))


def place(row: int, lines: Lines) -> str:
    """The place of a row, counted from 0: its line in the file, or its index in an array."""
    return f"line {lines[row]}" if lines else f"row {row + 1}"


def label(labels: Labels, signal: str, joint: int, joints: int) -> str:
    """The name of a joint's column in the file, or one made of the signal's."""
    names = labels.get(signal, ())
    if len(names) == joints:
        return names[joint]
    return f"{names[0] if names else signal}_{joint + 1}"
