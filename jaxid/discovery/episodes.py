"""Residuals that are large in a few short episodes, or in a single one, and small otherwise."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..estimate import Fit
from ..estimate.result import joint_columns
from ..simulation.dynamics import imposed
from .changes import JointRows, random_draws
from .diagnosis import Diagnosis
from .relevance import allowed
from .text import joined

# Windows of a recording, and smallest number of samples in each.
_WINDOWS, _SAMPLES = 100, 16
# Ratio of the mean power of a residual to its median over windows. It was at most 3.1 in
# simulations with bursts or heavy tails (benchmarks.worlds).
_CONCENTRATED = 9.0
# A single episode has this share of the squared residual of a recording, in at most this share of
# its rows. Noise and functions of the motion need more (`episode_of`).
_POWER, _LONGEST = 0.8, 0.25
# Shortest single episode, s. The error at a reversal of dry friction is shorter.
_SHORTEST = 0.2
# Deviations of noise above which a residual counts as large.
_LOUD = 3.0


def in_episodes(fit: Fit, worth: float) -> str:
    """The reason if most of a residual's power is in a few episodes; empty if it is not.

    A filter models such a residual as slow noise, and scores of models then say little. Along an
    imposed motion, short errors at reversals of friction are allowed.

    **Arguments:**

    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    if imposed(fit.loop):
        return ""
    error = fit.error_percent.to_numpy()
    labels = joint_columns(fit.loop.joints)
    for k, (recording, rest) in enumerate(zip(fit.recordings, fit.residuals, strict=True)):
        for j, label in enumerate(labels):
            there = np.flatnonzero(rest[:, j])
            power = _by_window(rest[there, j])
            quiet = error[k, j] * np.sqrt(np.median(power) / max(power.mean(), 1e-300))
            apart = power.mean() > _CONCENTRATED * np.median(power)
            if apart and error[k, j] ** 2 - quiet**2 > worth**2:
                row = there[np.argmax(np.abs(rest[there, j]))]
                time = recording.time[min(row, recording.samples - 1)]
                return (
                    f"the error of {label} on {recording.name} is {error[k, j]:.3g} %, but "
                    f"{quiet:.2g} % in most of the time: it is largest at {time:.3g} s, where a "
                    "limit, a stop or a contact may act, or torque was not recorded correctly"
                )
    return ""


def _by_window(rest: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " windows"]:
    """Mean square of a residual in windows; one window if there are few rows."""
    count = max(min(_WINDOWS, len(rest) // _SAMPLES), 1)
    return np.array(
        [np.mean(part**2) if len(part) else 0.0 for part in np.array_split(rest, count)]
    )


class Episode(eqx.Module):
    """A time in which the residual of a joint is larger than in the rest of a recording.

    - `recording`: its number. `start`, `end`: s.
    - `outside`: root mean square of the residual at other times, over that at all times.
    """

    recording: int
    start: float
    end: float
    outside: float


def in_one_episode(diagnosis: Diagnosis, worth: float) -> str:
    """The reason if the residual of joints is large in one episode only; empty if it is not.

    A push or a contact in one recording cannot be predicted from others, like noise, and the
    estimated values are wrong at all times. If a joint without an episode has the largest error
    above its noise floor, something else is the reason.

    **Arguments:**

    - `worth`: smallest relevant change, in % of a joint's torque.
    """
    fit = diagnosis.fit
    error, least = fit.error_percent.to_numpy(), allowed(fit.loop, worth)[1]
    if len(error) != len(diagnosis.data.residual) or fit.loop.controller.judged != "torque":
        return ""
    found = []
    for j in range(fit.loop.joints):
        one = episode_of(diagnosis, j)
        if one is not None and error[one.recording, j] * np.sqrt(1 - one.outside**2) > least:
            found.append((error[one.recording, j], j, one))
    if _worst_joint(diagnosis) not in [j for _, j, _ in found]:
        return ""
    percent, j, worst = max(found, key=lambda x: x[0])
    same = [
        (i, one)
        for _, i, one in found
        if one.recording == worst.recording and one.start < worst.end and worst.start < one.end
    ]
    start, end = min(one.start for _, one in same), max(one.end for _, one in same)
    labels = joint_columns(fit.loop.joints)
    others = [labels[i] for i, _ in same if i != j]
    also = f", and that of {joined(others)} is large at the same time" if others else ""
    return (
        f"on {fit.recordings.names[worst.recording]} the error of {labels[j]} is {percent:.3g} %, "
        f"but {percent * worst.outside:.2g} % without the time from {start:.3g} to {end:.3g} s"
        f"{also}: a push, a contact or a stop may act there, or torque was not recorded "
        "correctly; leave this time out (Recording.slice), or record again"
    )


def _worst_joint(diagnosis: Diagnosis) -> int:
    """The joint with the largest error above its measured noise floor, from 0."""
    floor = 0.0 if diagnosis.measured is None else np.nan_to_num(diagnosis.measured.percent)
    return int(np.argmax(np.max(diagnosis.fit.error_percent.to_numpy() - floor, axis=0)))


def episode_of(diagnosis: Diagnosis, joint: int) -> Episode | None:
    """The shortest time with most of a joint's squared residual on one recording.

    None if noise, or a random function of the motion, has most of its power in a time as short.

    **Arguments:**

    - `joint`: from 0.
    """
    rows, there = JointRows.of(diagnosis, joint), diagnosis.data.there[..., joint]
    number, time = np.nonzero(there)[0], np.asarray(diagnosis.motion.t)[there]
    draws, found = None, []
    for k in np.unique(number).tolist():
        own = number == k
        first, last = _shortest(rows.residual[own])
        length, most = last - first, _LONGEST * np.count_nonzero(own)
        start, end = time[own][first], time[own][last - 1]
        if length > most or end - start < _SHORTEST:
            continue
        # Most residuals have no candidate, and need no draws.
        if draws is None:
            draws = rows.without_base(random_draws(diagnosis, joint))
        shortest = min(b - a for a, b in map(_shortest, draws[own].T))
        if shortest > length:
            found.append(_whole(k, time[own], rows.residual[own], first, last))
    return min(found, key=lambda one: one.outside, default=None)


def _whole(
    recording: int,
    time: Float[np.ndarray, " rows"],
    rest: Float[np.ndarray, " rows"],
    first: int,
    last: int,
) -> Episode:
    """The episode with the rows before and after it in which the residual is still large."""
    square = rest**2
    # Most rows are outside, so the median is that of noise: 0.45 of its variance.
    loud = np.flatnonzero(square > _LOUD**2 * np.median(square) / 0.45)
    near = (last - first) // 4 + 1
    for row in loud[loud < first][::-1]:
        first = row if row >= first - near else first
    for row in loud[loud >= last]:
        last = row + 1 if row < last + near else last
    outside = np.delete(square, np.s_[first:last])
    ratio = np.sqrt(outside.mean() / square.mean()) if len(outside) else 0.0
    return Episode(recording, float(time[first]), float(time[last - 1]), float(ratio))


def _shortest(rest: Float[np.ndarray, " rows"]) -> tuple[int, int]:
    """First row of the shortest stretch with most of the power, and the row after its last one."""
    power = np.append(0.0, np.cumsum(rest**2))
    # Rounding may leave the last stretches without an end.
    last = np.minimum(np.searchsorted(power, power + _POWER * power[-1]), len(rest))
    enough = power[last] - power >= 0.999 * _POWER * power[-1]
    length = np.where(enough, last - np.arange(len(power)), len(rest) + 1)
    first = int(np.argmin(length))
    return first, int(last[first])
