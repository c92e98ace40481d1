"""Exceptions and warnings of jaxid; every message is one sentence that says what to do."""

import dataclasses
import difflib
import importlib
import reprlib
import textwrap
from collections.abc import Iterable
from types import ModuleType
from typing import Any, Literal, get_args, get_origin


class JaxidError(Exception):
    """Base class of the errors that jaxid raises."""


class RecordingError(JaxidError, ValueError):
    """A recording, or the file it comes from, cannot be used as it is."""


class ModelError(JaxidError, ValueError):
    """A model is inconsistent, or unsuitable for the task."""


class FitError(JaxidError, RuntimeError):
    """The data or the settings do not allow the requested estimate."""


class SaveError(JaxidError, ValueError):
    """A saved result, or a piece of a campaign, cannot be written or read."""


class MissingClassError(SaveError):
    """A saved result has an object of a class of the user's that was not given.

    `name` is the name of the class.
    """

    def __init__(self, message: str, name: str = ""):
        super().__init__(message)
        self.name = name


class NoiseError(FitError):
    """The residuals do not allow the requested noise filter.

    `fit` is the estimate up to that point, None if there is none.
    """

    def __init__(self, message: str, fit: Any = None):
        super().__init__(message)
        self.fit = fit


class LimitsError(JaxidError, ValueError):
    """Limits contradict each other, or allow no motion."""


class MissingExtraError(JaxidError, ImportError):
    """A package is needed that only an optional extra of jaxid installs."""


class JaxidWarning(UserWarning):
    """An input is probably, but not certainly, a mistake."""


def sentence(source: str, what: str, remedy: str) -> str:
    """One sentence about a file or recording, in which unprintable characters become spaces.

    **Arguments:**

    - `source`: the file, or the name of the recording.
    - `what`: what is wrong, and where.
    - `remedy`: what to do about it.
    """
    said = textwrap.shorten(_printable(f"{what}; {remedy}"), 320, placeholder=" ...")
    return f"{_printable(source)}: {said}."


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


def brief(value: object) -> str:
    """`repr`, short enough for a sentence."""
    short = reprlib.Repr()
    short.maxlist, short.maxstring, short.maxother = 8, 24, 40
    return short.repr(value)


def near(name: str, candidates: Iterable[str]) -> str:
    """` (did you mean 'x'?)` if a candidate is close to `name`, otherwise an empty string."""
    by_folded = {candidate.casefold(): candidate for candidate in candidates}
    close = difflib.get_close_matches(name.casefold(), list(by_folded), n=1, cutoff=0.7)
    return f" (did you mean {brief(by_folded[close[0]])}?)" if close else ""


def require(module: str, extra: str) -> ModuleType:
    """Imports a module that only an extra installs.

    **Arguments:**

    - `module`: dotted name of the module, e.g. `"pyarrow.parquet"`.
    - `extra`: the extra of `jaxid-robotics` that installs it.

    **Raises:** `MissingExtraError` that names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{module} cannot be imported ({error}): pip install 'jaxid-robotics[{extra}]'"
        ) from error


def check_words(settings: Any) -> None:
    """Checks that string values are listed in the `Literal` of their fields.

    **Arguments:**

    - `settings`: a dataclass.

    **Raises:** `FitError` that names the field and its allowed values.
    """
    for field in dataclasses.fields(settings):
        words, value = _words(field.type), getattr(settings, field.name)
        if words and isinstance(value, str) and value not in words:
            raise FitError(
                f"{field.name}={value!r} of {type(settings).__name__} is not one of "
                f"{', '.join(map(repr, words))}{near(value, words)}"
            )


def _words(annotation: Any) -> tuple[str, ...]:
    """The strings of a `Literal`, which may be a member of a union."""
    if get_origin(annotation) is Literal:
        return tuple(word for word in get_args(annotation) if isinstance(word, str))
    return tuple(word for part in get_args(annotation) for word in _words(part))
