"""What a discovery was asked."""

from typing import Any

import equinox as eqx

from ..estimate import OEM
from ..recording import Recordings
from ..storage.classes import classes_of
from .verify import quiet


class Asked(eqx.Module):
    """What a discovery was asked."""

    recordings: Recordings
    held_out: Recordings | None
    method: OEM
    catalogue: tuple[Any, ...]
    significance: float
    worth: float
    most: int

    def plan(self) -> dict[str, Any]:
        """What the fits follow from, beside the starting model."""
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
        """The classes of effects that the catalogue names; what its functions make is not known."""
        given = {entry for entry in self.catalogue if isinstance(entry, type)}
        return given.union(*(classes_of(entry) for entry in self.catalogue))


def _entry(entry: Any) -> Any:
    """An entry of a catalogue as a plan names it: classes and functions by their names."""
    name = getattr(entry, "__qualname__", None)
    return entry if name is None else f"{entry.__module__}.{name}"
