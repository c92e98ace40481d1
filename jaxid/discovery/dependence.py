"""Whether a residual depends on the motion: a regression is tested on recordings it has not seen.

Scores and noise filters cannot tell slow noise from the torque of a missing effect. But the noise
of a recording is not a function of the motion of another one, and the torque of most effects is.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..estimate import Fit
from ..estimate.result import joint_columns
from ..noise import ARFilter
from .comparison import Comparison
from .diagnosis import Diagnosis, over_recordings
from .regressions import REGRESSIONS, AbstractRegression
from .relevance import allowed

# A residual depends on the motion above this number of deviations and this share of its power. In
# benchmarks.worlds the share was at most 0.035 for right models without drifting noise, and above
# 0.2 for models in place of a law outside the catalogue, at 1.5 and 2.8 times the noise floor.
_SURE, _SHARE = 4.0, 0.1


class ComparedRows(eqx.Module):
    """Motion and residual at the compared rows of recordings.

    - `motion`: position, velocity, acceleration and direction of every joint, by recording.
    - `residual`: by recording, N·m or N (rad or m if positions are compared); zero at rows that are
      not compared.
    """

    motion: tuple[Float[np.ndarray, "_rows joints signals"], ...]
    residual: tuple[Float[np.ndarray, "_rows joints"], ...]

    @classmethod
    def of_fit(cls, fit: Fit, diagnosis: Diagnosis) -> "ComparedRows":
        """The rows of the fitted recordings, or of their windows.

        **Arguments:**

        - `diagnosis`: of this fit, or of one of the same model with other values.
        """
        motion, mask = diagnosis.motion, diagnosis.data.mask
        signals = _signals(*(np.asarray(x) for x in (motion.q, motion.v, motion.a)))
        return cls(tuple(x[there] for x, there in zip(signals, mask, strict=True)), fit.residuals)

    @classmethod
    def of_comparison(cls, held_out: Comparison) -> "ComparedRows":
        """The rows of held-out recordings."""
        runs = [held_out.compared_motion(k) for k in range(len(held_out.recordings))]
        return cls(tuple(_signals(*run) for run in runs), held_out.residuals)

    def sets(self, joint: int) -> list[list[int]]:
        """The joint (from 0), and all joints if there are several."""
        joints = self.residual[0].shape[1]
        return [[joint], list(range(joints))][: min(joints, 2)]

    def only(self, which: Sequence[int]) -> "ComparedRows":
        """The rows of some of the recordings, by number."""
        return ComparedRows(
            tuple(self.motion[k] for k in which), tuple(self.residual[k] for k in which)
        )


def _signals(
    *motion: Float[np.ndarray, "*rows joints"],
) -> Float[np.ndarray, "*rows joints signals"]:
    """Signals from position, velocity and acceleration; the direction is the sign of velocity."""
    return np.stack([*motion, np.sign(motion[1])], axis=-1)


class Dependence(eqx.Module):
    """What a regression on the motion predicts of a joint's residual that it was not trained on.

    - `share`: part of the residual's power.
    - `deviations`: product of prediction and residual, both whitened, over its standard deviation
      if the residual is noise.
    - `on`: what the prediction depends on.
    """

    share: float
    deviations: float
    on: str = eqx.field(static=True, default="")

    @property
    def sure(self) -> bool:
        """Whether the residual depends on the motion, by a part that counts."""
        return self.deviations > _SURE and self.share > _SHARE

    @classmethod
    def of(
        cls,
        predicted: Sequence[Float[np.ndarray, " _rows"]],
        residual: Sequence[Float[np.ndarray, " _rows"]],
        filt: ARFilter,
        on: str,
        twice: bool = False,
    ) -> "Dependence":
        """The agreement of a predicted and a residual series, by recording.

        **Arguments:**

        - `filt`: noise filter of the residual. `on`: what the prediction depends on.
        - `twice`: whether each recording has been predicted from the others.
        """

        def alike(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> float:
            x, y = np.concatenate(one), np.concatenate(other)
            return float(x @ y / max(np.linalg.norm(x) * np.linalg.norm(y), 1e-300))

        there = [r != 0 for r in residual]
        white = [
            [filt.innovations(x, kept) for x, kept in zip(series, there, strict=True)]
            for series in (predicted, residual)
        ]
        # Their deviation is that of these recordings, where noise may be stronger than where the
        # filter was estimated.
        count = sum(map(np.count_nonzero, there))
        # If two recordings predict each other, their two products may be equal.
        independent = count / 2 if twice else count
        share = max(alike(predicted, residual), 0.0) ** 2
        return cls(share, float(np.sqrt(independent)) * alike(*white), on)


def on_others(
    trained: ComparedRows,
    others: ComparedRows,
    joint: int,
    filt: ARFilter,
    regressions: Sequence[AbstractRegression] = REGRESSIONS,
) -> Dependence:
    """The dependence of the residual of some recordings, with regressions trained on others.

    Each regression is tried on the motion of the joint, and on that of all joints. The result is
    that of the best one.

    **Arguments:**

    - `joint`: from 0. `filt`: noise filter of its residual.
    """
    rest = [r[:, joint] for r in others.residual]
    found = []
    for regression in regressions:
        for used in trained.sets(joint):
            predicted = _predicted(regression, trained, others, joint, used, filt)
            found.append(Dependence.of(predicted, rest, filt, regression.on))
    return _best(found)


def among(
    rows: ComparedRows,
    joint: int,
    filt: ARFilter,
    regressions: Sequence[AbstractRegression] = REGRESSIONS,
) -> Dependence | None:
    """The dependence of the residual of each recording, with regressions trained on all others.

    None for a single recording.

    **Arguments:** as for `on_others`.
    """
    every = range(len(rows.residual))
    if len(every) < 2:
        return None
    rest, found = [r[:, joint] for r in rows.residual], []
    for regression in regressions:
        for used in rows.sets(joint):
            predicted = []
            for k in every:
                others = rows.only([i for i in every if i != k])
                predicted += _predicted(regression, others, rows.only([k]), joint, used, filt)
            found.append(Dependence.of(predicted, rest, filt, regression.on, twice=True))
    return _best(found)


def _best(found: Sequence[Dependence]) -> Dependence:
    """The one that is sure and predicts most; if none is sure, that with most deviations."""
    return max(found, key=lambda x: (x.sure, x.share if x.sure else x.deviations))


def _predicted(
    regression: AbstractRegression,
    trained: ComparedRows,
    others: ComparedRows,
    joint: int,
    used: Sequence[int],
    filt: ARFilter,
) -> list[Float[np.ndarray, " _rows"]]:
    """The residual of one joint (from 0) on other recordings, as a regression predicts it.

    **Arguments:**

    - `used`: joints of whose motion it is a function.
    """
    motion, elsewhere = ([x[:, used] for x in rows.motion] for rows in (trained, others))
    residual = [r[:, joint] for r in trained.residual]
    predicted = regression.predicted(motion, residual, elsewhere, filt)
    return [x * (r[:, joint] != 0) for x, r in zip(predicted, others.residual, strict=True)]


def depends_on_motion(
    fit: Fit,
    diagnosis: Diagnosis,
    noise: Sequence[ARFilter],
    held_out: Comparison | None,
    worth: float,
) -> str:
    """The reason if what a model leaves depends on the motion; empty if it does not.

    **Arguments:**

    - `fit`: of the model. `diagnosis`: of this fit, or of one of the same model with other values.
    - `noise`: noise filters of the residual, one per joint.
    - `held_out`: comparison of the fit with held-out recordings. If None, each fitted recording is
      predicted from the others.
    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    _, least = allowed(fit.loop, worth)
    rows = ComparedRows.of_fit(fit, diagnosis)
    others = None if held_out is None else ComparedRows.of_comparison(held_out)
    error = (fit if held_out is None else held_out).error_percent.to_numpy()
    reasons = []
    labels = joint_columns(fit.loop.joints)
    for j, (label, percent, filt) in enumerate(
        zip(labels, over_recordings(error), noise, strict=True)
    ):
        seen = among(rows, j, filt) if others is None else on_others(rows, others, j, filt)
        if seen is None:
            continue
        part = float(percent * np.sqrt(seen.share))
        if seen.sure and part > least:
            where = "fitted" if others is None else "held-out"
            said = (
                f"on the {where} recordings the error of {label} is {percent:.3g} %, of which a "
                f"regression on {seen.on}, trained on other recordings, predicts {part:.3g} %: an "
                "effect is missing that no examined model describes"
            )
            reasons.append((seen.share, said))
    return max(reasons, default=(0.0, ""))[1]
