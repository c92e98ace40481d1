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
from .relevance import allowed

# A residual depends on the motion above this number of deviations and this share of its power. In
# benchmarks.worlds the share was at most 0.035 for right models without drifting noise, and above
# 0.2 for models in place of a law outside the catalogue, at 1.5 and 2.8 times the noise floor.
_SURE, _SHARE = 4.0, 0.1
# Number of signals of the motion of a joint.
_SIGNALS = 4
# Trees of the regression, and smallest number of rows in a leaf.
_TREES, _LEAF = 50, 5
# Largest number of rows that the regression is trained on.
_ROWS = 20_000


class ComparedRows(eqx.Module):
    """Motion and residual at the compared rows of recordings.

    - `motion`: position, velocity, acceleration and direction of every joint, by recording.
    - `residual`: by recording, N·m or N (rad or m if positions are compared); zero at rows that are
      not compared.
    """

    motion: tuple[Float[np.ndarray, "_rows signals"], ...]
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
        """Columns of the motion of a joint (from 0), and of all joints if there are several."""
        joints = self.residual[0].shape[1]
        own = [joint + k * joints for k in range(_SIGNALS)]
        return [own, list(range(_SIGNALS * joints))][: min(joints, 2)]

    def only(self, which: Sequence[int]) -> "ComparedRows":
        """The rows of some of the recordings, by number."""
        return ComparedRows(
            tuple(self.motion[k] for k in which), tuple(self.residual[k] for k in which)
        )


def _signals(*motion: Float[np.ndarray, "*rows joints"]) -> Float[np.ndarray, "*rows signals"]:
    """Signals from position, velocity and acceleration; the direction is the sign of velocity."""
    return np.concatenate([*motion, np.sign(motion[1])], axis=-1)


class Dependence(eqx.Module):
    """What a regression on the motion predicts of a joint's residual that it was not trained on.

    - `share`: part of the residual's power.
    - `deviations`: product of prediction and residual, both whitened, over its standard deviation
      if the residual is noise.
    """

    share: float
    deviations: float

    @classmethod
    def of(
        cls,
        predicted: Sequence[Float[np.ndarray, " _rows"]],
        residual: Sequence[Float[np.ndarray, " _rows"]],
        filt: ARFilter,
    ) -> "Dependence":
        """The agreement of a predicted and a residual series, by recording.

        **Arguments:**

        - `filt`: noise filter of the residual.
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
        share = max(alike(predicted, residual), 0.0) ** 2
        return cls(share, float(np.sqrt(count)) * alike(*white))


def on_others(
    trained: ComparedRows, others: ComparedRows, joint: int, filt: ARFilter
) -> Dependence:
    """The dependence of the residual of some recordings, with regressions trained on others.

    One regression is on the motion of the joint, one on that of all joints. The result is that of
    the better one.

    **Arguments:**

    - `joint`: from 0. `filt`: noise filter of its residual.
    """
    rest = [r[:, joint] for r in others.residual]
    found = [
        Dependence.of(_predicted(trained, others, joint, used), rest, filt)
        for used in trained.sets(joint)
    ]
    return max(found, key=lambda x: x.deviations)


def among(rows: ComparedRows, joint: int, filt: ARFilter) -> Dependence | None:
    """The dependence of the residual of each recording, with regressions trained on all others.

    None for a single recording.

    **Arguments:** as for `on_others`.
    """
    every = range(len(rows.residual))
    if len(every) < 2:
        return None
    rest, found = [r[:, joint] for r in rows.residual], []
    for used in rows.sets(joint):
        predicted = [
            _predicted(rows.only([i for i in every if i != k]), rows.only([k]), joint, used)[0]
            for k in every
        ]
        found.append(Dependence.of(predicted, rest, filt))
    return max(found, key=lambda x: x.deviations)


def _predicted(
    trained: ComparedRows, others: ComparedRows, joint: int, used: Sequence[int]
) -> list[Float[np.ndarray, " _rows"]]:
    """The residual of one joint (from 0) on other recordings, as a regression predicts it.

    Randomised trees (Geurts, Ernst and Wehenkel 2006) describe steps of friction at reversals, and
    do not extrapolate.

    **Arguments:**

    - `used`: columns of the motion.
    """
    from sklearn.ensemble import ExtraTreesRegressor

    motion, rest = np.concatenate(trained.motion), np.concatenate(trained.residual)[:, joint]
    there = np.flatnonzero(rest)
    there = there[:: max(1, -(-len(there) // _ROWS))]
    if len(there) <= _LEAF:
        return [np.zeros(len(r)) for r in others.residual]
    trees = ExtraTreesRegressor(_TREES, min_samples_leaf=_LEAF, random_state=0)
    trees.fit(motion[there][:, used], rest[there])
    pairs = zip(others.motion, others.residual, strict=True)
    return [trees.predict(x[:, used]) * (r[:, joint] != 0) for x, r in pairs]


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
        if seen.deviations > _SURE and seen.share > _SHARE and part > least:
            where = "fitted" if others is None else "held-out"
            said = (
                f"on the {where} recordings the error of {label} is {percent:.3g} %, of which a "
                f"regression on the motion, trained on other recordings, predicts {part:.3g} %: an "
                "effect is missing that no examined model describes"
            )
            reasons.append((seen.share, said))
    return max(reasons, default=(0.0, ""))[1]
