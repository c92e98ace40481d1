"""The linear system of a fitted loop along its recordings, on which effects act."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..errors import FitError
from ..estimate import Fit
from ..estimate.converge import from_best_starts
from ..estimate.minimise import Prior, simulated_with_slopes
from ..estimate.oem import oem_of
from ..estimate.pieces import compared_signals, estimated_starts, pieces_of
from ..estimate.prior import prior_of
from ..simulation.batch import Batch, prepare
from ..simulation.integration import SIGNALS
from ..simulation.loop import ClosedLoop
from ..simulation.perturbed import with_errors
from ..simulation.steps import with_substeps
from .comparison import Comparison
from .forces import left_for_links
from .linear import Linearised, at_samples, base_columns, linearise, sampled


class System(eqx.Module):
    """The loop linearised along its runs, and its residual.

    - `batch`: its band advances simulated signals by the delay of the torque.
    - `left`: torque that reaches the links, after the loop's own effects on the drives.
    - `residual`: measured minus simulated output at the samples, in the compared band.
    - `base`: derivatives of the output by the free parameters and by the estimated initial states.
    - `row`: index of the compared signal in `SIGNALS`.
    - `prior`: of the free parameters; None if nothing is known of them.
    """

    loop: ClosedLoop
    batch: Batch
    linear: Linearised
    left: Float[Array, "recordings points joints"]
    residual: Float[np.ndarray, "recordings samples outputs"]
    base: Float[np.ndarray, "recordings samples outputs absorbed"]
    row: int = eqx.field(static=True)
    prior: Prior | None = None

    @classmethod
    def of(
        cls,
        fit: Fit | Comparison,
        errors: Sequence[Float[np.ndarray, "_samples joints"]] | None = None,
    ) -> "System":
        """The system of a fitted loop.

        **Arguments:**

        - `errors`: added to a motion that is imposed, by piece of the recordings, rad or m.

        **Raises:** `FitError` if the loop cannot be simulated.
        """
        loop = with_substeps(fit.loop, fit.recordings)
        output, batch, free = _as_fitted(fit, loop)
        if errors is not None:
            pieces = pieces_of(fit.recordings, oem_of(fit).window)
            batch = with_errors(loop, pieces, batch, errors)
        linear = linearise(loop, batch, output)
        row = SIGNALS.index(output)
        residual, base = _residual_and_base(batch, linear, loop, output, free)
        if not np.isfinite(residual).all() or not np.isfinite(base).all():
            raise FitError(
                f"{loop.name} cannot be simulated at its fitted values, so it has no residual to "
                "analyse: fit it by OEM first"
            )
        left = left_for_links(loop, linear.motion)
        prior = prior_of(loop, fit.recordings)
        return cls(loop, advanced(batch, loop), linear, left, residual, base, row, prior)

    @property
    def known(self) -> Prior | None:
        """The prior of changes of the base's values; of initial states nothing is known."""
        if self.prior is None:
            return None
        rows, expected = np.asarray(self.prior.rows), np.asarray(self.prior.expected)
        more = self.base.shape[-1] - len(expected)
        changes = expected - np.asarray(self.loop.theta)
        return Prior(np.pad(rows, ((0, 0), (0, more))), np.pad(changes, (0, more)))

    @property
    def mask(self) -> Bool[np.ndarray, "recordings samples"]:
        """Whether each sample is compared."""
        return np.asarray(self.batch.kept)


def _as_fitted(fit: Fit | Comparison, loop: ClosedLoop) -> tuple[str, Batch, np.ndarray]:
    """The compared output, the batch, and whether each initial state is free, as in the fit."""
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


def advanced(batch: Batch, loop: ClosedLoop) -> Batch:
    """The batch for simulated signals, which precede the measured ones by the law's delay."""
    if batch.band is None:
        return batch
    return dataclasses.replace(batch, band=batch.band.advanced(loop.controller.late))


def _residual_and_base(
    batch: Batch, linear: Linearised, loop: ClosedLoop, output: str, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    seen = sampled(batch, np.asarray(linear.seen[:, :, {"tau": 0, "q": 1}[output]]))
    mask = np.asarray(batch.mask)[..., None]
    simulated, by_delay = simulated_with_slopes(loop, batch, jnp.asarray(seen * mask))
    residual = np.asarray(batch.compared(getattr(batch, output) * mask) - simulated)
    p = loop.theta.shape[0]
    columns = np.asarray(base_columns(linear, p, bool(free.any())))
    base = at_samples(advanced(batch, loop), columns)
    base[..., :p] += np.asarray(by_delay)
    if not free.any():
        return residual, base
    shared, own = base[..., :p], base[..., p:]
    blocks = [shared]
    for k in np.flatnonzero(free):
        alone = np.zeros_like(own)
        alone[k] = own[k]
        blocks.append(alone)
    return residual, np.concatenate(blocks, axis=-1)
