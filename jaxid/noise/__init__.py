"""Noise models: autoregressive filters, their order, whiteness."""

from .ar import ARFilter as ARFilter
from .ar import Criterion as Criterion
from .ar import check_series as check_series
from .ar import fit_ar as fit_ar
from .ar import orders as orders
from .floor import Level as Level
from .floor import above_motion as above_motion
from .floor import from_repeats as from_repeats
from .vector import Noise as Noise
from .vector import VectorAR as VectorAR
from .vector import fit_var as fit_var
from .vector import innovations as innovations
from .whiteness import LjungBox as LjungBox
from .whiteness import autocorrelation as autocorrelation
from .whiteness import centred as centred
from .whiteness import levels as levels
from .whiteness import ljung_box as ljung_box
