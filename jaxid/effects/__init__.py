"""Physical effects, one family a file, and the catalogue."""

from ._base import AbstractEffect as AbstractEffect
from ._base import AbstractTransmission as AbstractTransmission
from ._base import Motion as Motion
from ._base import on_joint as on_joint
from ._base import smooth_sign as smooth_sign
from .friction import Coulomb as Coulomb
from .friction import Viscous as Viscous
from .offset import TorqueOffset as TorqueOffset
