"""The arguments of a discovery."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx

from ..errors import RecordingError
from ..estimate import OEM
from ..recording import Recording, Recordings
from ..storage.classes import classes_of
from .verify import quiet


class Asked(eqx.Module):
    """The arguments of a discovery."""

    recordings: Recordings
    held_out: Recordings | None
    method: OEM
    catalogue: tuple[Any, ...]
    significance: float
    worth: float
    most: int

    def plan(self) -> dict[str, Any]:
        """Everything that determines the fits, except the starting model."""
        return {
            "recordings": self.recordings,
            "validate": self.held_out,
            "catalogue": [_entry(entry) for entry in self.catalogue],
            "method": quiet(self.method),
            "significance": self.significance,
            "worth": self.worth,
            "most": self.most,
        }

    def classes(self) -> set[type]:
        """Classes of effects in the catalogue; those that its functions create are not known."""
        given = {entry for entry in self.catalogue if isinstance(entry, type)}
        return given.union(*(classes_of(entry) for entry in self.catalogue))


def _entry(entry: Any) -> Any:
    """A catalogue entry as written in a plan: classes and functions by their names."""
    name = getattr(entry, "__qualname__", None)
    return entry if name is None else f"{entry.__module__}.{name}"


def check_apart(recordings: Recordings, held_out: Iterable[Recording]) -> None:
    """Raises `RecordingError` if a held-out recording was also fitted, under any name."""
    for unseen in held_out:
        for fitted in recordings:
            if unseen.same_samples(fitted):
                raise RecordingError(
                    f"{unseen.name} is held out and has the samples of {fitted.name}, which is "
                    "fitted: a model must be tested on recordings to which it was not fitted"
                )
