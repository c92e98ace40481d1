"""Finite Fourier series of periodic motion with derivatives, and means over periods."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..errors import FitError
from ..recording import Recording
from .smoothing import even_times, resampled

# A motion is aperiodic if more than this share of it does not repeat.
_APERIODIC = 0.05


def fourier_basis(
    time: Float[np.ndarray, " samples"], period: float, harmonics: int
) -> Float[np.ndarray, "3 samples coefficients"]:
    """1, then cos and sin of each harmonic, and their first and second derivatives in time.

    **Arguments:**

    - `time`: s. `period`: s. `harmonics`: their number; there are 2 · harmonics + 1 coefficients.
    """
    rate = 2 * np.pi * np.arange(1, harmonics + 1) / period
    angle = np.outer(time, rate)
    c, s = np.cos(angle), np.sin(angle)
    pairs = [(c, s), (-rate * s, rate * c), (-(rate**2) * c, -(rate**2) * s)]
    waves = np.stack([np.stack(pair, axis=-1).reshape(len(time), -1) for pair in pairs])
    level = np.zeros((3, len(time), 1))
    level[0] = 1.0
    return np.concatenate([level, waves], axis=-1)


class FourierSeries(eqx.Module):
    """A periodic motion of all joints: coefficients of 1, cos, sin, cos 2, sin 2, …, rad or m."""

    coefficients: Float[Array | np.ndarray, "coefficients joints"]
    period: float = eqx.field(static=True)

    @property
    def harmonics(self) -> int:
        """Number of harmonics."""
        return (self.coefficients.shape[0] - 1) // 2

    def __call__(
        self, time: Float[np.ndarray, " samples"]
    ) -> Float[Array | np.ndarray, "3 samples joints"]:
        """Position, velocity and acceleration at times, s."""
        return fourier_basis(time, self.period, self.harmonics) @ self.coefficients


class Harmonics(eqx.Module):
    """Period of a recording in s, and number of harmonics."""

    period: float = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)


def _asked(recording: Recording) -> Float[np.ndarray, "samples joints"]:
    q = recording.q if recording.q_ref is None else recording.q_ref
    return resampled(recording.time, q, even_times(recording))


def _unrepeated(x: Float[np.ndarray, "samples joints"], lag: int) -> float:
    """Relative difference between a motion and itself `lag` samples earlier."""
    spread = x.std(axis=0)
    moves = spread > 1e-9 * max(float(spread.max()), 1e-300)
    apart = np.sqrt(np.mean((x[lag:] - x[:-lag]) ** 2, axis=0))
    return float(np.max(apart[moves] / spread[moves])) if moves.any() else 0.0


def _interpolated(x: Float[np.ndarray, "samples joints"], lag: float) -> float:
    """`_unrepeated` at a lag between samples."""
    whole = int(np.floor(lag))
    share = lag - whole
    late = x[whole : len(x) - 1] * (1 - share) + x[whole + 1 :] * share
    early = x[: len(late)]
    return float(np.sum(((late - early) / np.maximum(x.std(axis=0), 1e-300)) ** 2) / len(late))


def period_of(recording: Recording, period: float | None = None) -> float:
    """The period of a recorded motion, s; the recording must contain two.

    **Arguments:**

    - `period`: if known, s; None to find it from the reference, or the position without one.

    **Raises:** `FitError` if the motion does not repeat.
    """
    import scipy

    n, rate = recording.samples, recording.rate
    if period is not None:
        lag = round(period * rate)
        if period <= 0 or lag < 4:
            raise FitError(
                f"a period of {period:g} s is shorter than four samples of {recording.name}: give "
                "the period of its reference"
            )
        if n < lag:
            raise FitError(
                f"{recording.name} lasts {recording.duration:.3g} s, less than its period of "
                f"{period:g} s: give a recording of whole periods"
            )
        # With only one period, its two ends are compared.
        x = resampled(recording.time, recording.q, even_times(recording))
        left = _unrepeated(x, lag) if n - lag > max(4, 0.05 * lag) else 0.0
        if left > _APERIODIC:
            raise FitError(
                f"{recording.name} does not repeat after {period:g} s: {100 * left:.0f} % of its "
                "motion differs between periods; cut off its start and end (Recording.slice), "
                "correct the period, or use IntegralLS, which needs no period"
            )
        return period
    x = _asked(recording)
    lags = np.arange(max(8, n // 200), n // 2 + 1)
    scaled = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-300)
    # Mean square difference at every lag, from sums of squares and the correlation.
    square = np.concatenate([[0.0], np.cumsum(np.sum(scaled**2, axis=1))])
    product = sum(scipy.signal.correlate(c, c, method="fft")[n - 1 :] for c in scaled.T)
    differ = (square[n - lags] + square[n] - square[lags] - 2 * np.asarray(product)[lags]) / (
        n - lags
    )
    differ = differ / x.shape[1]
    low = differ < max(2.0 * float(differ.min()), _APERIODIC**2)
    # Over short lags slow motion differs little; the search begins after a large difference.
    far = int(np.argmax(differ > 0.5)) if np.any(differ > 0.5) else len(lags)
    low[:far] = False
    if not low.any() or float(differ[low].min()) > _APERIODIC**2:
        raise FitError(
            f"{recording.name} does not repeat within half its length, so it has no Fourier "
            "series: record two periods or more of a periodic reference, or use IntegralLS, which "
            "needs no period"
        )
    start = int(np.argmax(low))
    end = start + int(np.argmin(low[start:])) if not low[start:].all() else len(low)
    best = lags[start + int(np.argmin(differ[start:end]))]
    fine = np.linspace(best - 1, best + 1, 201)
    fine = fine[(fine >= 1) & (fine < n - 2)]
    found = float(fine[int(np.argmin([_interpolated(x, lag) for lag in fine]))]) / rate
    # Prefer a whole number of samples if it fits equally well: most references have one.
    if abs(found * rate - best) < 0.05:
        found = float(best / rate)
    return period_of(recording, found)


def settle_harmonics(recording: Recording, period: float, harmonics: int | None) -> Harmonics:
    """Number of harmonics of a recorded motion, by BIC over all joints.

    Each joint's errors are divided by their variance: that of the encoder's step, Q²/12, or the
    residual of the largest series, whichever is larger.

    **Arguments:**

    - `period`: s. `harmonics`: a given number, which is only checked; None to choose.

    **Raises:** `FitError` if a period has too few samples for the harmonics.
    """
    import scipy

    inside = min(recording.samples, round(period * recording.rate))
    most = (inside - 2) // 4
    if harmonics is not None:
        if harmonics < 1 or harmonics > most:
            raise FitError(
                f"{harmonics} harmonics cannot be determined from {inside} samples per period of "
                f"{recording.name}: choose at most {most} harmonics, or sample faster"
            )
        return Harmonics(period, harmonics)
    if most < 1:
        raise FitError(
            f"{inside} samples per period of {recording.name} are too few for a harmonic: sample "
            "faster"
        )
    time = even_times(recording)
    x = resampled(recording.time, recording.q, time)
    most = min(most, 100)
    wide = fourier_basis(time, period, most)[0]
    # Gram-Schmidt by Cholesky: the waves are nearly orthogonal, and there are many samples.
    lower = scipy.linalg.cholesky(wide.T @ wide, lower=True)
    parts = scipy.linalg.solve_triangular(lower, wide.T @ x, lower=True) ** 2
    gained = np.concatenate([parts[:1], parts[1::2] + parts[2::2]])
    left = np.sum(x**2, axis=0) - np.cumsum(gained, axis=0)
    n = recording.samples
    variance = np.maximum(left[-1] / max(n - wide.shape[1], 1), 1e-30 * np.sum(x**2, axis=0))
    if recording.resolution is not None:
        variance = np.maximum(variance, recording.resolution**2 / 12)
    variance = np.where(variance > 0, variance, 1.0)
    price = 2 * np.arange(most + 1) * x.shape[1] * np.log(n)
    score = np.sum(left / variance, axis=1) + price
    return Harmonics(period, max(1, int(np.argmin(score))))


class Repeated(eqx.Module):
    """Mean over the periods of a recording, and the deviation between periods.

    - `q`, `tau`: means over the periods, `(samples, joints)`.
    - `noise_q`, `noise_tau`: standard deviations of one sample, `(joints,)`, without a model.
    - `periods`: number of whole periods.
    """

    q: Float[np.ndarray, "samples joints"]
    tau: Float[np.ndarray, "samples joints"]
    noise_q: Float[np.ndarray, " joints"]
    noise_tau: Float[np.ndarray, " joints"]
    periods: int = eqx.field(static=True)


def repeated(recording: Recording, period: float | None = None) -> Repeated:
    """Mean and noise over the periods of a recording.

    **Arguments:**

    - `period`: s; None to find it.

    **Raises:** `FitError` if it is not periodic, or has fewer than two whole periods.
    """
    period = period_of(recording, period)
    time = even_times(recording)
    step = time[1] - time[0]
    count = int((time[-1] - time[0] + 1.001 * step) / period)
    inside = int(np.floor(period / step + 1e-6))
    if count < 2:
        raise FitError(
            f"{recording.name} has {count} whole period of {period:g} s: noise needs two"
        )
    at = np.add.outer(time[0] + period * np.arange(count), step * np.arange(inside))
    at = np.minimum(at, time[-1]).ravel()

    def spread(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        folded = resampled_at(time, resampled(recording.time, x, time), at)
        folded = folded.reshape(count, inside, -1)
        mean = folded.mean(axis=0)
        variance = np.sum((folded - mean) ** 2, axis=(0, 1)) / ((count - 1) * inside)
        return mean, np.sqrt(variance)

    (q, noise_q), (tau, noise_tau) = spread(recording.q), spread(recording.tau)
    return Repeated(q, tau, noise_q, noise_tau, count)


def resampled_at(
    time: Float[np.ndarray, " samples"],
    x: Float[np.ndarray, "samples columns"],
    at: Float[np.ndarray, " points"],
) -> Float[np.ndarray, "points columns"]:
    """Evenly sampled values at given times: exact at the samples, cubic between them."""
    import scipy

    place = (at - time[0]) / (time[1] - time[0])
    near = np.round(place).astype(int)
    if np.all(np.abs(place - near) < 1e-6):
        return x[np.clip(near, 0, len(x) - 1)]
    return scipy.interpolate.CubicSpline(time, x)(at)
