"""Interactive results in a notebook: effects with sliders."""

from .explorer import Explorer as Explorer
from .explorer import explore as explore
