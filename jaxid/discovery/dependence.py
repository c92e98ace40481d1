"""Whether a residual depends on the motion: regressions are tested on recordings not seen before.

Scores and noise filters cannot tell slow noise from the torque of a missing effect. But the noise
of a recording is not a function of the motion of another one, and the torque of most effects is.
"""

from collections.abc import Mapping, Sequence

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
from .score import spanned
from .system import System

# A residual depends on the motion above this number of deviations and this share of its power. In
# benchmarks.worlds the share was at most 0.05 for right models, 0.34 for a law that is not in the
# catalogue, at 2.8 times the noise floor, 0.34 for a resonance at 2.3 and 0.11 for presliding at
# 1.9 times.
_SURE, _SHARE = 4.0, 0.1


class ComparedRows(eqx.Module):
    """Motion and residual at the compared rows of recordings.

    - `motion`: position, velocity, acceleration and direction of every joint, by recording.
    - `residual`: by recording, N·m or N (rad or m if positions are compared); zero at rows that are
      not compared.
    - `base`: by recording, what the model's parameters can change; None if it is not known.
    """

    motion: tuple[Float[np.ndarray, "_rows joints signals"], ...]
    residual: tuple[Float[np.ndarray, "_rows joints"], ...]
    base: tuple[Float[np.ndarray, "_rows joints absorbed"], ...] | None = None

    @classmethod
    def of_fit(cls, fit: Fit, diagnosis: Diagnosis) -> "ComparedRows":
        """The rows of the fitted recordings, or of their windows.

        **Arguments:**

        - `diagnosis`: of this fit, or of one of the same model with other values. The residual of
          windows, whose rows differ from those of the recordings, is that of the diagnosis.
        """
        motion, data = diagnosis.motion, diagnosis.data
        signals = _signals(*(np.asarray(x) for x in (motion.q, motion.v, motion.a)))
        moved, base = (
            tuple(x[there] for x, there in zip(rows, data.mask, strict=True))
            for rows in (signals, data.base)
        )
        residual = fit.residuals
        if len(residual) != len(moved):
            residual = tuple(x[there] for x, there in zip(data.residual, data.mask, strict=True))
        return cls(moved, residual, base)

    @classmethod
    def of_comparison(cls, held_out: Comparison) -> "ComparedRows":
        """The rows of held-out recordings."""
        runs = [held_out.compared_motion(k) for k in range(len(held_out.recordings))]
        return cls(tuple(_signals(*run) for run in runs), held_out.residuals)

    def with_base(self, compared: Comparison) -> "ComparedRows":
        """The rows of held-out recordings, with what the model's parameters can change.

        This linearises the model along the recordings. Windows have rows of their own, for which it
        remains unknown.
        """
        system = System.of(compared)
        base = tuple(x[there] for x, there in zip(system.base, system.mask, strict=True))
        if [len(x) for x in base] != [len(r) for r in self.residual]:
            return self
        return ComparedRows(self.motion, self.residual, base)

    def sets(self, joint: int) -> list[list[int]]:
        """The joint (from 0), and all joints if there are several."""
        joints = self.residual[0].shape[1]
        return [[joint], list(range(joints))][: min(joints, 2)]

    def only(self, which: Sequence[int]) -> "ComparedRows":
        """The rows of some of the recordings, by number."""

        def chosen(rows: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
            return tuple(rows[k] for k in which)

        base = None if self.base is None else chosen(self.base)
        return ComparedRows(chosen(self.motion), chosen(self.residual), base)


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


class Target(eqx.Module):
    """The residual of a joint, to be compared with predictions of it.

    - `residual`: by recording, N·m or N; zero at rows that are not compared.
    - `filt`: its noise filter.
    - `basis`: directions of all its rows, and of its whitened ones, that the model's parameters can
      change; None if they are not known. Errors of parameters come from the noise that a regression
      was trained on, so they would be taken for a missing effect.
    """

    residual: tuple[Float[np.ndarray, " _rows"], ...]
    filt: ARFilter
    basis: tuple[Float[np.ndarray, "rows rank"], Float[np.ndarray, "rows white"]] | None

    @classmethod
    def of(cls, rows: ComparedRows, joint: int, filt: ARFilter) -> "Target":
        """The residual of a joint (from 0)."""
        residual, basis = tuple(r[:, joint] for r in rows.residual), None
        if rows.base is not None:
            base = [
                x[:, joint] * (r != 0)[:, None] for x, r in zip(rows.base, residual, strict=True)
            ]
            basis = spanned(np.concatenate(base)), spanned(_white(base, residual, filt))
        return cls(residual, filt, basis)

    def dependence(
        self, predicted: Sequence[Float[np.ndarray, " _rows"]], on: str, twice: bool = False
    ) -> Dependence:
        """The agreement of the residual with a prediction, by recording.

        **Arguments:**

        - `on`: what the prediction depends on.
        - `twice`: whether each recording has been predicted from the others.
        """
        # The deviation is that of these recordings, where noise may be stronger than where the
        # filter was estimated.
        count = sum(map(np.count_nonzero, self.residual))
        # If two recordings predict each other, their two products may be equal.
        independent = count / 2 if twice else count
        plain, white = (None, None) if self.basis is None else self.basis
        share = _alike(np.concatenate(predicted), np.concatenate(self.residual), plain)
        x, y = (_white(z, self.residual, self.filt) for z in (predicted, self.residual))
        deviations = float(np.sqrt(independent)) * _alike(x, y, white)
        return Dependence(max(share, 0.0) ** 2, deviations, on)


def _white(
    series: Sequence[Float[np.ndarray, "_rows *columns"]],
    residual: Sequence[Float[np.ndarray, " _rows"]],
    filt: ARFilter,
) -> Float[np.ndarray, "rows *columns"]:
    """The innovations of series of all recordings at the compared rows of a residual."""
    pairs = zip(series, residual, strict=True)
    return np.concatenate([filt.innovations(x, r != 0) for x, r in pairs])


def _alike(
    x: Float[np.ndarray, " rows"],
    y: Float[np.ndarray, " rows"],
    absorbed: Float[np.ndarray, "rows rank"] | None,
) -> float:
    """Cosine of the angle between two series, without the directions that are absorbed."""
    if absorbed is not None:
        x, y = (z - absorbed @ (absorbed.T @ z) for z in (x, y))
    return float(x @ y / max(np.linalg.norm(x) * np.linalg.norm(y), 1e-300))


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
    target, found = Target.of(others, joint, filt), []
    for regression in regressions:
        for used in trained.sets(joint):
            predicted = _predicted(regression, trained, others, joint, used, filt)
            found.append(target.dependence(predicted, regression.on))
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
    target, found = Target.of(rows, joint, filt), []
    for regression in regressions:
        for used in rows.sets(joint):
            predicted = []
            for k in every:
                others = rows.only([i for i in every if i != k])
                predicted += _predicted(regression, others, rows.only([k]), joint, used, filt)
            found.append(target.dependence(predicted, regression.on, twice=True))
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
    rows = ComparedRows.of_fit(fit, diagnosis)
    others = None if held_out is None else ComparedRows.of_comparison(held_out)
    error = over_recordings((fit if held_out is None else held_out).error_percent.to_numpy())
    least = allowed(fit.loop, worth)[1] / np.maximum(error, 1e-300)
    found = _dependent(rows, others, noise, dict(enumerate(least)))
    if found and held_out is not None and others is not None:
        # The linearisation along the held-out runs compiles a program, so it is made only now.
        others = others.with_base(held_out)
        found = _dependent(rows, others, noise, {j: least[j] for j in found})
    if not found:
        return ""
    j, seen = max(found.items(), key=lambda pair: pair[1].share)
    where = "fitted" if held_out is None else "held-out"
    return (
        f"on the {where} recordings the error of {joint_columns(fit.loop.joints)[j]} is "
        f"{error[j]:.3g} %, of which a regression on {seen.on}, trained on other recordings, "
        f"predicts {error[j] * np.sqrt(seen.share):.3g} %: an effect is missing that no examined "
        "model describes"
    )


def _dependent(
    rows: ComparedRows,
    others: ComparedRows | None,
    noise: Sequence[ARFilter],
    least: Mapping[int, float],
) -> dict[int, Dependence]:
    """Joints (from 0) whose residual depends on the motion by a relevant part.

    **Arguments:**

    - `least`: smallest relevant part of a joint's error, for the joints that are tried.
    """
    found = {}
    for j, part in least.items():
        seen = among(rows, j, noise[j]) if others is None else on_others(rows, others, j, noise[j])
        if seen is not None and seen.sure and np.sqrt(seen.share) > part:
            found[j] = seen
    return found
