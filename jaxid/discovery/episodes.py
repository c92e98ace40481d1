"""Residuals that are large in a few short episodes, and small in between."""

import numpy as np
from jaxtyping import Float

from ..estimate import Fit
from ..estimate.result import joint_columns
from ..simulation.dynamics import imposed

# Windows of a recording, and smallest number of samples in each.
_WINDOWS, _SAMPLES = 100, 16
# Ratio of the mean power of a residual to its median over windows. It was at most 3.1 in
# simulations with bursts or heavy tails (benchmarks.worlds).
_CONCENTRATED = 9.0


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
