"""Physical effects with their physics written out; joints count from 1; zero amplitude is absence.

Sign convention: torques returned here are needed from the drive, as friction is.
`place` says where an effect acts; `amplitudes` which fields make it large or small.
"""

from .drive_effects import ActuatorLag as ActuatorLag
from .drive_effects import Backlash as Backlash
from .drive_effects import DriveGain as DriveGain
from .drive_effects import EncoderEccentricity as EncoderEccentricity
from .drive_effects import JointElasticity as JointElasticity
from .drive_effects import TimeDelay as TimeDelay
from .drive_effects import TorqueSaturation as TorqueSaturation
from .effect import Effect as Effect
from .link_effects import AccelerationSquare as AccelerationSquare
from .link_effects import CrossBump as CrossBump
from .link_effects import CrossCoupling as CrossCoupling
from .link_effects import CubicDeadSpring as CubicDeadSpring
from .link_effects import EndStop as EndStop
from .link_effects import Gravity as Gravity
from .link_effects import Payload as Payload
from .link_effects import PeriodicDisturbance as PeriodicDisturbance
from .link_effects import RotorInertia as RotorInertia
from .link_effects import Spring as Spring
from .link_effects import TorqueBump as TorqueBump
from .motor_effects import AsymmetricFriction as AsymmetricFriction
from .motor_effects import Dahl as Dahl
from .motor_effects import FrictionStep as FrictionStep
from .motor_effects import LoadDependentFriction as LoadDependentFriction
from .motor_effects import LuGre as LuGre
from .motor_effects import PositionDependentFriction as PositionDependentFriction
from .motor_effects import QuadraticDrag as QuadraticDrag
from .motor_effects import Stribeck as Stribeck
from .motor_effects import ThermalDrift as ThermalDrift
from .motor_effects import TorqueOffset as TorqueOffset
from .motor_effects import TorqueRipple as TorqueRipple
from .motor_effects import VelocityBump as VelocityBump

CATALOGUE = (
    "stribeck",
    "asymmetric_friction",
    "quadratic_drag",
    "load_dependent_friction",
    "position_dependent_friction",
    "hysteresis",
    "joint_elasticity",
    "backlash",
    "torque_ripple",
    "torque_offset",
    "drive_gain",
    "actuator_lag",
    "time_delay",
    "torque_saturation",
    "gravity",
    "spring",
    "payload",
    "rotor_inertia",
    "thermal_drift",
    "periodic_disturbance",
    "end_stop",
    "encoder_eccentricity",
)
OUTSIDE = (
    "torque_bump",
    "friction_step",
    "cross_coupling",
    "cross_bump",
    "cubic_dead_spring",
    "velocity_bump",
    "acceleration_square",
)
