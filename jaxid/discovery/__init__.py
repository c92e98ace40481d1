"""Where the model fails and what is missing: compare, diagnose, discover."""

from .compare import Comparison as Comparison
from .compare import compare as compare
from .diagnose import Diagnosis as Diagnosis
from .diagnose import diagnose as diagnose
from .discover import discover as discover
from .experiment import Experiment as Experiment
from .experiment import next_experiment as next_experiment
from .story import Discovery as Discovery
