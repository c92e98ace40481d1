"""The least-squares problem of a simulated loop, and its minimisation by optimistix."""

from .arrow import Arrow as Arrow
from .descent import BoundedDescent as BoundedDescent
from .descent import promised as promised
from .filling import Filling as Filling
from .filtering import Coefficients as Coefficients
from .linearising import linearisation as linearisation
from .linearising import linearise as linearise
from .linearising import with_derivatives as with_derivatives
from .minimum import Minimum as Minimum
from .minimum import Stopping as Stopping
from .minimum import descend as descend
from .minimum import minimise as minimise
from .problem import Point as Point
from .problem import Problem as Problem
from .problem import Sums as Sums
from .problem import point_around as point_around
from .problem import residual_at as residual_at
from .problem import reweighted as reweighted
from .residual import Sensitivity as Sensitivity
from .residual import absorb_start as absorb_start
from .residual import raw_residual as raw_residual
from .residual import sensitivity as sensitivity
from .residual import unfiltered as unfiltered
from .search import Nielsen as Nielsen
from .solver import LevenbergMarquardt as LevenbergMarquardt
from .stock import check_solver as check_solver
