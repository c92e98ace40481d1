"""How a complaint about a recording is worded."""

from ..errors import RecordingError, sentence


def problem(source: str, what: str, remedy: str) -> RecordingError:
    """The error for one problem: a single printable sentence, whatever the file holds.

    **Arguments:**

    - `source`: the file, or the name of the recording.
    - `what`: what is wrong, and where.
    - `remedy`: what to do about it.
    """
    return RecordingError(sentence(source, what, remedy))
