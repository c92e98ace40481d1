"""Messages about recordings."""

from ..errors import RecordingError, sentence


def problem(source: str, what: str, remedy: str) -> RecordingError:
    """The error for one problem: one printable sentence, whatever the file contains.

    **Arguments:**

    - `source`: the file, or the name of the recording.
    - `what`: what is wrong, and where.
    - `remedy`: what to do about it.
    """
    return RecordingError(sentence(source, what, remedy))
