"""Every effect of the catalogue held against the residual of one fit, without a refit."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..display.progress import working
from ..effects import AbstractTransmission
from ..effects import catalogue as known
from ..errors import FitError
from ..estimate import Fit
from ..estimate.converge import from_best_starts
from ..estimate.oem import oem_of
from ..estimate.pieces import compared_signals, estimated_starts, pieces_of
from ..recording import Recordings
from ..simulation.batch import Batch, prepare
from ..simulation.loop import ClosedLoop
from ..simulation.steps import with_substeps
from .comparison import Comparison
from .diagnosis import Diagnosis
from .hypotheses import Hypothesis, candidates, curves, survey
from .linear import Linearised, at_samples, base_columns, linearise, sampled
from .ranking import judge
from .score import Data
from .signatures import signatures


def diagnose(
    fit: Fit | Comparison,
    *,
    catalogue: Sequence[Any] = known,
    significance: float = 0.01,
    progress: bool = True,
) -> Diagnosis:
    """Screens every effect of a catalogue, on all joints, at all settings, from one fit.

    Exact sensitivities make it cheap: the closed loop is linearised along its runs, and every
    hypothesis is the response of that linear system to its torque.

    **Arguments:**

    - `fit`: of a loop that can be simulated; or a comparison of a loop with recordings.
    - `catalogue`: effect classes, effects, or functions from a `Scene` to effects; for instance
      `(*jaxid.catalogue, Mine)`.
    - `significance`: corrected p-value below which something counts as missing.

    **Raises:** `FitError` where the fitted loop cannot be simulated; `RecordingError` where
    recordings were sampled at different rates.
    """
    fit.recordings.common_period()
    if fit.error_percent.to_numpy().max() < 1e-8:
        raise FitError(
            f"{fit.loop.name} leaves nothing of these recordings but rounding: they were simulated "
            "with it, and there is nothing to diagnose"
        )
    with working(f"diagnosis of {fit.loop.name}", progress) as say:
        loop = with_substeps(fit.loop, fit.recordings)
        output, batch, free = _as_fitted(fit, loop)
        say("linearising along the recordings")
        linear = linearise(loop, batch, output)
        residual, base = _residual_and_base(batch, linear, loop, output, free)
        if not np.isfinite(residual).all() or not np.isfinite(base).all():
            raise FitError(
                f"{loop.name} cannot be simulated at its fitted values, so nothing can be held "
                "against its residual: fit it by OEM first"
            )
        tones, trials = _tones(residual, np.asarray(batch.kept), fit.recordings)
        scene = survey(loop, fit.recordings, linear.motion, tones)
        proposed = candidates(catalogue, scene, trials)
        parted = {e.joint for e in loop.effects if isinstance(e, AbstractTransmission)}
        proposed = [
            (effect, tests)
            for effect, tests in proposed
            if not (isinstance(effect, AbstractTransmission) and effect.joint in parted)
        ]
        proposed += [(curve, 1.0) for curve in curves(scene, linear.motion)]
        row = {"tau": 0, "q": 1}[output]
        hypotheses, table = signatures(loop, batch, linear, proposed, row, say)
        _check_finite(loop, hypotheses, table)
        table = at_samples(batch, table)
        data = Data(residual=residual, base=base, table=table, mask=np.asarray(batch.kept))
        say(f"scoring {len(hypotheses)} hypotheses")
        try:
            motion = sampled(batch, linear.motion)
            return judge(fit, data, hypotheses, scene, motion, significance)
        except np.linalg.LinAlgError as error:
            raise FitError(
                f"what is left of these recordings by {loop.name} is too large to be held against "
                "anything: check the units of the recordings and the loop's gains"
            ) from error


def _check_finite(
    loop: ClosedLoop,
    hypotheses: Sequence[Hypothesis],
    table: Float[np.ndarray, "recordings points outputs columns"],
) -> None:
    """Raises `FitError` where a signature is not finite."""
    there = np.asarray(np.isfinite(table).all(axis=(0, 1, 2)))
    bad = [h for h in hypotheses if not there[list(h.columns)].all()]
    if len(bad) > len(hypotheses) / 2:
        raise FitError(
            f"{loop.name} runs away once it is linearised along these recordings: take smaller "
            "steps, jaxid.Stepping(substeps=...)"
        )
    if bad:
        first = bad[0]
        raise FitError(
            f"the signature of {first.name} on joint {first.joint or 'all'} is not finite along "
            "these recordings: mend its torque, or leave it out of the catalogue"
        )


def _as_fitted(fit: Fit | Comparison, loop: ClosedLoop) -> tuple[str, Batch, np.ndarray]:
    """Which output is compared, the batch, and which initial states are free, as in the fit."""
    method = oem_of(fit)
    pieces = pieces_of(fit.recordings, method.window)
    batch = prepare(loop, pieces)
    free = estimated_starts(method, pieces, batch)
    if free.any():
        start, n = getattr(getattr(fit, "optimum", None), "start", None), loop.joints
        if start is not None and len(start) == len(pieces):
            batch = dataclasses.replace(batch, q0=start[:, :n], v0=start[:, n:])
        else:
            batch = from_best_starts(method, loop, pieces, batch)
    return compared_signals(method, loop)[0], batch, free


def _residual_and_base(
    batch: Batch, linear: Linearised, loop: ClosedLoop, output: str, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    seen = sampled(batch, np.asarray(linear.seen[:, :, {"tau": 0, "q": 1}[output]]))
    residual = (np.asarray(getattr(batch, output)) - seen) * np.asarray(batch.mask)[..., None]
    if batch.band is not None:
        residual = np.asarray(batch.band(jnp.asarray(residual)))
    p = loop.theta.shape[0]
    base = at_samples(batch, np.asarray(base_columns(linear, p, bool(free.any()))))
    if not free.any():
        return residual, base
    shared, own = base[..., :p], base[..., p:]
    blocks = [shared]
    for k in np.flatnonzero(free):
        alone = np.zeros_like(own)
        alone[k] = own[k]
        blocks.append(alone)
    return residual, np.concatenate(blocks, axis=-1)


def _tones(
    residual: np.ndarray, mask: np.ndarray, recordings: Recordings, most: int = 4
) -> tuple[list[list[float]], float]:
    """Frequencies that stand out of each joint's spectrum, and how many they were picked from."""
    period = recordings.common_period()
    n = residual.shape[1]
    f = np.fft.rfftfreq(4 * n, period)
    usable = (f > 2 / (n * period)) & (f < 0.4 / period)
    found = []
    for j in range(residual.shape[2]):
        power = np.zeros(len(f))
        for row, there in zip(residual[..., j], mask, strict=True):
            window = np.zeros(n)
            window[there] = np.hanning(int(there.sum()))
            power += np.abs(np.fft.rfft(row * window, 4 * n)) ** 2
        # Against the level around it, so that coloured noise does not take every place.
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
