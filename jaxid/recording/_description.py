"""Description of recordings by the user: columns, units, and faults to accept."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np

from ._checks import Accept
from ._units import Units

Columns = Mapping[str, str | Sequence[str]]
Scale = Mapping[str, float | int | Sequence[float]]
Resolution = float | int | Sequence[float] | np.ndarray


class Description(eqx.Module):
    """The arguments of `jaxid.read` that describe the contents of a file.

    - `columns`: maps our names to theirs.
    - `joints`: names of joints in the order of the robot, if columns are named by them.
    - `units`, `scale`: unit and factor by signal.
    - `resolution`: encoder step, rad or m.
    - `accept`: which faults to accept.
    """

    columns: Columns | None = None
    joints: Sequence[str] | None = None
    units: Units | None = None
    scale: Scale | None = None
    resolution: Resolution | None = None
    accept: Accept = Accept()
