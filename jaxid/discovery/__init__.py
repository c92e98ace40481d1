"""Where the model fails and what is missing: compare, diagnose, discover."""

from .comparison import Comparison as Comparison
from .comparison import compare as compare
from .diagnosis import Diagnosis as Diagnosis
from .experiment import Experiment as Experiment
from .experiment import next_experiment as next_experiment
from .screening import diagnose as diagnose
from .search import discover as discover
from .story import Discovery as Discovery
