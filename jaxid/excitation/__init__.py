"""Reference trajectories and their optimal design."""

from .limits import Limits as Limits
from .limits import PlanarReach as PlanarReach
from .optimal import optimal_excitation as optimal_excitation
from .reference import Excitation as Excitation
