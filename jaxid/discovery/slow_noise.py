"""The noise floor of joints whose residual is above the measured floor, and is noise all the same.

Above the motion's frequencies only white noise is measured, and a model with all effects absorbs
slow noise. Torque that drifts is then taken for a missing effect. But the torque of an effect can
be predicted from the motion of another recording, and noise cannot.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from ..estimate import Fit
from ..noise import ARFilter
from .comparison import Comparison
from .dependence import ComparedRows, Dependence, among, on_others
from .diagnosis import Diagnosis, over_recordings
from .floor import Floor
from .regressions import AT_ONCE, WITH_MEMORY, AbstractRegression
from .score import spanned
from .verdict import over_measured, over_rich

# A residual below the first number of deviations does not depend on the motion. At least half of
# the functions of the motion that are tried must be above the second one.
_NONE, _SEEN = 3.0, 6.0
# Share of the power above white noise that slow noise has at the frequencies of the joint's speed,
# and share of the speed's power that defines these frequencies. A resonance is above them.
_SLOW, _SPEED = 0.5, 0.9
# Number of functions of the motion for which this is tried, and standard deviation of their wave
# numbers, in radians over the standard deviation of position and velocity.
_TRIED, _WAVES = 8, 1.5


def floor_with_slow_noise(
    chosen: Fit,
    diagnosis: Diagnosis,
    noise: Sequence[ARFilter],
    held_out: Comparison | None,
    worth: float,
) -> Floor | None:
    """The measured noise floor; for joints with slow noise it is their error.

    **Arguments:**

    - `chosen`: the fit of the model with the best score. `diagnosis`: of this fit.
    - `noise`: noise filters of its residual, one per joint.
    - `held_out`: comparison of the model with held-out recordings; None if there are none.
    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    left, measured = chosen.error_percent.to_numpy(), diagnosis.measured
    if left.shape != diagnosis.floor.shape:
        return measured
    high = above_floors(chosen, diagnosis, worth)
    if not high.any():
        return measured
    rows = ComparedRows.of_fit(chosen, diagnosis)
    unseen = None if held_out is None else ComparedRows.of_comparison(held_out)
    low = np.minimum(diagnosis.floor, left)
    if measured is not None:
        low = np.where(np.isfinite(measured.low), np.minimum(measured.low, low), low)
    slow = np.zeros(len(high), bool)
    for j in np.flatnonzero(high).tolist():
        free = 1 - min(float(over_recordings(low)[j] / over_recordings(left)[j]), 1.0) ** 2
        slow[j] = (
            _is_slow(rows, j)
            and _independent(rows, unseen, j, noise[j])
            and _would_be_seen(rows, diagnosis, j, noise[j], free)
        )
    return _raised(measured, left, low, slow)


def above_floors(chosen: Fit, diagnosis: Diagnosis, worth: float) -> Bool[np.ndarray, " joints"]:
    """Joints whose error is above the measured noise floor, or that of the model with all effects.

    **Arguments:** as for `floor_with_slow_noise`.
    """
    measured = over_measured(chosen, diagnosis.measured, worth)
    return (over_rich(chosen, diagnosis, worth) > 0) | np.any(measured > 0, axis=0)


def _is_slow(rows: ComparedRows, joint: int) -> bool:
    """Whether the residual's power above white noise is at the frequencies of the joint's speed."""
    slow, total = 0.0, 0.0
    for motion, residual in zip(rows.motion, rows.residual, strict=True):
        window = np.hanning(len(residual))
        rest, speed = (
            np.abs(np.fft.rfft(x * window)) ** 2 for x in (residual[:, joint], motion[:, joint, 1])
        )
        # The power of a line of white noise is 1 / log(2) times the median.
        white = np.median(rest[len(rest) // 2 :]) / np.log(2)
        above = np.maximum(rest - white, 0.0)
        last = int(np.searchsorted(np.cumsum(speed), _SPEED * np.sum(speed)))
        slow, total = slow + float(np.sum(above[: last + 1])), total + float(np.sum(above))
    return slow > _SLOW * total


def _independent(
    rows: ComparedRows, unseen: ComparedRows | None, joint: int, filt: ARFilter
) -> bool:
    """Whether no regression predicts the residual of other recordings from their motion."""

    def found(regressions: tuple[AbstractRegression, ...]) -> list[Dependence]:
        tried = [among(rows, joint, filt, regressions)]
        if unseen is not None:
            tried.append(on_others(rows, unseen, joint, filt, regressions))
        return [x for x in tried if x is not None]

    at_once = found(AT_ONCE)
    if not at_once or any(x.deviations > _NONE for x in at_once):
        return False
    # Inaccurate time stamps and the low-pass leave a small part that depends on earlier motion.
    return not any(x.sure for x in found(WITH_MEMORY))


def _would_be_seen(
    rows: ComparedRows, diagnosis: Diagnosis, joint: int, filt: ARFilter, share: float
) -> bool:
    """Whether the regression sees most functions of the motion as large as what is above the floor.

    **Arguments:**

    - `share`: of the residual's power that is above the floor.
    """
    count = np.cumsum([len(r) for r in rows.residual])[:-1]
    rest = np.concatenate(rows.residual)
    found = []
    for torque in _torques(rows, diagnosis, joint):
        size = np.sqrt(share * np.sum(rest[:, joint] ** 2))
        changed = np.sqrt(1 - share) * rest
        changed[:, joint] += size * torque / max(np.linalg.norm(torque), 1e-300)
        changed[rest == 0] = 0
        with_effect = ComparedRows(rows.motion, tuple(np.split(changed, count)), rows.base)
        seen = among(with_effect, joint, filt, AT_ONCE)
        found.append(0.0 if seen is None else seen.deviations)
    return bool(found) and float(np.median(found)) > _SEEN


def _torques(
    rows: ComparedRows, diagnosis: Diagnosis, joint: int
) -> Iterable[Float[np.ndarray, " rows"]]:
    """What the model cannot absorb of random functions of a joint's position and velocity.

    They are waves over the two, every second one with the sign of the velocity, as friction has it.
    """
    data, rng = diagnosis.data, np.random.default_rng(0)
    joints = data.residual.shape[2]
    motion = np.concatenate(rows.motion)
    q, v = (x / (np.std(x) or 1.0) for x in motion[:, joint, :2].T)
    basis = spanned(data.base[data.mask].reshape(-1, data.base.shape[-1]))
    for number in range(_TRIED):
        waves, phase = rng.normal(size=2) * _WAVES, rng.uniform(0, 2 * np.pi)
        torque = np.cos(waves[0] * q + waves[1] * v + phase)
        whole = np.zeros((len(q), joints))
        whole[:, joint] = torque * (np.sign(v) if number % 2 else 1.0)
        left = whole.reshape(-1)
        yield (left - basis @ (basis.T @ left)).reshape(whole.shape)[:, joint]


def _raised(
    measured: Floor | None,
    left: Float[np.ndarray, "recordings joints"],
    low: Float[np.ndarray, "recordings joints"],
    slow: Bool[np.ndarray, " joints"],
) -> Floor | None:
    """The measured floor, with the error of the joints with slow noise."""
    if not slow.any():
        return measured
    unknown = np.full(left.shape, np.nan)
    sources = (("",) * left.shape[1],) * left.shape[0]
    before = measured or Floor(unknown, unknown, unknown, sources)
    return Floor(
        np.where(slow, left, before.percent),
        np.where(slow, low, before.low),
        np.where(slow, left, before.high),
        tuple(
            tuple("unpredicted" if is_slow else x for x, is_slow in zip(row, slow, strict=True))
            for row in before.sources
        ),
    )
