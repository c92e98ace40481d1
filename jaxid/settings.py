"""Settings that are one of a few words."""

import dataclasses
from typing import Any, Literal, get_args, get_origin

from .errors import FitError
from .recording._problem import near


def check_words(settings: Any) -> None:
    """Refuses a word that is none of those which a field's `Literal` lists.

    **Arguments:**

    - `settings`: a dataclass.

    **Raises:** `FitError` that names the field and its words.
    """
    for field in dataclasses.fields(settings):
        words, value = _words(field.type), getattr(settings, field.name)
        if words and isinstance(value, str) and value not in words:
            raise FitError(
                f"{field.name}={value!r} of {type(settings).__name__} is none of "
                f"{', '.join(map(repr, words))}{near(value, words)}"
            )


def _words(annotation: Any) -> tuple[str, ...]:
    """The strings of a `Literal`, also of one among others in a union."""
    if get_origin(annotation) is Literal:
        return tuple(word for word in get_args(annotation) if isinstance(word, str))
    return tuple(word for part in get_args(annotation) for word in _words(part))
