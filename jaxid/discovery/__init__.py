"""Where the model fails and what is missing: compare, diagnose, discover."""

from .compare import Comparison as Comparison
from .compare import compare as compare
