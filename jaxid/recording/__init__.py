"""Measured data and its checks: from a file, a DataFrame or arrays to SI float64."""

from ._checks import missing_after as missing_after
from ._read import columns_of as columns_of
from ._read import read as read
from ._recording import Recording as Recording
from ._recording import Recordings as Recordings
