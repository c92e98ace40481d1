"""The command line: `jaxid demo`, `fit`, `compare`, `discover`."""

from .application import app as app
from .application import main as main
