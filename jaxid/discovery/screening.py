"""Screening: every effect of the catalogue is compared with the residual of one fit."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..display.progress import working
from ..effects import AbstractEffect, AbstractTransmission, Scene
from ..effects import catalogue as known
from ..errors import FitError
from ..estimate import Fit
from ..recording import Recordings
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from ..simulation.sharing import with_one_blas_thread
from .comparison import Comparison
from .data import Data
from .diagnosis import Diagnosis
from .hypotheses import Hypothesis, candidates, curves, survey
from .linear import at_rows, row_period
from .ranking import Screened, judge
from .signatures import signatures
from .system import System
from .table import SignatureTable


@with_one_blas_thread
def diagnose(
    fit: Fit | Comparison,
    *,
    catalogue: Sequence[Any] = known,
    significance: float = 0.01,
    progress: bool = True,
) -> Diagnosis:
    """Ranks the effects of a catalogue, on all joints and at all settings, by one fit.

    The closed loop is linearised along its runs. The signature of an effect is the response of this
    linear system to the torque of the effect. A signature that explains a part of the residual is
    evidence for the effect (score test: Rao 1948). No model is fitted again.

    **Arguments:**

    - `fit`: a fit of a loop that can be simulated, or a comparison of a loop with recordings.
    - `catalogue`: effect classes, effects, or functions from a `Scene` to effects; for instance
      `(*jaxid.catalogue, Mine)`.
    - `significance`: corrected p-value below which an effect counts as missing.
    - `progress`: whether to show the progress.

    **Raises:** `FitError` if the fitted loop cannot be simulated, or if the residual is only
    rounding; `RecordingError` if the recordings have different sample rates.
    """
    fit.recordings.common_period()
    if fit.error_percent.to_numpy().max() < 1e-8:
        raise FitError(
            f"the residual of {fit.loop.name} on these recordings is only rounding, because they "
            "were simulated with this model: a diagnosis is not possible"
        )
    with working(f"diagnosis of {fit.loop.name}", progress) as say:
        return judge(fit, screen(fit, catalogue, say), significance, say)


def screen(fit: Fit | Comparison, catalogue: Sequence[Any], say: Callable[[str], None]) -> Screened:
    """The linear system of a fit, and the signatures of all hypotheses.

    **Arguments:** as for `diagnose`.
    """
    say("linearising along the recordings")
    system = System.of(fit)
    loop, linear = system.loop, system.linear
    scene, proposed = offered(system, fit.recordings, catalogue)
    proposed += [(curve, 1.0) for curve in curves(scene, linear.motion)]
    hypotheses, table = signatures(loop, system.batch, linear, proposed, system.row, say)
    _check_finite(loop, hypotheses, table)
    data = Data(
        residual=system.residual,
        base=system.base,
        table=table,
        mask=system.mask,
        known=system.known,
    )
    say(f"scoring {len(hypotheses)} hypotheses")
    return Screened(system, tuple(hypotheses), data, scene)


# Largest error of the linear system at other parameter values, as a share of the residual's power,
# for which its signatures are used at these values as well.
_ERRS = 1e-4


def carried(screened: Screened, before: Fit, after: Fit) -> Screened | None:
    """The screening of one fit, for another fit of the same loop with almost the same values.

    None if the linear system does not predict the residual of the other fit.

    **Arguments:**

    - `before`: the screened fit. `after`: a fit with other values of the same parameters.
    """
    mask, count = screened.data.mask, len(after.names)
    sizes = [len(r) for r in after.residuals]
    if before.names != after.names or sizes != mask.sum(axis=1).tolist():
        return None
    left = np.zeros_like(screened.data.residual)
    for k, r in enumerate(after.residuals):
        left[k, mask[k]] = r
    system = screened.system
    moved = np.asarray(after.theta) - np.asarray(before.theta)
    base = screened.data.base[..., :count]
    error = left - (screened.data.residual - base @ moved)
    if not np.sum(error**2) < _ERRS * np.sum(left**2):
        return None
    loop = system.loop.with_theta(jax.device_put(after.theta))
    system = dataclasses.replace(system, loop=loop, residual=left)
    data = dataclasses.replace(screened.data, residual=left, known=system.known)
    return dataclasses.replace(screened, system=system, data=data)


def offered(
    system: System, recordings: Recordings, catalogue: Sequence[Any]
) -> tuple[Scene, list[tuple[AbstractEffect, float]]]:
    """Effects of a catalogue that can be missing in a model, each with its number of tests.

    **Arguments:**

    - `system`: linear system of the fitted model. `recordings`: the fitted recordings.
    - `catalogue`: as for `diagnose`.

    **Returns:** the scene, and pairs of an effect and the number of settings that it stands for.
    """
    loop, motion = system.loop, system.linear.motion
    time = np.asarray(at_rows(system.batch, motion.t))
    tones, trials = tones_of(system.residual, system.mask, time)
    scene = survey(loop, recordings, motion, tones)
    parted = {e.joint for e in loop.effects if isinstance(e, AbstractTransmission)}
    proposed = [
        (effect, tests)
        for effect, tests in candidates(catalogue, scene, trials)
        if not (isinstance(effect, AbstractTransmission) and effect.joint in parted)
        and _can_be_told(loop, effect)
    ]
    return scene, proposed


def not_examined(loop: ClosedLoop, scene: Scene, catalogue: Sequence[Any]) -> list[str]:
    """The effects of a catalogue, in words, that the recordings cannot show with this controller.

    **Arguments:** as for `diagnose`.
    """
    proposed = [effect for effect, _ in candidates(catalogue, scene, 1.0)]
    left_out = [e.spoken() for e in proposed if not _can_be_told(loop, e)]
    return list(dict.fromkeys(left_out))


def _can_be_told(loop: ClosedLoop, effect: AbstractEffect) -> bool:
    """Whether the recordings can show an effect, with this controller.

    Elasticity, and a drive with states, need a simulated law. If the law is unknown, a virtual law
    is simulated for them. For a spatial arm it takes minutes to compile, and the result depends on
    the virtual law more than on the arm.
    """
    return loop.arm.planar() or not imposed(loop) or imposed(loop.add(effect))


def _check_finite(
    loop: ClosedLoop,
    hypotheses: Sequence[Hypothesis],
    table: SignatureTable,
) -> None:
    """Raises `FitError` if a signature is not finite."""
    there = table.finite
    bad = [h for h in hypotheses if not there[list(h.columns)].all()]
    if len(bad) > len(hypotheses) / 2:
        raise FitError(
            f"the linearisation of {loop.name} along these recordings diverges: use smaller steps, "
            "jaxid.Stepping(substeps=...)"
        )
    if bad:
        first = bad[0]
        raise FitError(
            f"the signature of {first.name} on joint {first.joint or 'all'} is not finite along "
            "these recordings: correct its torque, or leave it out of the catalogue"
        )


def tones_of(
    residual: Float[np.ndarray, "recordings rows joints"],
    mask: Bool[np.ndarray, "recordings rows"],
    time: Float[np.ndarray, "recordings rows"],
    most: int = 4,
) -> tuple[list[list[float]], float]:
    """Peak frequencies of each joint's spectrum, and the number of candidate frequencies.

    **Arguments:**

    - `mask`: rows that are not padding. `time`: of the rows, s; uneven if samples are missing.
    - `most`: number of peaks of each joint.
    """
    period = row_period(time, mask)
    even = [_evened(*row, period) for row in zip(time, residual, mask, strict=True)]
    n = max(map(len, even))
    f = np.fft.rfftfreq(4 * n, period)
    usable = (f > 2 / (n * period)) & (f < 0.4 / period)
    found = []
    for j in range(residual.shape[2]):
        power = np.zeros(len(f))
        for rows in even:
            power += np.abs(np.fft.rfft(rows[:, j] * np.hanning(len(rows)), 4 * n)) ** 2
        # Relative to the level around it, so that coloured noise does not give all the peaks.
        width = max(9, n // 20)
        around = np.exp(np.convolve(np.log(power + 1e-300), np.ones(width) / width, mode="same"))
        stands = np.where(usable, power / around, 0.0)
        row = []
        for _ in range(most):
            k = int(stands.argmax())
            row.append(float(f[k]))
            stands[np.abs(f - f[k]) < 2 / (n * period)] = 0.0
        found.append(row)
    return found, float(usable.sum() / 4 * residual.shape[2])


def _evened(
    time: Float[np.ndarray, " rows"],
    residual: Float[np.ndarray, "rows joints"],
    there: Bool[np.ndarray, " rows"],
    period: float,
) -> Float[np.ndarray, "even joints"]:
    """A residual at evenly spaced times; a tone would change its phase at missing samples."""
    own = time[there]
    at = own[0] + period * np.arange(round((own[-1] - own[0]) / period) + 1)
    return np.stack([np.interp(at, own, rows) for rows in residual[there].T], axis=1)
