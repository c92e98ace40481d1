"""Conversion of tables in memory, from any library, to pandas."""

from typing import TYPE_CHECKING

from ..errors import brief, require
from ._problem import problem

if TYPE_CHECKING:
    import pandas as pd


def frame_of(source: str, table: object) -> "pd.DataFrame":
    """A DataFrame from a table that is one, or that Arrow can read.

    **Arguments:**

    - `source`: its name in messages.
    - `table`: a pandas DataFrame, an Arrow table, or another with `__arrow_c_stream__`.

    **Raises:** `RecordingError` if it is not a table; `MissingExtraError` without the extra
        `parquet` for a table that is not from pandas.
    """
    import pandas as pd

    if isinstance(table, pd.DataFrame):
        return table
    if not hasattr(table, "__arrow_c_stream__"):
        raise problem(
            source,
            f"{brief(table)} is not a table",
            "give a pandas DataFrame or an Arrow table, or use Recording.from_arrays",
        )
    arrow = require("pyarrow", "parquet")
    # The metadata of pandas could turn a column into an index, which would hide it.
    return arrow.table(table).to_pandas(ignore_metadata=True)
