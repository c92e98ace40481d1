"""Rigid bodies: equations of motion, one arm per file."""

from ..chain import BODY as BODY
from ..chain import Chain as Chain
from ._base import AbstractArm as AbstractArm
from ._base import Split as Split
from ._serial import AbstractSerialArm as AbstractSerialArm
from .axis import Axis as Axis
from .log_cholesky import PhysicalArm as PhysicalArm
from .log_cholesky import in_base_parameters as in_base_parameters
from .physical import PhysicalBodies as PhysicalBodies
from .physical import physical_bodies as physical_bodies
from .scara import SCARA as SCARA
from .serial import SerialArm as SerialArm
from .two_link import TwoLink as TwoLink
from .uncertain import drawn_covariance as drawn_covariance
