"""Results in hand in a notebook: effects moved by sliders."""

from .explorer import Explorer as Explorer
from .explorer import explore as explore
