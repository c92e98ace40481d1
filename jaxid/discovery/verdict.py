"""Tests that the final model must pass; otherwise the verdict is `undetermined`."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..estimate import Fit, Status
from ..estimate.mistakes import at_limit
from ..estimate.result import DOUBTFUL_PERCENT, joint_columns
from ..noise import ARFilter
from .comparison import Comparison
from .diagnosis import Diagnosis, over_recordings
from .episodes import in_episodes
from .explore import DECISIVE
from .floor import SPOKEN, Floor, floor_of
from .linear import row_period
from .loose import undetermined
from .models import listed
from .relevance import REFUTED, allowed
from .score import spanned
from .step import OnUnseen
from .system import System

Outcome = Literal["adequate", "explained", "outside_catalogue", "undetermined"]

# Smallest significant excess, in standard deviations.
_SURE = 4.0
# Ratio of the residual's power to that of its innovations above which it is not white noise.
_COLOURED = 1.5
# Largest ratio of the noise of a held-out recording to that of the fitted ones. An error that is
# larger over all frequencies may be that of a resonance.
_LOUDER = 2.0
# Smallest significant increase of the error on held-out recordings, in standard deviations.
_ROSE = 3.0


def misfit_of(fit: Fit) -> str:
    """The reason for a fit that explains almost nothing, with what to do."""
    return f"the fit of the model {fit.status.value}: {_to_check(fit)}"


def _to_check(fit: Fit) -> str:
    """The mistake in the data that explains a misfit, or what to check."""
    check = (
        "check the units of each joint, signs, the order of the joints, time stamps and the "
        "control law"
    )
    if limited := at_limit(fit.recordings):
        check = f"{limited}; cut out these stretches, or record a slower motion; otherwise {check}"
    return fit.mistake or check


def indefinite(chosen: Fit, added: int) -> str:
    """The reason if recordings determine no value of an added effect; empty if there is none.

    **Arguments:**

    - `chosen`: the fit of the model with the best score.
    - `added`: number of added effects; these are its loop's last ones.
    """
    loose = undetermined(chosen, added)
    if not loose:
        return ""
    return (
        f"the recordings determine no value of {listed(loose)}, although the error is larger "
        "without: together the added effects may approximate another law; record other motions"
    )


def refuted(
    chosen: Fit,
    noise: Sequence[ARFilter],
    diagnosis: Diagnosis,
    held_out: tuple[Comparison, Comparison] | None,
    worth: float,
) -> str:
    """The first test that a model fails, as a reason; empty if it passes all of them.

    **Arguments:**

    - `chosen`: the fit of the model with the best score.
    - `noise`: noise filters of its residual, one per output.
    - `diagnosis`: the diagnosis of the fit.
    - `held_out`: comparisons of the starting and the chosen model with held-out recordings; None if
      there are no such recordings.
    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    if chosen.status is Status.misfit:
        return misfit_of(chosen)
    if chosen.status is not Status.converged:
        return f"the fit of the model did not converge ({chosen.status.value})"
    reason = (
        explains_little(chosen, noise, diagnosis.measured)
        or _apart_in_time(chosen, diagnosis, worth)
        or _above_floor(chosen, diagnosis, worth)
        or _above_measured(chosen, diagnosis.measured, worth)
        or in_episodes(chosen, worth)
    )
    if held_out is None or reason:
        return reason
    return refuted_unseen(chosen, noise, diagnosis.measured, *held_out, worth)


def refuted_unseen(
    chosen: Fit,
    noise: Sequence[ARFilter],
    measured: Floor | None,
    before: Comparison,
    after: Comparison,
    worth: float,
) -> str:
    """The first test on held-out recordings that a model fails, as a reason.

    **Arguments:** as for `refuted`; `measured` is the noise floor of the fitted recordings without
    a model, `before` the starting model, and `after` the chosen one.
    """
    return (
        risen(before, after, noise, worth)
        or _above_noise(chosen, after, noise, worth)
        or _above_measured(after, _floor_of_unseen(chosen, measured, after), worth)
    )


def _floor_of_unseen(fit: Fit, measured: Floor | None, unseen: Comparison) -> Floor | None:
    """The measured noise floor of held-out recordings, without joints with coloured noise."""
    floor = floor_of(unseen.loop, unseen.recordings, fit.recordings)
    if floor is None or measured is None:
        return floor
    percent, low, high = (
        np.where(measured.coloured, np.nan, x) for x in (floor.percent, floor.low, floor.high)
    )
    return dataclasses.replace(floor, percent=percent, low=low, high=high)


def explains_little(fit: Fit, noise: Sequence[ARFilter], measured: Floor | None) -> str:
    """The reason if 30 % of a joint's torque are unexplained and not noise.

    **Arguments:**

    - `noise`: noise filters of the residual, one per output. `measured`: noise floor without a
      model.
    """
    left = over_recordings(fit.error_percent.to_numpy())
    floor = np.zeros(len(left))
    if measured is not None:
        floor = np.nan_to_num(over_recordings(measured.high))
    joints = joint_columns(fit.loop.joints)
    for label, percent, by_noise, filt in zip(joints, left, floor, noise, strict=True):
        large = percent > max(DOUBTFUL_PERCENT, REFUTED * by_noise)
        if large and filt.gain > _COLOURED:
            return (
                f"the error of {label} is {percent:.3g} %, and its residual is not white noise: "
                f"{_to_check(fit)}"
            )
    return ""


def _apart_in_time(fit: Fit, diagnosis: Diagnosis, worth: float) -> str:
    """The reason if torque seems shifted in time against motion.

    To first order the residual of a shift is the derivative of torque. No curve of one coordinate
    describes it, and a noise filter models it as coloured noise.
    """
    data, rates = diagnosis.data, _torque_rates(diagnosis)
    if rates is None:
        return ""
    # In units of each joint's noise, but without the noise filters, which may have modelled the
    # shift as noise.
    size = np.sqrt(np.sum(data.residual**2, axis=(0, 1)) / np.maximum(data.compared.sum(axis=0), 1))
    size = np.maximum(size, 1e-300)
    basis = spanned((data.base / size[:, None]).reshape(-1, data.base.shape[-1]))

    def not_absorbed(x: np.ndarray) -> np.ndarray:
        flat = (x / size).reshape(-1)
        return (flat - basis @ (basis.T @ flat)).reshape(x.shape)

    left, alone = not_absorbed(data.residual), np.eye(len(size))
    shifts = [not_absorbed(rates * data.there * own) for own in alone]
    # A shift of one joint resembles one of another joint, because all have one delay.
    gains = [np.sum(x * left) ** 2 / max(np.sum(x**2), 1e-300) for x in shifts]
    j = int(np.argmax(gains))
    own, percent = shifts[j], over_recordings(fit.error_percent.to_numpy())[j]
    if np.linalg.norm(own) < 1e-6 * np.linalg.norm(rates * data.there * alone[j] / size):
        return ""
    late = float(np.sum(own * left) / np.sum(own**2))
    filters = enumerate(diagnosis.noise)
    chance = np.sqrt(sum(f.product_variance(x[:, o] / size[o]) for o, f in filters for x in own))
    part = abs(late) * np.linalg.norm(own[..., j]) / np.linalg.norm(left[..., j])
    large = part**2 > 1 - 1 / REFUTED**2 and part * percent > worth
    if not large or abs(np.sum(own * left)) < _SURE * chance:
        return ""
    # Under an unknown law one delay of all joints is estimated.
    others = "relative to the other joints, " if fit.loop.controller.imposes else ""
    return (
        f"the residual of {joint_columns(fit.loop.joints)[j]} suggests that {others}its torque is "
        f"recorded {1e3 * abs(late):.3g} ms {'before' if late > 0 else 'after'} it acts: check "
        "time stamps, filters on one of the signals and delays of the drive"
    )


def _torque_rates(
    diagnosis: Diagnosis,
) -> Float[np.ndarray, "recordings samples joints"] | None:
    """Derivative of the torque by time at the compared rows; None if torque is not compared.

    Under an unknown law it is that by the delay, which contains the low-pass of the compared
    torque: steps of dry friction have no other derivative.
    """
    data, motion, place = diagnosis.data, diagnosis.motion, 0
    for p in diagnosis.fit.loop.free_parameters:
        if p.place == ("controller", "delay"):
            return data.base[..., place]
        place += p.size
    torque, time = np.asarray(motion.tau), np.asarray(motion.t)
    if torque.shape != data.residual.shape or data.residual.shape[1] < 3:
        return None
    return np.gradient(torque, row_period(time, data.mask), axis=1)


def over_rich(
    fit: Fit | Comparison, diagnosis: Diagnosis, worth: float
) -> Float[np.ndarray, " joints"]:
    """Errors over the noise floor where only many effects together explain more, otherwise zero.

    **Arguments:** as for `refuted`.
    """
    left = over_recordings(fit.error_percent.to_numpy())
    if diagnosis.unexplained < DECISIVE:
        return np.zeros(len(left))
    by_noise = diagnosis.floor_percent()
    limit, least = allowed(fit.loop, worth)
    ratio = np.where(left**2 - by_noise**2 > least**2, left / np.maximum(by_noise, 1e-12), 0.0)
    return np.where(ratio > limit, ratio, 0.0)


def over_measured(
    fit: Fit | Comparison, floor: Floor | None, worth: float
) -> Float[np.ndarray, "recordings joints"]:
    """Errors over the noise floor measured without a model where they exceed it, otherwise zero.

    **Arguments:** as for `refuted`; `floor` is that of the recordings of the fit.
    """
    left = fit.error_percent.to_numpy()
    if floor is None:
        return np.zeros(left.shape)
    limit, least = allowed(fit.loop, worth)
    matters = left**2 - np.nan_to_num(floor.percent) ** 2 > least**2
    ratio = np.where(matters & (left > limit * floor.high), left / floor.percent, 0.0)
    return np.where(ratio > limit, ratio, 0.0)


def _above_floor(fit: Fit, diagnosis: Diagnosis, worth: float) -> str:
    """The reason if only many effects together explain the residual."""
    ratio = over_rich(fit, diagnosis, worth)
    if not np.any(ratio):
        return ""
    worst = int(np.argmax(ratio))
    left = over_recordings(fit.error_percent.to_numpy())[worst]
    return (
        f"on the fitted recordings the error of {joint_columns(fit.loop.joints)[worst]} is "
        f"{left:.3g} %, and the noise floor {diagnosis.floor_percent()[worst]:.3g} %: neither the "
        "catalogue nor a curve of one coordinate explains the difference"
    )


def _above_measured(fit: Fit | Comparison, floor: Floor | None, worth: float) -> str:
    """The reason if the error of a joint is above the noise floor measured without a model."""
    ratio = over_measured(fit, floor, worth)
    if floor is None or not np.any(ratio):
        return ""
    r, j = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    left = fit.error_percent.to_numpy()[r, j]
    return (
        f"on {fit.recordings.names[r]} the error of {joint_columns(fit.loop.joints)[j]} is "
        f"{left:.3g} %, and the noise floor is {floor.low[r, j]:.3g} to "
        f"{floor.high[r, j]:.3g} % ({SPOKEN[floor.sources[r][j]]}): neither the catalogue nor "
        "a curve of one coordinate explains the difference"
    )


def risen(
    before: Comparison,
    after: Comparison,
    noise: Sequence[ARFilter],
    worth: float,
    added: str = "the added effects",
) -> str:
    """The reason if added effects raised the error on held-out recordings; empty if not.

    **Arguments:**

    - `before`, `after`: comparisons of the models without and with the added effects.
    - `noise`: noise filters of the residual of the later model, one per output.
    - `worth`: smallest relevant change, in % of a joint's torque.
    - `added`: the effects in words.
    """
    joints = _raised(before, after, noise, worth)
    if not joints:
        return ""
    was, now = (over_recordings(c.error_percent.to_numpy()) for c in (before, after))
    j = max(joints, key=lambda k: now[k] - was[k])
    return (
        f"{added} raised the error of {joint_columns(len(now))[j]} on held-out recordings from "
        f"{was[j]:.3g} to {now[j]:.3g} %: also fit recordings with motions like the held-out ones"
    )


def on_unseen(
    before: Comparison, after: Comparison, noise: Sequence[ARFilter], worth: float
) -> OnUnseen:
    """What an added effect does to the errors of the joints on held-out recordings.

    **Arguments:** as for `risen`.
    """
    raises = bool(_raised(before, after, noise, worth))
    if _raised(after, before, noise, worth):
        return "mixed" if raises else "lowers"
    return "raises" if raises else "unchanged"


def _raised(
    before: Comparison, after: Comparison, noise: Sequence[ARFilter], worth: float
) -> list[int]:
    """Joints, from 0, of which the second of two models has the larger held-out error."""
    errors = [over_recordings(c.error_percent.to_numpy()) for c in (before, after)]
    found = []
    for j, filt in enumerate(noise):
        pairs = [(b[:, j], a[:, j]) for b, a in zip(before.residuals, after.residuals, strict=True)]
        rise = sum(float(a @ a - b @ b) for b, a in pairs)
        changed = [b - a for b, a in pairs]
        moved = sum(float(d @ d) for d in changed)
        # Twice the standard deviation of the sum of noise times change, whose mean is zero.
        chance = 2 * np.sqrt(sum(filt.product_variance(d) for d in changed))
        if errors[1][j] - errors[0][j] > worth and rise + moved > _ROSE * chance:
            found.append(j)
    return found


def _above_noise(fit: Fit, held_out: Comparison, noise: Sequence[ARFilter], worth: float) -> str:
    """The reason if the held-out error is larger than noise and uncertain parameters explain."""
    # Noise may grow with the motion. Its power is that of the noisiest fitted recording, or the
    # estimate from the held-out recording itself if that is larger, up to a limit.
    fitted = np.max([_mean_square(r) for r in fit.residuals], axis=0)
    left = np.stack([_mean_square(r) for r in held_out.residuals])
    own = [[_power(f, r[:, j]) for j, f in enumerate(noise)] for r in held_out.residuals]
    power = np.clip(np.array(own), fitted, _LOUDER**2 * fitted)
    chance = np.stack(
        [[_chance(f, r[:, j]) for j, f in enumerate(noise)] for r in held_out.residuals]
    )
    percent = held_out.error_percent.to_numpy()

    def above(expected: np.ndarray) -> np.ndarray:
        ratio = left / np.maximum(expected, 1e-300)
        matters = percent**2 * (1 - 1 / np.maximum(ratio, 1.0)) > worth**2
        return np.where(matters & (ratio - 1 > _SURE * chance), np.sqrt(ratio), 0.0)

    if not np.any(above(power) > REFUTED):
        return ""
    # The linearisation along the held-out runs compiles a program, so it is made only if needed.
    expected = power + _unsure(fit, held_out)
    found = above(expected)
    if not np.any(found > REFUTED):
        return ""
    r, j = np.unravel_index(int(np.argmax(found)), found.shape)
    label = joint_columns(fit.loop.joints)[j]
    return (
        f"on the held-out recording {held_out.recordings.names[r]} the error of {label} is "
        f"{percent[r, j]:.3g} %, of which noise and uncertain parameters explain "
        f"{percent[r, j] / found[r, j]:.3g} %: also fit recordings with motions like this one"
    )


def _power(filt: ARFilter, rest: Float[np.ndarray, " samples"]) -> float:
    """Mean square of noise with the spectrum of a filter, at the level of a residual.

    The level is the median over frequencies. A missing effect hardly changes the median, because it
    is slow and concerns few frequencies.
    """
    there = rest != 0
    white = filt.innovations(rest, there)
    spectrum = np.abs(np.fft.rfft(white)[1:]) ** 2 / max(np.count_nonzero(there), 1)
    return float(np.median(spectrum) / np.log(2) * filt.gain)


def _mean_square(rest: Float[np.ndarray, "rows joints"]) -> Float[np.ndarray, " joints"]:
    """Mean square at the rows that are compared; the others are zero."""
    return np.sum(rest**2, axis=0) / np.maximum(np.count_nonzero(rest, axis=0), 1)


def _chance(filt: ARFilter, rest: Float[np.ndarray, " rows"]) -> float:
    """Relative standard deviation of the mean square of noise over that of `_power`."""
    rows = max(int(np.count_nonzero(rest)), 1)
    # The median of half as many exponential variables, over its expectation.
    return _spread(filt, rows) + 1 / (np.log(2) * np.sqrt(rows / 2))


def _spread(filt: ARFilter, rows: int) -> float:
    """Relative standard deviation of the mean square of noise from a filter."""
    power = filt.spectrum(max(rows, 64))
    return float(np.sqrt(2 / rows * np.mean(power**2)) / np.mean(power))


def _unsure(fit: Fit, held_out: Comparison) -> Float[np.ndarray, "recordings joints"]:
    """Mean square error of held-out recordings due to the uncertainty of the parameters."""
    system = System.of(held_out)
    slopes = system.base[..., : len(fit.names)]
    if len(slopes) != len(held_out.residuals):
        return np.zeros((len(held_out.residuals), fit.loop.joints))
    variance = np.where(np.isfinite(fit.covariance), fit.covariance, 0.0)
    loose = ~np.isfinite(np.diag(fit.covariance))
    shown = np.einsum("rsoa,ab,rsob->rso", slopes, variance, slopes)
    shown = shown + np.where(np.any(slopes[..., loose] != 0, axis=-1), np.inf, 0.0)
    kept = system.mask[..., None] & (system.residual != 0)
    return np.sum(np.where(kept, shown, 0.0), axis=1) / np.maximum(np.sum(kept, axis=1), 1)
