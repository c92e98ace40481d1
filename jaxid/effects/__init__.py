"""Physical effects, one family per file, and the catalogue."""

from ._base import NOBODY as NOBODY
from ._base import AbstractEffect as AbstractEffect
from ._base import AbstractTransmission as AbstractTransmission
from ._base import Motion as Motion
from ._base import check_declared as check_declared
from ._base import on_joint as on_joint
from ._base import recording_label as recording_label
from ._base import smooth_sign as smooth_sign
from ._scene import Scene as Scene
from .cable import CableDrag as CableDrag
from .counterbalance import Counterbalance as Counterbalance
from .coupling import SharedShaft as SharedShaft
from .curve import Curve as Curve
from .disturbance import PeriodicDisturbance as PeriodicDisturbance
from .drive import ActuatorLag as ActuatorLag
from .drive import DriveGain as DriveGain
from .drive import TimeDelay as TimeDelay
from .drive import TorqueSaturation as TorqueSaturation
from .friction import AsymmetricFriction as AsymmetricFriction
from .friction import Coulomb as Coulomb
from .friction import QuadraticDrag as QuadraticDrag
from .friction import Stribeck as Stribeck
from .friction import Viscous as Viscous
from .friction_gear import GearFriction as GearFriction
from .friction_varying import Hysteresis as Hysteresis
from .friction_varying import LoadDependentFriction as LoadDependentFriction
from .friction_varying import LuGre as LuGre
from .friction_varying import PositionDependentFriction as PositionDependentFriction
from .friction_varying import ThermalDrift as ThermalDrift
from .inertia import Payload as Payload
from .inertia import RotorInertia as RotorInertia
from .motor import DCMotor as DCMotor
from .position import EndStop as EndStop
from .position import Gravity as Gravity
from .position import Spring as Spring
from .position import Tilt as Tilt
from .position import TorqueOffset as TorqueOffset
from .position import TorqueRipple as TorqueRipple
from .sensor import EncoderEccentricity as EncoderEccentricity
from .space import BaseTilt as BaseTilt
from .space import CarriedBody as CarriedBody
from .transmission import Backlash as Backlash
from .transmission import JointElasticity as JointElasticity

catalogue: tuple[type[AbstractEffect], ...] = (
    Stribeck,
    AsymmetricFriction,
    QuadraticDrag,
    LoadDependentFriction,
    PositionDependentFriction,
    Hysteresis,
    LuGre,
    JointElasticity,
    Backlash,
    TorqueRipple,
    TorqueOffset,
    DriveGain,
    ActuatorLag,
    TimeDelay,
    TorqueSaturation,
    Gravity,
    Tilt,
    BaseTilt,
    Spring,
    Counterbalance,
    CableDrag,
    Payload,
    CarriedBody,
    RotorInertia,
    SharedShaft,
    ThermalDrift,
    PeriodicDisturbance,
    EndStop,
    EncoderEccentricity,
)
