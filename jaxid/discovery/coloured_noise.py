"""The noise floor of joints whose residual is above the measured floor, and is noise all the same.

Above the motion's frequencies only white noise is measured, and a model with all effects absorbs
coloured noise. Torque that drifts is then taken for a missing effect. But the torque of an effect
can be predicted from the motion of another recording, and noise cannot.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from ..estimate import Fit
from ..noise import ARFilter
from .changes import change_of
from .comparison import Comparison
from .dependence import ComparedRows, Dependence, among, on_others
from .diagnosis import Diagnosis, over_recordings
from .episodes import episode_of
from .floor import Floor
from .random_torques import random_function, random_resonance
from .regressions import AT_ONCE, WITH_MEMORY, AbstractRegression
from .score import spanned
from .verdict import over_measured, over_rich

# A residual below the first number of deviations does not depend on the motion. At least half of
# the functions of the motion that are tried must be above the second one.
_NONE, _SEEN = 3.0, 6.0
# Number of functions of the motion for which this is tried.
_TRIED = 8


def floor_with_coloured_noise(
    chosen: Fit,
    diagnosis: Diagnosis,
    noise: Sequence[ARFilter],
    held_out: Comparison | None,
    worth: float,
) -> Floor | None:
    """The measured noise floor; for joints with coloured noise it is their error.

    **Arguments:**

    - `chosen`: the fit of the model with the best score. `diagnosis`: of this fit.
    - `noise`: noise filters of its residual, one per joint.
    - `held_out`: comparison of the model with held-out recordings; None if there are none.
    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    left, measured = chosen.error_percent.to_numpy(), diagnosis.measured
    high = above_floors(chosen, diagnosis, worth)
    if not high.any():
        return measured
    rows = ComparedRows.of_fit(chosen, diagnosis)
    unseen = None
    if held_out is not None:
        unseen = ComparedRows.of_comparison(held_out).with_base(held_out)
    low = np.minimum(diagnosis.floor, left)
    if measured is not None:
        low = np.where(np.isfinite(measured.low), np.minimum(measured.low, low), low)
    coloured = np.zeros(len(high), bool)
    for j in np.flatnonzero(high).tolist():
        free = 1 - min(float(over_recordings(low)[j] / over_recordings(left)[j]), 1.0) ** 2
        coloured[j] = (
            change_of(diagnosis, j) is None
            and episode_of(diagnosis, j) is None
            and _independent(rows, unseen, j, noise[j])
            and all(
                _would_be_seen(rows, diagnosis, j, noise[j], free, rings) for rings in (False, True)
            )
        )
    return _raised(measured, left, low, coloured)


def above_floors(chosen: Fit, diagnosis: Diagnosis, worth: float) -> Bool[np.ndarray, " joints"]:
    """Joints whose error is above the measured noise floor, or that of the model with all effects.

    **Arguments:** as for `floor_with_coloured_noise`.
    """
    measured = over_measured(chosen, diagnosis.measured, worth)
    return (over_rich(chosen, diagnosis, worth) > 0) | np.any(measured > 0, axis=0)


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
    rows: ComparedRows,
    diagnosis: Diagnosis,
    joint: int,
    filt: ARFilter,
    share: float,
    rings: bool,
) -> bool:
    """Whether regressions see most functions of the motion as large as what is above the floor.

    **Arguments:**

    - `share`: of the residual's power that is above the floor.
    - `rings`: whether it is that of resonances, by the regression with a memory.
    """
    count = np.cumsum([len(r) for r in rows.residual])[:-1]
    rest = np.concatenate(rows.residual)
    regressions, found = WITH_MEMORY if rings else AT_ONCE, []
    for torque in _torques(rows, diagnosis, joint, rings):
        size = np.sqrt(share * np.sum(rest[:, joint] ** 2))
        torque = torque * (rest[:, joint] != 0)
        changed = np.sqrt(1 - share) * rest
        changed[:, joint] += size * torque / max(np.linalg.norm(torque), 1e-300)
        with_effect = ComparedRows(rows.motion, tuple(np.split(changed, count)), rows.base)
        seen = among(with_effect, joint, filt, regressions)
        found.append(0.0 if seen is None else seen.deviations)
    return bool(found) and float(np.median(found)) > _SEEN


def _torques(
    rows: ComparedRows, diagnosis: Diagnosis, joint: int, rings: bool
) -> Iterable[Float[np.ndarray, " rows"]]:
    """What the model cannot absorb of random functions of a joint's motion.

    Every second one has the sign of the velocity, as friction has it.

    **Arguments:**

    - `rings`: whether they are resonances instead, excited by the acceleration or the friction.
    """
    data, rng = diagnosis.data, np.random.default_rng(0)
    joints = data.residual.shape[2]
    motion = np.concatenate(rows.motion)
    q, v, a, sign = motion[:, joint].T
    basis = spanned(data.base[data.mask].reshape(-1, data.base.shape[-1]))
    for number in range(_TRIED):
        whole, odd = np.zeros((len(q), joints)), bool(number % 2)
        whole[:, joint] = (
            random_resonance(sign if odd else a, rng) if rings else random_function(q, v, rng, odd)
        )
        left = whole.reshape(-1)
        yield (left - basis @ (basis.T @ left)).reshape(whole.shape)[:, joint]


def _raised(
    measured: Floor | None,
    left: Float[np.ndarray, "recordings joints"],
    low: Float[np.ndarray, "recordings joints"],
    coloured: Bool[np.ndarray, " joints"],
) -> Floor | None:
    """The measured floor, with the error of the joints with coloured noise."""
    if not coloured.any():
        return measured
    unknown = np.full(left.shape, np.nan)
    sources = (("",) * left.shape[1],) * left.shape[0]
    before = measured or Floor(unknown, unknown, unknown, sources)
    return Floor(
        np.where(coloured, left, before.percent),
        np.where(coloured, low, before.low),
        np.where(coloured, left, before.high),
        tuple(
            tuple(
                "unpredicted" if is_noise else x for x, is_noise in zip(row, coloured, strict=True)
            )
            for row in before.sources
        ),
    )
