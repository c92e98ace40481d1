"""How a complaint about a recording is worded."""

import difflib
import reprlib
from collections.abc import Iterable

from ..errors import RecordingError, sentence


def problem(source: str, what: str, remedy: str) -> RecordingError:
    """The error for one problem: a single printable sentence, whatever the file holds.

    **Arguments:**

    - `source`: the file, or the name of the recording.
    - `what`: what is wrong, and where.
    - `remedy`: what to do about it.
    """
    return RecordingError(sentence(source, what, remedy))


def brief(value: object) -> str:
    """`repr`, short enough for a sentence."""
    short = reprlib.Repr()
    short.maxlist, short.maxstring, short.maxother = 8, 24, 40
    return short.repr(value)


def near(name: str, candidates: Iterable[str]) -> str:
    """` (did you mean 'x'?)` when a candidate comes close to `name`, else nothing."""
    by_folded = {candidate.casefold(): candidate for candidate in candidates}
    close = difflib.get_close_matches(name.casefold(), list(by_folded), n=1, cutoff=0.7)
    return f" (did you mean {brief(by_folded[close[0]])}?)" if close else ""
