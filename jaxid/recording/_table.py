"""Named columns of a file or a table in memory."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx

from ..errors import brief
from ._problem import problem

if TYPE_CHECKING:
    import pandas as pd


class Table(eqx.Module):
    """Named columns of one file, not yet checked.

    - `columns`: array-likes, or streams with their own times, by name.
    - `refused`: other contents of the file that cannot be columns, by name, and what they are.
    - `lines`: line numbers of the rows in a text file.
    - `defaults`: if joints have names, the column of each by signal and joint; in the order of the
      robot if `ordered`.
    - `unclear`: why a signal has no default columns although candidates exist.
    - `about`: further notes on the file, one per line.
    """

    columns: dict[str, object]
    refused: dict[str, str] = eqx.field(default_factory=dict)
    lines: tuple[int, ...] = ()
    defaults: dict[str, dict[str, str]] = eqx.field(default_factory=dict)
    ordered: bool = False
    unclear: dict[str, str] = eqx.field(default_factory=dict)
    about: tuple[str, ...] = ()


def from_frame(source: str, frame: "pd.DataFrame", lines: tuple[int, ...] = ()) -> Table:
    """The columns of a DataFrame, each named once."""
    named = isinstance(frame.index.name, str) and frame.index.name not in frame.columns
    # Times are often the index.
    frame = frame.reset_index() if named else frame
    names = [str(name).strip() for name in frame.columns]
    unique(source, names)
    return Table({name: frame.iloc[:, i] for i, name in enumerate(names)}, {}, lines)


def unique(source: str, names: Sequence[str]) -> None:
    """Raises `RecordingError` if a name that is not empty appears twice."""
    seen = set()
    for name in filter(None, names):
        if name in seen:
            raise problem(
                source, f"column {brief(name)} appears more than once", "rename or remove one"
            )
        seen.add(name)
