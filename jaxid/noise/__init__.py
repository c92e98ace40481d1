"""Noise models: autoregressive filters, their order, whiteness."""

from .ar import ARFilter as ARFilter
from .ar import fit_ar as fit_ar
from .whiteness import autocorrelation as autocorrelation
