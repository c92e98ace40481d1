"""Controllers, which act on the readings of the sensors."""

from ._base import AbstractController as AbstractController
from ._base import Reading as Reading
from ._base import Reference as Reference
from ._base import Signals as Signals
from .cascade import Cascade as Cascade
from .certificate import Certificate as Certificate
from .certificate import MassError as MassError
from .certificate import certify as certify
from .certificate import holds as holds
from .certificate import mass_error as mass_error
from .computed_torque import ComputedTorque as ComputedTorque
from .impedance import Impedance as Impedance
from .open_loop import OpenLoop as OpenLoop
from .pd import PD as PD
from .pid import PID as PID
from .sampled import Sampled as Sampled
from .servo import Servo as Servo
from .tracking import Tracking as Tracking
