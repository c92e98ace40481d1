"""IDIM-LS: least squares on the inverse dynamic model."""

import time
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import FitError
from ..parameters import Bounds, Parameter, write_values
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from .regression import Filtering, decimator, filtered, linear_parameters, regression
from .result import (
    AbstractMethod,
    Fit,
    Status,
    determined_covariance,
    relative_errors,
    unphysical,
)

Weights = Literal["ordinary", "joint", "robust"]


class Stacked(eqx.Module):
    """The decimated regression of all recordings: columns, right-hand side, recording by row."""

    columns: Float[np.ndarray, "samples joints parameters"]
    right: Float[np.ndarray, "samples joints"]
    scales: Float[np.ndarray, " parameters"]
    lengths: tuple[int, ...] = eqx.field(static=True)

    def split(self, rows: Float[np.ndarray, "samples *axes"]) -> list[np.ndarray]:
        """Rows by recording."""
        return np.split(rows, np.cumsum(self.lengths)[:-1])


def stack(loop: ClosedLoop, recordings: Recordings, filtering: Filtering, motions=None) -> Stacked:
    """Columns and right-hand side of equation (4) for all recordings.

    **Arguments:**

    - `loop`: the model.
    - `filtering`: filter of the motion and, in parallel, of torque and columns.
    - `motions`: simulated signals instead of the filtered ones, one for each recording.

    **Raises:** `FitError` if the filtering does not suit a recording.
    """
    columns, rights = [], []
    for k, recording in enumerate(recordings):
        own = filtering.on(recording)
        motion = filtered(recording, own) if motions is None else motions[k]
        wide, right = regression(loop, recording, motion)
        reduce = decimator(recording, own)
        columns.append(reduce(wide))
        rights.append(reduce(right))
    scales = np.asarray(Bounds.of(linear_parameters(loop)).scale)
    lengths = tuple(len(r) for r in rights)
    return Stacked(np.concatenate(columns), np.concatenate(rights), scales, lengths)


def stack_with_motion(
    loop: ClosedLoop, recordings: Recordings
) -> tuple[Stacked, dict[str, Float[np.ndarray, "samples joints"]]]:
    """The regression along the filtered motion, with q, a and the recorded tau of its rows.

    **Raises:** `FitError` if a recording cannot be filtered.
    """
    filtering = Filtering()
    settled = [filtering.on(r) for r in recordings]
    motions = [filtered(r, own) for r, own in zip(recordings, settled, strict=True)]
    reduce = [decimator(r, own) for r, own in zip(recordings, settled, strict=True)]
    rows = {
        name: np.concatenate(
            [to(np.asarray(getattr(m, name))) for to, m in zip(reduce, motions, strict=True)]
        )
        for name in ("q", "a", "tau")
    }
    return stack(loop, recordings, filtering, motions), rows


class Solved(eqx.Module):
    """A solved regression."""

    theta: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    residual: Float[np.ndarray, "samples joints"]
    undetermined: tuple[str, ...] = eqx.field(static=True)


def solve(
    stacked: Stacked,
    names: tuple[str, ...],
    weights: Weights,
    instruments: Float[np.ndarray, "samples joints parameters"] | None = None,
) -> Solved:
    """Least squares, or instrumental variables if instruments are given.

    Weighted: rows are weighted by their joint's deviation, estimated from an ordinary solution.
    Robust: each row has Huber's weight in addition.
    """
    joints, p = stacked.right.shape[1], stacked.columns.shape[2]
    if stacked.right.size <= p:
        raise FitError(
            f"{stacked.right.size} equations cannot determine {p} parameters: give longer "
            "recordings, or decimate less"
        )
    weight = np.ones_like(stacked.right)
    left = stacked.columns if instruments is None else instruments
    for _ in range({"ordinary": 1, "joint": 3, "robust": 20}[weights]):
        wide = (weight[..., None] * stacked.columns).reshape(-1, p)
        right = (weight * stacked.right).reshape(-1)
        tools = (weight[..., None] * left).reshape(-1, p)
        scale = _lengths(wide)
        gram = (tools / scale).T @ (wide / scale)
        theta = np.linalg.lstsq(gram, (tools / scale).T @ right, rcond=1e-12)[0] / scale
        residual = stacked.right - stacked.columns @ theta
        sigma = np.sqrt(np.mean((weight * residual) ** 2))
        if weights != "ordinary":
            spread = np.sqrt(np.mean(residual**2, axis=0))
            if weights == "robust":
                spread = 1.4826 * np.median(np.abs(residual), axis=0)
            spread = np.where(spread > 0, spread, 1.0)
            weight = np.broadcast_to(1 / spread, residual.shape).copy()
        if weights == "robust":
            large = np.abs(residual) / spread
            weight *= np.sqrt(np.minimum(1.0, 1.345 / np.maximum(large, 1e-12)))
    count = stacked.right.shape[0] - p / joints
    variance = sigma**2 * stacked.right.shape[0] / count
    if instruments is not None:
        # Instruments determine only directions that they share with the columns.
        basis, size, _ = np.linalg.svd(tools / _lengths(tools), full_matrices=False)
        wide = basis[:, size > 1e-11 * size[0]].T @ wide
    information = wide.T @ wide / variance
    covariance, lost = determined_covariance(information, names, stacked.scales)
    return Solved(theta, covariance, residual, lost)


def _lengths(columns: Float[np.ndarray, "rows parameters"]) -> Float[np.ndarray, " parameters"]:
    """Norms of columns; one for zero columns."""
    size = np.linalg.norm(columns, axis=0)
    return np.where(size > 0, size, 1.0)


def regression_fit(
    loop: ClosedLoop,
    recordings: Recordings,
    method: AbstractMethod,
    stacked: Stacked,
    solved: Solved,
    started: float,
    status: Status = Status.converged,
    iterations: int = 1,
) -> Fit:
    """The `Fit` of a solved regression."""
    chosen = linear_parameters(loop)
    fitted = write_values(loop, chosen, jnp.asarray(solved.theta))
    shaped = [p.name for p in loop.free_parameters if not p.declaration.linear]
    fitted = fitted.hold(*shaped) if shaped else fitted
    notes = []
    if shaped:
        notes.append(f"{', '.join(shaped)} not estimated, because torque is not linear in them")
    notes += _beyond_bounds(chosen, solved.theta)
    wrong = unphysical(fitted)
    if wrong and status is Status.converged:
        status = Status.unphysical
    notes += wrong
    measured = stacked.split(stacked.right)
    residuals = stacked.split(solved.residual)
    return Fit(
        loop=fitted,
        recordings=recordings,
        method=method,
        status=status,
        covariance=solved.covariance,
        residuals=tuple(residuals),
        error_percent=relative_errors(recordings, measured, residuals),
        iterations=iterations,
        seconds=time.perf_counter() - started,
        deviations="least squares, equation (5)",
        undetermined=solved.undetermined,
        notes=tuple(notes),
    )


def _beyond_bounds(chosen: Sequence[Parameter], theta: Float[np.ndarray, " p"]) -> list[str]:
    """A note on values outside their bounds, which a regression does not enforce."""
    bounds = Bounds.of(chosen)
    low, high = (np.asarray(x) for x in (bounds.lower, bounds.upper))
    names = [name for p in chosen for name in p.names]
    outside = [n for n, out in zip(names, (theta < low) | (theta > high), strict=True) if out]
    if not outside:
        return []
    return [f"{', '.join(outside)} outside the declared bounds: regressions do not enforce bounds"]


class IDIM(AbstractMethod):
    """Least squares on the inverse dynamic model, equations (4) and (5) of Brunot et al. 2016.

    Errors are relative to the filtered and decimated torque.

    **Arguments:**

    - `filtering`: filter of the motion, in Hz.
    - `weights`: `"ordinary"`, `"joint"` (each joint by its own deviation) or `"robust"` (Huber).
    """

    rigid = True
    filtering: Filtering = Filtering()
    weights: Weights = eqx.field(static=True, default="joint")

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the parameters in which torque is linear; called by `jaxid.fit`."""
        started = time.perf_counter()
        stacked, solved = self.solved(loop, recordings)
        return regression_fit(loop, recordings, self, stacked, solved, started)

    def solved(self, loop: ClosedLoop, recordings: Recordings) -> tuple[Stacked, Solved]:
        """The regression and its solution."""
        stacked = stack(loop, recordings, self.filtering)
        names = tuple(name for p in linear_parameters(loop) for name in p.names)
        return stacked, solve(stacked, names, self.weights)
