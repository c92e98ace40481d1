"""Comparison, diagnosis and discovery: where a model is wrong, and which effect it lacks."""

from ._discover import discover as discover
from .comparison import Comparison as Comparison
from .comparison import compare as compare
from .diagnosis import Diagnosis as Diagnosis
from .difference import ModelDifference as ModelDifference
from .difference import compare_models as compare_models
from .effect_curves import EffectCurve as EffectCurve
from .effect_curves import effect_curve as effect_curve
from .experiment import Experiment as Experiment
from .experiment import next_experiment as next_experiment
from .fleet import Fleet as Fleet
from .fleet import FleetRobot as FleetRobot
from .fleet import discover_all as discover_all
from .screening import diagnose as diagnose
from .simulator import SimulatorTerms as SimulatorTerms
from .simulator import simulator_terms as simulator_terms
from .story import Discovery as Discovery
from .what_if import WhatIf as WhatIf
