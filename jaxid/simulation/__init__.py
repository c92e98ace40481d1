"""Closed loops, their integration, batches of recordings, and distribution over cores."""

from .integration import reason as reason
from .loop import ClosedLoop as ClosedLoop
from .runs import Simulated as Simulated
from .runs import simulate as simulate
from .stepping import RK4 as RK4
from .stepping import Stepping as Stepping
