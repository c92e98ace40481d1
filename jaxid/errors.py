"""What jaxid raises and warns with: every message is one sentence that says what to do."""

import importlib
import textwrap
from types import ModuleType
from typing import Any


class JaxidError(Exception):
    """Anything jaxid raises on purpose."""


class RecordingError(JaxidError, ValueError):
    """A recording, or the file it comes from, cannot be used as it is."""


class ModelError(JaxidError, ValueError):
    """A model is put together in a way that has no meaning."""


class FitError(JaxidError, RuntimeError):
    """An estimate was asked for that the data or the settings do not allow."""


class SaveError(JaxidError, ValueError):
    """A saved result, or a piece of a campaign, cannot be written or read."""


class NoiseError(FitError):
    """A noise filter was asked for that the residuals do not allow.

    `fit` is what had been estimated by then, None where nothing had.
    """

    def __init__(self, message: str, fit: Any = None):
        super().__init__(message)
        self.fit = fit


class LimitsError(JaxidError, ValueError):
    """Limits contradict each other, or leave no room for any motion."""


class MissingExtraError(JaxidError, ImportError):
    """A package is needed that only an optional extra of jaxid installs."""


class JaxidWarning(UserWarning):
    """Something is likely, not surely, a mistake."""


def sentence(source: str, what: str, remedy: str) -> str:
    """One printable sentence about a file or recording, whatever it holds.

    **Arguments:**

    - `source`: the file, or the name of the recording.
    - `what`: what is wrong, and where.
    - `remedy`: what to do about it.
    """
    said = textwrap.shorten(_printable(f"{what}; {remedy}"), 320, placeholder=" ...")
    return f"{_printable(source)}: {said}."


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)


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
