"""Encoder quantisation in a regression: covariance of the rows, generalised least squares."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..effects import Motion
from ..errors import FitError
from ..recording import Recording
from ..simulation.loads import inverse
from ..simulation.loop import ClosedLoop
from .regression import effect_states
from .result import determined_covariance
from .states import AbstractStates, FourierStates

# Errors of (position, velocity, acceleration) in the rows of a regression.
Kernels = Callable[[Float[np.ndarray, "samples columns"]], Float[np.ndarray, "3 samples columns"]]


class Stationary(eqx.Module):
    """Correlations of the errors of q, v, a between rows, for white position errors of variance 1.

    `by_lag[m, k, l]` is the correlation of signal k at a row with signal l `m` rows earlier.
    """

    by_lag: Float[np.ndarray, "lags 3 3"]


class LowRank(eqx.Module):
    """Errors of q, v, a in the rows as `factor` times independent errors, for a Fourier series."""

    factor: Float[np.ndarray, "3 rows coefficients"]


def errors_of(
    recording: Recording, states: AbstractStates, kernels: Kernels, rows: slice, factor: int
) -> Stationary | LowRank:
    """Covariance of the rows of a regression due to white errors of the recorded position.

    **Arguments:**

    - `states`: how velocities were estimated. `kernels`: impulse responses from position to the
      rows, through the states and the regression's filter.
    - `rows`: the samples of the rows. `factor`: number of samples between rows.
    """
    import scipy

    if isinstance(states, FourierStates):
        basis = states.basis(recording)[0]
        # Orthonormal columns: the errors of their amplitudes are white again.
        orthogonal, _ = np.linalg.qr(basis)
        return LowRank(kernels(orthogonal)[:, rows])
    memory = states.memory(recording)
    assert memory is not None
    span = memory + (rows.start or 0)
    length = 2 * span + 1
    impulse = np.zeros((length, 1))
    impulse[span] = 1.0
    answer = kernels(impulse)[..., 0]
    cross = np.array(
        [[scipy.signal.correlate(one, two, "full", "fft") for two in answer] for one in answer]
    )
    by_lag = np.moveaxis(cross[:, :, length - 1 :: factor], 2, 0)
    size = np.sqrt(np.einsum("kk->k", by_lag[0]))
    heard = np.abs(by_lag / np.outer(size, size)).max(axis=(1, 2)) > 1e-6
    return Stationary(by_lag[: int(np.max(np.nonzero(heard))) + 1])


@compiled
def _sensitivities(loop: ClosedLoop, at: Motion) -> Float[Array, "rows joints 3 joints"]:
    states = effect_states(loop, at.t, at)

    def one(motion: Motion, own):
        def torque(moved):
            q, v, a = moved
            return inverse(loop, eqx.tree_at(lambda m: (m.q, m.v, m.a), motion, (q, v, a)), own)

        return jax.jacfwd(torque)(jnp.stack([motion.q, motion.v, motion.a]))

    return jax.vmap(one)(at, states)


class RowErrors(eqx.Module):
    """The rows of one recording with the covariance of their errors, ready to whiten."""

    whiten: Callable[[Float[np.ndarray, "equations columns"]], np.ndarray]


def row_errors(
    loop: ClosedLoop,
    at: Motion,
    errors: Stationary | LowRank,
    resolution: Float[np.ndarray, " joints"],
    residual: Float[np.ndarray, "rows joints"],
) -> RowErrors:
    """Whitening of one recording's rows: encoder errors plus other white errors.

    To first order the error of a row is the error of position, velocity and acceleration times the
    torque's derivatives. The other part of the residual is assumed to be white, with one variance
    for each joint.

    **Arguments:**

    - `loop`: the loop at values near the estimate. `at`: the motion at the rows.
    - `resolution`: encoder step Q, `(joints,)`; the variance of an error is Q²/12 (Appendix C).
    - `residual`: residual of a first estimate.
    """
    sensitivity = np.asarray(_sensitivities(loop, at)) * (resolution / np.sqrt(12))
    rows, joints = residual.shape
    if isinstance(errors, LowRank):
        wide = np.einsum("tjki,ktc->tjic", sensitivity, errors.factor)
        wide = wide.reshape(rows * joints, -1)
        own = np.sum(wide**2, axis=1).reshape(rows, joints)
    else:
        wide = None
        own = np.einsum("tjki,kl,tjli->tj", sensitivity, errors.by_lag[0], sensitivity)
    level = own.mean(axis=0)
    rest = np.maximum(np.mean(residual**2, axis=0) - level, 1e-3 * level)
    rest = np.where(rest > 0, rest, 1.0)
    if isinstance(errors, LowRank):
        assert wide is not None
        return RowErrors(_low_rank_whitening(wide, np.tile(rest, rows)))
    return RowErrors(_banded_whitening(sensitivity, errors.by_lag, rest))


def _low_rank_whitening(wide: np.ndarray, rest: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    scale = np.sqrt(rest)[:, None]
    tall = wide / scale
    square, turn = np.linalg.eigh(tall.T @ tall)
    size = np.maximum(square, 1e-15 * square[-1])
    inner = (turn * ((1 / np.sqrt(1 + size) - 1) / size)) @ turn.T

    def whiten(x: np.ndarray) -> np.ndarray:
        y = x / scale
        return y + tall @ (inner @ (tall.T @ y))

    return whiten


def _banded_whitening(
    sensitivity: np.ndarray, by_lag: np.ndarray, rest: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    import scipy

    rows, joints = sensitivity.shape[:2]
    lags = min(len(by_lag), rows)
    width = joints * lags
    band = np.zeros((width + joints, rows * joints))
    for m in range(lags):
        block = np.einsum(
            "tjki,kl,tnli->tjn", sensitivity[m:], by_lag[m], sensitivity[: rows - m], optimize=True
        )
        for j in range(joints):
            for n in range(joints):
                below = m * joints + j - n
                if below >= 0:
                    band[below, n : (rows - m) * joints : joints] = block[:, j, n]
    diagonal = np.tile(rest, rows)
    for _ in range(8):
        try:
            with_rest = band.copy()
            with_rest[0] += diagonal
            lower = scipy.linalg.cholesky_banded(with_rest, lower=True)
            break
        except scipy.linalg.LinAlgError:
            # Truncated correlations may make it slightly indefinite.
            diagonal = 10 * diagonal
    else:
        raise FitError(
            "the covariance of the encoder's errors is not positive: use weights='joint'"
        )

    def whiten(x: np.ndarray) -> np.ndarray:
        return scipy.linalg.solve_banded((len(lower) - 1, 0), lower, x)

    return whiten


class Weighted(eqx.Module):
    """A regression solved with the full covariance of its rows."""

    theta: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    undetermined: tuple[str, ...] = eqx.field(static=True)


def solve_weighted(
    columns: Sequence[Float[np.ndarray, "rows joints parameters"]],
    rights: Sequence[Float[np.ndarray, "rows joints"]],
    nuisances: Sequence[Float[np.ndarray, "rows columns"] | None],
    errors: Sequence[RowErrors],
    names: tuple[str, ...],
    scales: Float[np.ndarray, " parameters"],
) -> Weighted:
    """Generalised least squares over recordings.

    **Arguments:**

    - `columns`, `rights`: of each recording. `nuisances`: further columns, each with a free
      amplitude for every joint; None for none.
    - `errors`: whitening of each recording's rows.
    - `names`, `scales`: of the parameters.
    """
    wides, targets = [], []
    for wide, right, extra, error in zip(columns, rights, nuisances, errors, strict=True):
        joints = right.shape[1]
        x = error.whiten(wide.reshape(-1, wide.shape[2]))
        y = error.whiten(right.reshape(-1, 1))
        if extra is not None:
            spread = np.kron(extra, np.eye(joints))
            basis, _ = np.linalg.qr(error.whiten(spread))
            x, y = x - basis @ (basis.T @ x), y - basis @ (basis.T @ y)
        wides.append(x)
        targets.append(y[:, 0])
    x, y = np.concatenate(wides), np.concatenate(targets)
    size = np.linalg.norm(x, axis=0)
    size = np.where(size > 0, size, 1.0)
    theta = np.linalg.lstsq(x / size, y, rcond=1e-12)[0] / size
    left = y - x @ theta
    variance = float(left @ left) / max(len(y) - x.shape[1], 1)
    covariance, lost = determined_covariance(x.T @ x / variance, names, scales)
    return Weighted(theta, covariance, lost)
