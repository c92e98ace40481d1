"""Zero-phase low-pass filters, and the frequency up to which a recorded motion is signal."""

import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact, Int, Shaped

from ..errors import RecordingError
from ..recording import Recording

ORDER = 4
# Samples per period of the cutoff; at their Nyquist frequency the filter's gain is a sixth.
_SAMPLES = 2.5
# Periods of the cutoff at each end that are not compared. The acceleration is wrong at the ends;
# after three periods the filter leaves a thousandth of its torque. After two it leaves a hundredth,
# which was nineteen times the innovation of slow noise.
_ENDS = 3


def low_pass(
    x: Float[np.ndarray, "samples columns"], rate: float, cutoff: float, order: int = ORDER
) -> Float[np.ndarray, "samples columns"]:
    """Filters evenly spaced samples by a Butterworth low-pass, forward and backward.

    **Arguments:**

    - `x`: `(samples, columns)`.
    - `rate`: sample rate, Hz. `cutoff`: of the filter, Hz.
    """
    import scipy

    sections = scipy.signal.butter(order, cutoff, fs=rate, output="sos")
    # SciPy's default padding is shorter than the filter's response, and distorts a signal that
    # moves at its end. A straight line passes the filter unchanged, so it is subtracted first.
    pad = min(len(x) - 1, int(np.ceil(4 * rate / cutoff)))
    line = np.linspace(x[0], x[-1], len(x))
    return line + scipy.signal.sosfiltfilt(sections, x - line, axis=0, padlen=pad)


def even_times(recording: Recording) -> Float[np.ndarray, " samples"]:
    """Evenly spaced times, as many as the recording has samples, over the same span, s."""
    return np.linspace(recording.time[0], recording.time[-1], recording.samples)


def shared_length(count: int) -> int:
    """The length to which that many rows are padded: 4, 5, 6 or 7 times a power of two.

    Recordings of similar length then share compiled programs, in one process and through a cache
    of programs. Padding adds at most a quarter.
    """
    unit = 1 << max(count.bit_length() - 3, 0)
    return unit * -(-count // unit)


def evened(recording: Recording) -> Recording:
    """A recording resampled to evenly spaced times by cubic splines; unchanged if it is even."""
    time = even_times(recording)
    if np.allclose(recording.time, time, rtol=0, atol=1e-6 * (time[1] - time[0])):
        return recording
    names = ("q", "tau", "q_ref", "v", "tau_ff")
    signals = {n: x for n in names if (x := getattr(recording, n)) is not None}
    made = {n: resampled(recording.time, x, time) for n, x in signals.items()}
    return dataclasses.replace(recording, time=time, **made, **recording.held_at(time))


def resampled(
    time: Float[np.ndarray, " samples"],
    x: Float[np.ndarray, "samples columns"],
    at: Float[np.ndarray, " samples"],
) -> Float[np.ndarray, "samples columns"]:
    """Samples at other times, by a cubic spline if the times differ."""
    import scipy

    if np.allclose(time, at, rtol=0, atol=1e-6 * (time[1] - time[0])):
        return x
    return scipy.interpolate.CubicSpline(time, x)(at)


def smooth_motion(
    recording: Recording,
    cutoff: float,
    order: int = ORDER,
    q: Float[np.ndarray, "samples joints"] | None = None,
) -> Float[np.ndarray, "samples joints"]:
    """The recorded position, low-passed, at the recording's even times, rad or m.

    **Arguments:**

    - `cutoff`: of the low-pass, Hz.
    - `q`: other positions at the recording's times, rad or m.
    """
    q = resampled(recording.time, recording.q if q is None else q, even_times(recording))
    return low_pass(q, recording.rate, cutoff, order)


def smooth_samples(
    recording: Recording, cutoff: float, q: Float[np.ndarray, "samples joints"] | None = None
) -> Float[np.ndarray, "samples joints"]:
    """The recorded position, low-passed, at the recording's samples, rad or m.

    **Arguments:** those of `smooth_motion`.
    """
    return resampled(even_times(recording), smooth_motion(recording, cutoff, q=q), recording.time)


def signal_cutoff(*recordings: Recording, highest: float = 1 / 8) -> float:
    """The frequency in Hz above which recorded motions do not determine acceleration.

    The spectrum of the acceleration, f⁴ times that of position, decreases until the encoder's noise
    raises it again. The result is its minimum, summed over joints relative to their speed, and over
    recordings. Another minimum may be between the frequencies of the reference and those of the
    loop's response to friction. So a later minimum is chosen if it has about the same level, or if
    there is motion before it, far above the encoder's noise and the minimum itself. The result is
    at least five times the frequency of largest speed. For recordings too short for a spectrum it
    is a tenth of the sample rate.

    **Arguments:**

    - `highest`: largest result as a share of the sample rate.
    """
    rate = min(r.rate for r in recordings)
    long = [r for r in recordings if r.samples >= 200]
    if not long:
        return rate / 10
    # About twenty bands of a third of an octave, because single lines of a spectrum are too noisy.
    apart = max(r.rate / r.samples for r in long)
    last = int(rate / 2 / apart + 1e-9)
    edges = np.unique(np.round(np.geomspace(4, last, 20)).astype(int)) * apart
    centres, levels = zip(*(_acceleration(r, edges) for r in long), strict=True)
    centre, level = np.mean(centres, axis=0), np.sum(levels, axis=0)
    least = 5 * centre[int(np.argmax(level / centre**2))]
    cutoff = centre[_last_minimum(centre, level, centre >= least)]
    return float(min(max(least, cutoff), rate * highest))


def _acceleration(
    recording: Recording, edges: Float[np.ndarray, " edges"]
) -> tuple[Float[np.ndarray, " bands"], Float[np.ndarray, " bands"]]:
    """Frequency and spectral density of the acceleration in bands, over the power of the speed.

    **Arguments:**

    - `edges`: of the bands, Hz.
    """
    import scipy

    n, rate = recording.samples, recording.rate
    q = scipy.signal.detrend(resampled(recording.time, recording.q, even_times(recording)), axis=0)
    # The window's side lobes must be below the noise; the motion is 10¹⁰ times as strong.
    window = np.asarray(scipy.signal.get_window("blackmanharris", n))[:, None]
    power = np.abs(np.fft.rfft(q * window, axis=0)) ** 2
    f = np.fft.rfftfreq(n, 1 / rate)
    rates = power * f[:, None] ** 2
    speed = rates.sum(axis=0)
    # A joint at rest has only encoder steps, and is left out.
    moves = rates[f < rate / 10].sum(axis=0) > speed / 2
    chosen = moves if moves.any() else speed > 0
    acceleration = f**4 * (power[:, chosen] / speed[chosen]).sum(axis=1)
    lines = np.searchsorted(f, edges * (1 - 1e-9))
    bands = list(itertools.pairwise(lines.tolist()))
    centre = np.array([f[low:high].mean() for low, high in bands])
    return centre, n / rate * np.array([acceleration[low:high].mean() for low, high in bands])


# Ratio of the levels of two bands that may be random: a band at low frequencies has few lines. And
# that of a level to noise, and to a later minimum, above which it is motion.
_TIED, _MOTION = 1.5, 4.0


def _last_minimum(
    centre: Float[np.ndarray, " bands"],
    level: Float[np.ndarray, " bands"],
    allowed: Bool[np.ndarray, " bands"],
) -> int:
    """The band of the lowest level, or of a later minimum that is tied or has motion before it.

    In a long recording of a slow motion the gap between the reference and the response to friction
    is the lowest minimum: the sums of sines of a Panda, below 0.5 Hz for 60 s, had a cutoff of
    0.7 Hz, although the motion is known up to 30 Hz.
    """
    lowest = int(np.argmin(np.where(allowed, level, np.inf)))
    inner = np.flatnonzero((level[1:-1] < level[:-2]) & (level[1:-1] < level[2:])) + 1
    tied = inner[allowed[inner] & (level[inner] <= _TIED * level[lowest])]
    found = max([lowest, *tied.tolist()])
    # The noise of an encoder is white, so at most that of the last band is noise of this kind.
    noise = level[-1] * (centre / centre[-1]) ** 4
    for later in inner[inner > found].tolist():
        most = found + int(np.argmax(level[found:later]))
        if level[most] > _MOTION * max(level[later], noise[most]):
            found = later
    return found


class Band(eqx.Module):
    """The frequencies and samples of signals that are compared.

    Samples are as far apart as the low-pass allows. There is almost no power above the cutoff, so
    with closer samples the likelihood would depend on rounding errors.

    - `gain`: gain of the filter at the frequencies of a real Fourier transform.
    - `rate`: sample rate of each recording, Hz.
    - `rows`: the samples that are compared, far enough from the ends and from gaps; `keep` marks
      those present.
    """

    gain: Inexact[Array, "recordings frequencies"]
    rate: Float[Array, " recordings"]
    rows: Int[Array, "recordings rows"]
    keep: Bool[Array, "recordings rows"]

    @classmethod
    def of(
        cls,
        recordings: list[Recording],
        cutoffs: list[float],
        samples: int,
    ) -> "Band":
        """The band of recordings padded to `samples`.

        **Arguments:**

        - `cutoffs`: frequency up to which each recording's motion is known, Hz; the lowest is used.

        **Raises:** `RecordingError` if a recording, or what is between its gaps, is shorter than
        the filter's settling time.
        """
        import scipy

        cutoff, gains, rows = min(cutoffs), [], []
        memory = max(r.rate for r in recordings) / cutoff
        size = 1 << int(np.ceil(np.log2(samples + 4 * memory)))
        for r in recordings:
            sections = scipy.signal.butter(ORDER, cutoff, fs=r.rate, output="sos")
            grid = np.fft.rfftfreq(size, 1 / r.rate)
            gains.append(np.abs(scipy.signal.sosfreqz(sections, grid, fs=r.rate)[1]) ** 2)
            rows.append(_compared_rows(r, cutoff))
        most = shared_length(max(len(row) for row in rows))
        keep = np.arange(most) < np.array([[len(row)] for row in rows])
        filled = np.stack([np.pad(row, (0, most - len(row)), "edge") for row in rows])
        rates = np.array([r.rate for r in recordings])
        return cls(*map(jnp.asarray, (np.stack(gains), rates, filled, keep)))

    def __call__(
        self,
        x: Float[Array, "recordings samples *axes"],
        ahead: Float[Array, ""] | None = None,
    ) -> Float[Array, "recordings rows *axes"]:
        """Filtered signals, with zeros for missing samples and rows.

        **Arguments:**

        - `ahead`: time by which the signals are advanced, s; at most a few periods of the cutoff.
        """
        axes = (1,) * (x.ndim - 2)
        size = 2 * (self.gain.shape[1] - 1)
        gain = (self if ahead is None else self.advanced(ahead)).gain
        wave = jnp.fft.rfft(x, size, axis=1)
        wave = wave * gain.astype(wave.dtype).reshape(*gain.shape, *axes)
        passed = self.picked(jnp.fft.irfft(wave, size, axis=1))
        return passed * self.keep.reshape(*self.keep.shape, *axes)

    def advanced(self, time: Float[Array, ""]) -> "Band":
        """The band of signals that are advanced by a time, s; its gain is complex."""
        size = 2 * (self.gain.shape[1] - 1)
        frequency = jnp.arange(self.gain.shape[1]) * self.rate[:, None] / size
        return dataclasses.replace(self, gain=self.gain * jnp.exp(2j * jnp.pi * frequency * time))

    def picked(
        self, x: Shaped[Array, "recordings samples *axes"]
    ) -> Shaped[Array, "recordings rows *axes"]:
        """The compared rows of signals."""
        return x[jnp.arange(len(self.rows))[:, None], self.rows]


def _compared_rows(recording: Recording, cutoff: float) -> Int[np.ndarray, " rows"]:
    """The samples that are compared if signals are low-passed.

    In a gap longer than half a period of the cutoff the motion is not known, so a gap has two ends.

    **Arguments:**

    - `cutoff`: of the low-pass, Hz.

    **Raises:** `RecordingError` if there are fewer than ten.
    """
    time, settling = recording.time, _ENDS / cutoff
    trim = int(np.ceil(settling * recording.rate))
    step = max(1, int(recording.rate / (_SAMPLES * cutoff)))
    rows = np.arange(trim, recording.samples - trim, step)
    for k in np.flatnonzero(np.diff(time) > 0.5 / cutoff):
        before, after = time[k] - time[rows], time[rows] - time[k + 1]
        rows = rows[np.maximum(before, after) >= settling]
    if len(rows) * step < 10:
        raise RecordingError(
            f"{recording.name} lasts {recording.duration:.3g} s, but its low-pass at {cutoff:.3g} "
            f"Hz needs {settling:.3g} s at each end and on both sides of a gap: give longer "
            "recordings or windows"
        )
    return rows
