"""Robot simulator that shares no code with jaxid, to check jaxid with what it did not make."""

from .batch import Batch, SampledComputedTorque, simulate_batch
from .cases import (
    Case,
    calibrate,
    draw_reference,
    make_case,
    record,
    remaining_after_refit,
    remaining_in_inverse_dynamics,
    robot_controller,
    truth,
    visibility,
    write_case,
    write_csv,
)
from .controllers import PD, EmpsCascade, OpenLoop, SampledPD
from .draws import Noise, Scale, applicable, draw_effect, draw_noise, draw_parameters
from .effects import CATALOGUE, OUTSIDE, Effect
from .plants import Axis, Scara, TwoLink, inverse_dynamics
from .references import (
    MultiSine,
    SmoothSteps,
    Trapezoid,
    draw_multisine,
    draw_smooth_steps,
    draw_trapezoids,
)
from .simulate import Simulation, simulate

__all__ = [
    "CATALOGUE",
    "OUTSIDE",
    "PD",
    "Axis",
    "Batch",
    "Case",
    "Effect",
    "EmpsCascade",
    "MultiSine",
    "Noise",
    "OpenLoop",
    "SampledComputedTorque",
    "SampledPD",
    "Scale",
    "Scara",
    "Simulation",
    "SmoothSteps",
    "Trapezoid",
    "TwoLink",
    "applicable",
    "calibrate",
    "draw_effect",
    "draw_multisine",
    "draw_noise",
    "draw_parameters",
    "draw_reference",
    "draw_smooth_steps",
    "draw_trapezoids",
    "inverse_dynamics",
    "make_case",
    "record",
    "remaining_after_refit",
    "remaining_in_inverse_dynamics",
    "robot_controller",
    "simulate",
    "simulate_batch",
    "truth",
    "visibility",
    "write_case",
    "write_csv",
]
