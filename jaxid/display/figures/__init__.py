"""Figures of plain arrays with names and units; every function returns a plotly figure.

Colours and text have medium luminance and the background is transparent, so that a figure is
legible on light and dark pages. Elements that differ in colour also differ in width, dash, marker
or pattern, so that a figure is legible in grey.
"""

from .along_time import before_after as before_after
from .along_time import comparison as comparison
from .along_time import mark_misfit as mark_misfit
from .along_time import shares_in_time as shares_in_time
from .along_time import signals as signals
from .estimates import deviance as deviance
from .estimates import differences as differences
from .estimates import parameters as parameters
from .estimates import ranking as ranking
from .look import BLUE as BLUE
from .look import DASHES as DASHES
from .look import GREEN as GREEN
from .look import GRID as GRID
from .look import INK as INK
from .look import MARKERS as MARKERS
from .look import MISFIT as MISFIT
from .look import ORANGE as ORANGE
from .look import PALETTE as PALETTE
from .look import PATTERNS as PATTERNS
from .look import PURPLE as PURPLE
from .look import RED as RED
from .look import SHADE as SHADE
from .look import theme as theme
from .panels import MAX_POINTS as MAX_POINTS
from .panels import Role as Role
from .panels import Trace as Trace
from .relative_errors import error_bars as error_bars
from .relative_errors import error_falling as error_falling
from .residuals import MAX_DOTS as MAX_DOTS
from .residuals import autocorrelation as autocorrelation
from .residuals import curve_fit as curve_fit
from .residuals import dependence as dependence
