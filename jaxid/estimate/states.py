"""Velocity and acceleration from recorded positions: differences, low-passes, Fourier series."""

import abc
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import check_words
from ..recording import Recording
from ..signals.fourier import Harmonics, fourier_basis, period_of, settle_harmonics
from ..signals.smoothing import even_times, low_pass, resampled
from ..simulation.runs import Simulated
from .regression import Filtering

Rates = tuple[
    Float[np.ndarray, "samples columns"],
    Float[np.ndarray, "samples columns"],
    Float[np.ndarray, "samples columns"],
]


class AbstractStates(eqx.Module):
    """A linear estimate of position, velocity and acceleration from recorded positions."""

    def __check_init__(self):
        check_words(self)

    @abc.abstractmethod
    def rates(self, recording: Recording, x: Float[np.ndarray, "samples columns"]) -> Rates:
        """Even samples as position, velocity and acceleration, `(samples, columns)` each.

        **Arguments:**

        - `recording`: its sample rate and spectrum determine the settings.
        - `x`: samples to use instead of its positions.
        """

    @abc.abstractmethod
    def edge(self, recording: Recording) -> int:
        """Samples at each end that are not reliable."""

    @abc.abstractmethod
    def memory(self, recording: Recording) -> int | None:
        """Number of samples that one sample affects; None for all."""

    def resolved(self, recording: Recording) -> "AbstractStates":
        """The same with fixed settings, determined from a recording."""
        return self

    def motion(self, recording: Recording) -> Simulated:
        """The recording's motion on even times, with its torque."""
        time = even_times(recording)
        q, v, a = self.rates(recording, resampled(recording.time, recording.q, time))
        tau = resampled(recording.time, recording.tau, time)
        return Simulated(time, q, v, a, tau, tau, np.zeros((recording.samples, 0)))


class Differences(AbstractStates):
    """Differences of neighbouring samples, which amplify errors by 1/T and 1/T².

    **Arguments:**

    - `scheme`: `"backward"` as in Appendix C of Li, Peng, Juang 2023, or `"central"`.
    """

    scheme: Literal["backward", "central"] = eqx.field(static=True, default="backward")

    def rates(self, recording: Recording, x: Float[np.ndarray, "samples columns"]) -> Rates:
        """The unchanged position, its first and second difference."""
        step = recording.period
        if self.scheme == "central":
            a = np.zeros_like(x)
            a[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) / step**2
            a[0], a[-1] = a[1], a[-2]
            return x, np.gradient(x, step, axis=0), a
        v = np.diff(x, axis=0, prepend=x[:1]) / step
        v[0] = v[1]
        a = np.diff(v, axis=0, prepend=v[:1]) / step
        return x, v, a

    def edge(self, recording: Recording) -> int:
        """Two samples."""
        return 2

    def memory(self, recording: Recording) -> int:
        """Three samples."""
        return 3


class LowPass(AbstractStates):
    """A zero-phase low-pass on position, then differences (Gautier 1997).

    **Arguments:**

    - `filtering`: its cutoff and order.
    """

    filtering: Filtering = Filtering()

    def rates(self, recording: Recording, x: Float[np.ndarray, "samples columns"]) -> Rates:
        """Low-passed position and its central differences."""
        cutoff, _, _ = self.filtering.settled(recording)
        q = low_pass(x, recording.rate, cutoff, self.filtering.order)
        v = np.gradient(q, recording.period, axis=0)
        return q, v, np.gradient(v, recording.period, axis=0)

    def edge(self, recording: Recording) -> int:
        """The samples that the filtering trims."""
        return self.filtering.settled(recording)[2]

    def memory(self, recording: Recording) -> int:
        """Four periods of the cutoff."""
        return int(np.ceil(4 * recording.rate / self.filtering.settled(recording)[0]))


class FourierStates(AbstractStates):
    """A finite Fourier series fitted to position, for periodic motion.

    **Arguments:**

    - `period`: period of the motion, s; detected from the recording if None.
    - `harmonics`: number of harmonics; chosen from the recording if None.
    """

    period: float | None = eqx.field(static=True, default=None)
    harmonics: int | None = eqx.field(static=True, default=None)

    def settled(self, recording: Recording) -> Harmonics:
        """Period and number of harmonics for a recording.

        **Raises:** `FitError` if it is not periodic, or too short for the harmonics.
        """
        return settle_harmonics(recording, period_of(recording, self.period), self.harmonics)

    def resolved(self, recording: Recording) -> "FourierStates":
        """The same with period and number of harmonics of a recording."""
        found = self.settled(recording)
        return FourierStates(found.period, found.harmonics)

    def basis(self, recording: Recording) -> Float[np.ndarray, "3 samples coefficients"]:
        """The series' functions and their first two derivatives at the even times."""
        period, harmonics = self.period, self.harmonics
        if period is None or harmonics is None:
            found = self.settled(recording)
            period, harmonics = found.period, found.harmonics
        return fourier_basis(even_times(recording), period, harmonics)

    def rates(self, recording: Recording, x: Float[np.ndarray, "samples columns"]) -> Rates:
        """The fitted series and its derivatives."""
        basis = self.basis(recording)
        coefficients = np.linalg.lstsq(basis[0], x, rcond=None)[0]
        q, v, a = basis @ coefficients
        return q, v, a

    def edge(self, recording: Recording) -> int:
        """Zero: a series has no ends."""
        return 0

    def memory(self, recording: Recording) -> None:
        """None, because every sample affects all."""
        return None
