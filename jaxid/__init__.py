"""Identify robot arms from closed-loop recordings, and find the physical effect the model lacks."""

import gc as _gc
import os as _os
from importlib.util import find_spec as _find_spec

# JAX hangs a callback on the garbage collector, in which a Ctrl-C gets lost. Importing takes
# seconds, and nothing of it is garbage.
_collecting = _gc.isenabled()
_gc.disable()

import jax as _jax  # noqa: E402

_jax.config.update("jax_enable_x64", True)
# XLA's CPU runtime calls one kernel for each operation of a loop's body, which takes five times as
# long as the physics of a few joints. Below this size it compiles the whole loop as one kernel; its
# own limit, 1 kB, is below any robot's. With LLVM's first level of optimisation programs compile in
# two thirds of the time and run as fast; accelerators keep theirs. Nothing happens where the user
# has settings of their own, and results are the same either way.
_flags = {"xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=16777216"}
if _find_spec("jax_plugins") is None:
    _flags["xla_backend_optimization_level"] = "1"
for _name, _value in _flags.items():
    if _name not in _os.environ.get("XLA_FLAGS", ""):
        _given = _os.environ.get("XLA_FLAGS", "")
        _os.environ["XLA_FLAGS"] = f"{_given} --{_name}={_value}".strip()

from . import arms as arms  # noqa: E402
from . import control as control  # noqa: E402
from . import effects as effects  # noqa: E402
from . import excitation as excitation  # noqa: E402
from .discovery import Comparison as Comparison  # noqa: E402
from .discovery import Diagnosis as Diagnosis  # noqa: E402
from .discovery import Discovery as Discovery  # noqa: E402
from .discovery import compare as compare  # noqa: E402
from .discovery import diagnose as diagnose  # noqa: E402
from .discovery import discover as discover  # noqa: E402
from .discovery import next_experiment as next_experiment  # noqa: E402
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
from .excitation import Excitation as Excitation  # noqa: E402
from .excitation import Limits as Limits  # noqa: E402
from .excitation import PlanarReach as PlanarReach  # noqa: E402
from .excitation import optimal_excitation as optimal_excitation  # noqa: E402
from .parameters import parameter as parameter  # noqa: E402
from .recording import Recording as Recording  # noqa: E402
from .recording import Recordings as Recordings  # noqa: E402
from .recording import read as read  # noqa: E402
from .robots import emps as emps  # noqa: E402
from .robots import scara as scara  # noqa: E402
from .robots import two_link as two_link  # noqa: E402
from .simulation.loop import ClosedLoop as ClosedLoop  # noqa: E402
from .simulation.runs import simulate as simulate  # noqa: E402
from .simulation.stepping import Stepping as Stepping  # noqa: E402
from .storage.saved import load as load  # noqa: E402
from .storage.saved import save as save  # noqa: E402

if _collecting:
    # What was imported counts as old, so that no collection is due at once.
    _gc.freeze()
    _gc.unfreeze()
    _gc.enable()
