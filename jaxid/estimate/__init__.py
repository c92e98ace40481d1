"""Methods, one a file, all through `fit(loop, recordings, method)`."""

from ._base import AbstractMethod as AbstractMethod
from ._base import Fit as Fit
from ._base import Status as Status
from ._fit import fit as fit
from ._regression import Filtering as Filtering
from .bootstrap import Bootstrap as Bootstrap
from .bootstrap import bootstrap as bootstrap
from .deviations import deviations as deviations
from .deviations import with_deviations as with_deviations
from .didim import DIDIM as DIDIM
from .didim import IDIMIV as IDIMIV
from .difference import DifferenceLS as DifferenceLS
from .filtered import FilteredLS as FilteredLS
from .fourier import FourierLS as FourierLS
from .idim import IDIM as IDIM
from .integral import IntegralLS as IntegralLS
from .joint_pem import JointPEM as JointPEM
from .oem import OEM as OEM
from .pem import SeparablePEM as SeparablePEM
from .profile import Profile as Profile
from .profile import profile as profile
from .states import AbstractStates as AbstractStates
from .states import Differences as Differences
from .states import FourierStates as FourierStates
from .states import LowPass as LowPass
