"""Estimation methods, one file each, called through `fit(loop, recordings, method)`."""

from ._fit import doubtful_joints as doubtful_joints
from ._fit import fit as fit
from .covariance import deviations as deviations
from .covariance import with_deviations as with_deviations
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
from .profiles import Profile as Profile
from .profiles import profile as profile
from .regression import Filtering as Filtering
from .resampling import Bootstrap as Bootstrap
from .resampling import bootstrap as bootstrap
from .result import AbstractMethod as AbstractMethod
from .result import Fit as Fit
from .result import Status as Status
from .states import AbstractStates as AbstractStates
from .states import Differences as Differences
from .states import FourierStates as FourierStates
from .states import LowPass as LowPass
