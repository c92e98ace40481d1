"""Properties of the recordings from which effects choose settings to screen."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..chain import InSpace


class Scene(eqx.Module):
    """Ranges of the recorded motion, one value for each joint, in SI units.

    - `q_low`, `q_high`: range of position. `speed`, `torque`: largest magnitudes.
    - `inertia`: mean inertia of a joint while the others are free. `smoothing`, `form`: of the
      sign in its Coulomb friction.
    - `period`, `duration`: of the recordings, s. `recordings`: their names.
    - `tones`: frequencies of peaks in the residual's spectrum, Hz.
    - `lengths`: lengths of the links before the last, m; `g`: gravity in their plane, m/s².
    - `slides`: whether a joint slides. `planar`: whether links move in one plane.
    - `couplings`: pairs of joints that may share a shaft, and the turns of the shaft per turn of
      the first joint.
    - `moments`: first moments of each link in its own frame, kg·m; None if not known.
    - `space`: joints and bodies of a spatial arm; None for other arms.
    - `drawn`: whether its bodies are held at the values of a drawing.
    - `returned`: time by which each joint has moved in both directions in some recording, s; zero
      if it never does. Empty if not known.
    """

    q_low: Float[np.ndarray, " joints"]
    q_high: Float[np.ndarray, " joints"]
    speed: Float[np.ndarray, " joints"]
    torque: Float[np.ndarray, " joints"]
    inertia: Float[np.ndarray, " joints"]
    smoothing: Float[np.ndarray, " joints"]
    form: Float[np.ndarray, " joints"]
    period: float
    duration: float
    recordings: tuple[str, ...]
    tones: tuple[tuple[float, ...], ...]
    lengths: tuple[float, ...]
    g: float
    slides: tuple[bool, ...]
    moments: tuple[tuple[float, float] | None, ...]
    planar: bool = True
    couplings: tuple[tuple[int, int, float], ...] = ()
    space: InSpace | None = None
    drawn: bool = False
    returned: tuple[float, ...] = ()

    @property
    def joints(self) -> range:
        """Joints, counted from 1."""
        return range(1, len(self.q_low) + 1)

    def travel(self, joint: int) -> float:
        """Range of a joint's position, rad or m."""
        return float(self.q_high[joint - 1] - self.q_low[joint - 1])

    def sign(self, joint: int) -> dict[str, float]:
        """Smoothing, rad/s or m/s, and form of the sign in the Coulomb friction of a joint."""
        return {
            "smoothing": float(self.smoothing[joint - 1]),
            "form": float(self.form[joint - 1]),
        }
