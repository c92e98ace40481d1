"""Tests that a chosen model must pass before a verdict sounds sure."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..estimate import Fit, Status
from ..estimate.result import joint_columns
from ..noise import ARFilter
from ..simulation.dynamics import imposed
from .causes import likely_cause
from .comparison import Comparison
from .diagnosis import Diagnosis, over_recordings
from .explore import DECISIVE
from .floor import SPOKEN, Floor, floor_of
from .models import LIKELY, Model
from .score import spanned
from .system import System

Outcome = Literal["adequate", "explained", "outside_catalogue", "undetermined"]

# Error over what noise predicts from which a model is refuted: recordings of one arm differ in
# their noise by a few per cent, and a tenth more error is seen in a figure.
_REFUTED = 1.10
# The same where the law is unknown, and how much must be left more, in % of the torque: filters on
# both signals, the ticks of the law and stiction leave that much beside noise.
_BLURRED, _BLUR = 1.30, 1.0
# Standard deviations that such an excess must be above chance.
_SURE = 4.0
# Share of a joint's torque in % that a model of a robot does not leave, and power of a residual
# over that of its innovations from which it is no white noise.
_THIRD, _COLOURED = 33.0, 1.5
# Probability that the starting model must have, for nothing to be missing.
_HALF = 0.5
# Deviations by which the error on held-out recordings must rise to speak against what was added.
_ROSE = 3.0


def misfit_of(fit: Fit) -> str:
    """Why a fit that explains next to nothing tells nothing, and what to do."""
    return f"the fit of the model {fit.status.value}: {_to_check(fit)}"


def _to_check(fit: Fit) -> str:
    """Which mistake explains a misfit, or what to look at."""
    return likely_cause(fit.loop, fit.recordings) or (
        "check the units of each joint, signs, the order of the joints, time stamps and the "
        "control law"
    )


def undecided(models: Sequence[Model], chosen: Model) -> str:
    """Whether the starting model shares the weight with the chosen one; empty if not."""
    start = next(m for m in models if not m.effects and m.curve is None)
    if not chosen.effects:
        if start.weight >= _HALF:
            return ""
        rival = next(m for m in models if m is not start)
        return (
            f"the model as it is has a probability of {start.weight:.2g} only, next to it "
            f"{rival.label} has {rival.weight:.2g}: record more, or longer"
        )
    if chosen.score < start.score - LIKELY:
        return ""
    return (
        f"the model as it was is only {start.score - chosen.score:.2g} behind in score, where "
        f"{LIKELY:.0f} are odds of 20 to 1: record more, or longer"
    )


def refuted(
    chosen: Fit,
    noise: Sequence[ARFilter],
    diagnosis: Diagnosis,
    held_out: tuple[Comparison, Comparison] | None,
    worth: float,
) -> str:
    """Why a model must not be called right; empty where nothing speaks against it.

    **Arguments:**

    - `chosen`: the fit of the model of the best score.
    - `noise`: filters of what the chosen model leaves, one an output.
    - `diagnosis`: of the chosen fit.
    - `held_out`: comparisons of the starting and the chosen model with recordings that no fit has
      seen.
    - `worth`: what is worth knowing, in % of a joint's torque.
    """
    if chosen.status is Status.misfit:
        return misfit_of(chosen)
    if chosen.status is not Status.converged:
        return f"the fit of the model did not converge ({chosen.status.value})"
    reason = (
        _explains_little(chosen, noise)
        or _apart_in_time(chosen, diagnosis, worth)
        or _above_floor(chosen, diagnosis, worth)
        or _above_measured(chosen, diagnosis.measured, worth)
    )
    if held_out is None or reason:
        return reason
    before, after = held_out
    return (
        risen(before, after, noise)
        or _above_noise(chosen, after, noise, worth)
        or _above_measured(after, floor_of(after.loop, after.recordings), worth)
    )


def _explains_little(fit: Fit, noise: Sequence[ARFilter]) -> str:
    """Whether much of a joint's torque is left that does not look like noise of a sensor."""
    left = over_recordings(fit.error_percent.to_numpy())
    for label, percent, filt in zip(joint_columns(fit.loop.joints), left, noise, strict=True):
        if percent > _THIRD and filt.gain > _COLOURED:
            return f"it leaves {percent:.3g} % of {label}, and not as white noise: {_to_check(fit)}"
    return ""


def _apart_in_time(fit: Fit, diagnosis: Diagnosis, worth: float) -> str:
    """Whether a part of what is left is there as if torque and motion had clocks of their own.

    To first order that is the torque's rate, which no curve of one coordinate is, and which a noise
    filter takes for slow noise.
    """
    data, motion = diagnosis.data, diagnosis.motion
    torque, time = np.asarray(motion.tau), np.asarray(motion.t)
    if torque.shape != data.residual.shape or data.residual.shape[1] < 3:
        return ""
    step = float(np.median(np.diff(time[0])))
    # Without the noise filters, which have taken such a part for noise.
    basis = spanned(data.base.reshape(-1, data.base.shape[-1]))
    left = data.residual.reshape(-1)
    left = left - basis @ (basis.T @ left)
    percent = over_recordings(fit.error_percent.to_numpy())
    for j, label in enumerate(joint_columns(fit.loop.joints)):
        rate = np.zeros_like(data.residual)
        rate[..., j] = np.gradient(torque[..., j], step, axis=1) * data.mask
        own = rate.reshape(-1)
        own = own - basis @ (basis.T @ own)
        late = float(own @ left) / max(float(own @ own), 1e-300)
        rows = own.reshape(rate.shape)
        pairs = enumerate(diagnosis.noise)
        chance = np.sqrt(sum(_through(f, x[:, o]) for o, f in pairs for x in rows))
        rest = left.reshape(rate.shape)[..., j]
        part = abs(late) * np.linalg.norm(rows[..., j]) / np.linalg.norm(rest)
        large = part**2 > 1 - 1 / _REFUTED**2 and part * percent[j] > worth
        if large and abs(float(own @ left)) > _SURE * chance:
            order = "before" if late > 0 else "after"
            return (
                f"what is left of {label} is as if its torque were recorded "
                f"{1e3 * abs(late):.3g} ms {order} it acts: check time stamps, filters on one of "
                "the signals and delays of the drive, which "
                f"jaxid.control.Tracking(delay={late:.3g}) knows of where the law is unknown"
            )
    return ""


def _above_floor(fit: Fit, diagnosis: Diagnosis, worth: float) -> str:
    """Whether many effects together explain what the score finds no few of them for."""
    if diagnosis.unexplained < DECISIVE:
        return ""
    left = over_recordings(fit.error_percent.to_numpy())
    by_noise = diagnosis.floor_percent()
    ratio = np.where(left**2 - by_noise**2 > worth**2, left / np.maximum(by_noise, 1e-12), 0.0)
    worst = int(np.argmax(ratio))
    if not ratio[worst] > _REFUTED:
        return ""
    label = joint_columns(fit.loop.joints)[worst]
    return (
        f"on the fitted recordings it leaves {left[worst]:.3g} % of {label}, of which noise "
        f"accounts for {by_noise[worst]:.3g} %: neither the catalogue nor a curve of one "
        "coordinate explains the difference"
    )


def _above_measured(fit: Fit | Comparison, floor: Floor | None, worth: float) -> str:
    """Whether a joint is left with more than the noise that its recordings show without a model."""
    if floor is None:
        return ""
    left = fit.error_percent.to_numpy()
    limit, least = (_BLURRED, max(worth, _BLUR)) if imposed(fit.loop) else (_REFUTED, worth)
    matters = left**2 - np.nan_to_num(floor.percent) ** 2 > least**2
    ratio = np.where(matters & (left > limit * floor.high), left / floor.percent, 0.0)
    if not np.any(ratio > limit):
        return ""
    r, j = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    return (
        f"on {fit.recordings.names[r]} it leaves {left[r, j]:.3g} % of "
        f"{joint_columns(fit.loop.joints)[j]}, where the noise of the torque is "
        f"{floor.low[r, j]:.3g} to {floor.high[r, j]:.3g} % "
        f"({SPOKEN[floor.sources[r][j]]}): neither the catalogue nor a curve of one coordinate "
        "explains the difference"
    )


def risen(before: Comparison, after: Comparison, noise: Sequence[ARFilter]) -> str:
    """Whether held-out recordings were described better without what was added; empty if not.

    **Arguments:**

    - `before`, `after`: comparisons with them, without and with what was added.
    - `noise`: filters of what the later model leaves, one an output.
    """
    errors = [over_recordings(c.error_percent.to_numpy()) for c in (before, after)]
    for j, filt in enumerate(noise):
        pairs = [(b[:, j], a[:, j]) for b, a in zip(before.residuals, after.residuals, strict=True)]
        rise = sum(float(a @ a - b @ b) for b, a in pairs)
        changed = [b - a for b, a in pairs]
        moved = sum(float(d @ d) for d in changed)
        # How far the sum of the noise times the change may be from nothing.
        chance = 2 * np.sqrt(sum(_through(filt, d) for d in changed))
        if rise > 0 and rise + moved > _ROSE * chance:
            label = joint_columns(after.loop.joints)[j]
            return (
                f"what was added raised the error of {label} on held-out recordings from "
                f"{errors[0][j]:.3g} to {errors[1][j]:.3g} %: fit recordings that move like those "
                "held out as well"
            )
    return ""


def _through(filt: ARFilter, x: Float[np.ndarray, " samples"]) -> float:
    """Variance of the sum of a series times noise of a filter."""
    size = 2 * len(x)
    return float(np.sum(np.abs(np.fft.fft(x, size)) ** 2 * filt.spectrum(size)) / size)


def _above_noise(fit: Fit, held_out: Comparison, noise: Sequence[ARFilter], worth: float) -> str:
    """Whether held-out recordings are left with more than noise and unsure parameters explain."""
    # The loudest of the fitted recordings, or what the held-out one itself shows of noise: noise
    # may grow with the motion.
    fitted = np.max([np.mean(r**2, axis=0) for r in fit.residuals], axis=0)
    left = np.stack([np.mean(r**2, axis=0) for r in held_out.residuals])
    own = [[_power(f, r[:, j]) for j, f in enumerate(noise)] for r in held_out.residuals]
    power = np.maximum(fitted, np.array(own))
    chance = np.array(
        [[_spread(f, len(r)) + 2 / np.sqrt(len(r)) for f in noise] for r in held_out.residuals]
    )
    percent = held_out.error_percent.to_numpy()

    def above(expected: np.ndarray) -> np.ndarray:
        ratio = left / np.maximum(expected, 1e-300)
        matters = percent**2 * (1 - 1 / np.maximum(ratio, 1.0)) > worth**2
        return np.where(matters & (ratio - 1 > _SURE * chance), np.sqrt(ratio), 0.0)

    if not np.any(above(power) > _REFUTED):
        return ""
    # Linearised along the held-out runs only where it may matter: it is a program of its own.
    expected = power + _unsure(fit, held_out)
    found = above(expected)
    if not np.any(found > _REFUTED):
        return ""
    r, j = np.unravel_index(int(np.argmax(found)), found.shape)
    label = joint_columns(fit.loop.joints)[j]
    return (
        f"on the held-out recording {held_out.recordings.names[r]} it leaves {percent[r, j]:.3g} % "
        f"of {label}, where noise accounts for "
        f"{percent[r, j] / found[r, j]:.3g} %: fit recordings that move like it "
        "as well, so that what is missing shows"
    )


def _power(filt: ARFilter, rest: Float[np.ndarray, " samples"]) -> float:
    """Mean square of noise whose spectrum has the shape of a filter, at the level of a residual.

    The level is the median over frequencies, which physics that a model lacks hardly moves: it is
    slow, and has but few of them.
    """
    white = filt.whiten(rest)[filt.order :]
    spectrum = np.abs(np.fft.rfft(white)[1:]) ** 2 / len(white)
    return float(np.median(spectrum) / np.log(2) * filt.gain)


def _spread(filt: ARFilter, samples: int) -> float:
    """Relative standard deviation of the mean square of noise from a filter."""
    power = filt.spectrum(max(samples, 64))
    return float(np.sqrt(2 / samples * np.mean(power**2)) / np.mean(power))


def _unsure(fit: Fit, held_out: Comparison) -> Float[np.ndarray, "recordings joints"]:
    """Mean square error of held-out recordings that follows from deviations of the parameters."""
    system = System.of(held_out)
    slopes = system.base[..., : len(fit.names)]
    if len(slopes) != len(held_out.residuals):
        return np.zeros((len(held_out.residuals), fit.loop.joints))
    variance = np.where(np.isfinite(fit.covariance), fit.covariance, 0.0)
    loose = ~np.isfinite(np.diag(fit.covariance))
    shown = np.einsum("rsoa,ab,rsob->rso", slopes, variance, slopes)
    shown = shown + np.where(np.any(slopes[..., loose] != 0, axis=-1), np.inf, 0.0)
    kept = system.mask[..., None]
    return np.sum(np.where(kept, shown, 0.0), axis=1) / np.sum(kept, axis=1)
