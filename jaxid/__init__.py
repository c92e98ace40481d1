"""Identify robot arms from closed-loop recordings, and find the physical effect the model lacks."""

import gc as _gc
from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

__version__ = "0.1.0"

# JAX registers a callback with the garbage collector, and a Ctrl-C during the callback is lost.
# Importing takes seconds and produces no garbage.
_collecting = _gc.isenabled()
_gc.disable()

import jax as _jax  # noqa: E402

_jax.config.update("jax_enable_x64", True)
from .compiling import set_loop_threshold as _set_loop_threshold  # noqa: E402

_set_loop_threshold()

from . import arms as arms  # noqa: E402
from . import control as control  # noqa: E402
from . import effects as effects  # noqa: E402
from .compiling import keep_programs as keep_programs  # noqa: E402
from .effects import Curve as Curve  # noqa: E402
from .effects import catalogue as catalogue  # noqa: E402
from .estimate import DIDIM as DIDIM  # noqa: E402
from .estimate import IDIM as IDIM  # noqa: E402
from .estimate import IDIMIV as IDIMIV  # noqa: E402
from .estimate import OEM as OEM  # noqa: E402
from .estimate import DifferenceLS as DifferenceLS  # noqa: E402
from .estimate import Differences as Differences  # noqa: E402
from .estimate import FilteredLS as FilteredLS  # noqa: E402
from .estimate import Filtering as Filtering  # noqa: E402
from .estimate import Fit as Fit  # noqa: E402
from .estimate import FourierLS as FourierLS  # noqa: E402
from .estimate import FourierStates as FourierStates  # noqa: E402
from .estimate import IntegralLS as IntegralLS  # noqa: E402
from .estimate import JointPEM as JointPEM  # noqa: E402
from .estimate import LowPass as LowPass  # noqa: E402
from .estimate import SeparablePEM as SeparablePEM  # noqa: E402
from .estimate import Status as Status  # noqa: E402
from .estimate import bootstrap as bootstrap  # noqa: E402
from .estimate import deviations as deviations  # noqa: E402
from .estimate import fit as fit  # noqa: E402
from .estimate import profile as profile  # noqa: E402
from .estimate import with_deviations as with_deviations  # noqa: E402
from .exporting import write_mjcf as write_mjcf  # noqa: E402
from .exporting import write_urdf as write_urdf  # noqa: E402
from .parameters import parameter as parameter  # noqa: E402
from .recording import Recording as Recording  # noqa: E402
from .recording import Recordings as Recordings  # noqa: E402
from .recording import read as read  # noqa: E402
from .robots import emps as emps  # noqa: E402
from .robots import scara as scara  # noqa: E402
from .robots import serial as serial  # noqa: E402
from .robots import two_link as two_link  # noqa: E402
from .signals.inspection import Inspection as Inspection  # noqa: E402
from .signals.inspection import inspect as inspect  # noqa: E402
from .signals.standstill import Standstill as Standstill  # noqa: E402
from .simulation.feedforward import inverse_dynamics as inverse_dynamics  # noqa: E402
from .simulation.loop import ClosedLoop as ClosedLoop  # noqa: E402
from .simulation.runs import simulate as simulate  # noqa: E402
from .simulation.stepping import Stepping as Stepping  # noqa: E402
from .storage.saved import load as load  # noqa: E402
from .storage.saved import save as save  # noqa: E402

if _collecting:
    # Move the imported objects to the oldest generation, so that no collection is due immediately.
    _gc.freeze()
    _gc.unfreeze()
    _gc.enable()

if _TYPE_CHECKING:
    from . import excitation as excitation
    from .discovery import Comparison as Comparison
    from .discovery import Diagnosis as Diagnosis
    from .discovery import Discovery as Discovery
    from .discovery import Fleet as Fleet
    from .discovery import FleetRobot as FleetRobot
    from .discovery import ModelDifference as ModelDifference
    from .discovery import compare as compare
    from .discovery import compare_models as compare_models
    from .discovery import diagnose as diagnose
    from .discovery import discover as discover
    from .discovery import discover_all as discover_all
    from .discovery import next_experiment as next_experiment
    from .discovery import simulator_terms as simulator_terms
    from .excitation import Excitation as Excitation
    from .excitation import Limits as Limits
    from .excitation import PlanarReach as PlanarReach
    from .excitation import optimal_excitation as optimal_excitation
    from .notebook import explore as explore
    from .report import write_report as write_report

# The higher-level subpackages are imported when a name of theirs is first used: a program that only
# simulates and fits does not need them, and they take a third of the import time.
_LATER = {
    "discovery": (
        "Comparison",
        "Diagnosis",
        "Discovery",
        "Fleet",
        "FleetRobot",
        "ModelDifference",
        "compare",
        "compare_models",
        "diagnose",
        "discover",
        "discover_all",
        "next_experiment",
        "simulator_terms",
    ),
    "excitation": ("Excitation", "Limits", "PlanarReach", "optimal_excitation"),
    "notebook": ("explore",),
    "report": ("write_report",),
}
_ROOM_OF = {name: room for room, names in _LATER.items() for name in names}


def __getattr__(name: str) -> _Any:
    if name in _LATER:
        return _import_module(f".{name}", __name__)
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(_import_module(f".{_ROOM_OF[name]}", __name__), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATER, *_ROOM_OF})
