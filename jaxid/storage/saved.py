"""Saved results read back: `jaxid.load`."""

import enum
import importlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx

from ..errors import SaveError, sentence
from . import archive
from .classes import registered
from .files import write_whole

# Larger than the result of a day of recordings, and small enough to be read on a laptop.
LARGEST = 4 * 2**30


def save(result: eqx.Module, path: str | os.PathLike[str]) -> Path:
    """Writes a result to one file, atomically.

    **Arguments:**

    - `result`: a fit, comparison, diagnosis, discovery or loop.
    - `path`: by convention with the ending `.jaxid`; an existing file is replaced.

    **Returns:** the path.

    **Raises:** `SaveError` if it cannot be written.
    """
    return write_whole(path, archive.pack(result))


def load(
    path: str | os.PathLike[str], classes: Iterable[type] = (), *, largest: int = LARGEST
) -> Any:
    """Reads what `save` wrote: the same result, whose methods work as before.

    Nothing in the file is executed. Only jaxid's own classes and those given are accepted.

    **Arguments:**

    - `path`: the file.
    - `classes`: your own arms, effects, controllers or methods that the result contains.
    - `largest`: size in bytes above which a file is refused; about three times that much memory
      is used.

    **Raises:** `SaveError` for a file that is truncated, edited, too large or of a later version,
    or of a class that was not given.
    """
    source = str(path)
    try:
        size = os.path.getsize(path)
        if size > largest:
            raise SaveError(
                sentence(
                    source,
                    f"has {size} bytes, more than the limit of {largest}",
                    f"pass largest={size} if you trust it",
                )
            )
        # One byte more than the size detects a growing file or an endless device.
        with open(path, "rb") as file:
            content = file.read(size + 1)
    except (OSError, ValueError, MemoryError) as error:
        raise SaveError(
            sentence(source, f"cannot be opened ({error})", "check the path and permissions")
        ) from error
    if len(content) != size:
        raise SaveError(
            sentence(source, "is not a plain file, or is being written", "give a saved result")
        )
    return archive.unpack(content, source, registry(classes))


def registry(classes: Iterable[type] = ()) -> dict[tuple[str, str], type]:
    """The classes that a file may contain: jaxid's own, diffrax's steps, and those given."""
    # `import jaxid` imports these modules lazily, and only imported classes are found below.
    for room in ("discovery", "excitation"):
        importlib.import_module(f"jaxid.{room}")
    loaded = _below(eqx.Module) | _below(enum.Enum)
    ours = {c for c in loaded if c.__module__.startswith("jaxid.")}
    bases = (diffrax.AbstractSolver, diffrax.AbstractStepSizeController, diffrax.AbstractAdjoint)
    theirs = {c for c in vars(diffrax).values() if isinstance(c, type) and issubclass(c, bases)}
    return registered([*ours, *theirs, *classes])


def _below(cls: type) -> set[type]:
    """All imported subclasses."""
    found: set[type] = set()
    waiting = [cls]
    while waiting:
        below = set(waiting.pop().__subclasses__()) - found
        found |= below
        waiting += below
    return found
