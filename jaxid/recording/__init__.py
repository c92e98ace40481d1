"""Measured data and its checks: from a file, a table or arrays to SI float64."""

from ._read import Contents as Contents
from ._read import contents_of as contents_of
from ._read import read as read
from ._recording import Recording as Recording
from ._recording import Recordings as Recordings
from ._steps import is_decimal as is_decimal
from ._steps import step_of as step_of
from ._times import missing_after as missing_after
