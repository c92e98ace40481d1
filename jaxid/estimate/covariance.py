"""Covariance of a least-squares estimate: (A.1), two sandwich estimates, the paper's formula."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..compiling import compiled
from ..errors import FitError
from ..noise import Noise, centred, fit_ar, innovations
from ..parameters import Bounds
from .minimise import Problem, Sensitivity, absorb_start, linearise, unfiltered
from .result import Fit, determined_covariance

if TYPE_CHECKING:
    import pandas as pd

Deviations = Literal["sandwich", "newey_west", "white", "paper"]

SAID = {
    "sandwich": "sandwich estimate, which allows for coloured residuals",
    "newey_west": "sandwich estimate of Newey and West, which allows for errors whose size depends "
    "on the motion",
    "white": "equation (A.1) with the gradient of the filtered error, valid if that error is white",
    "paper": "equation (A.1) with the filtered error's variance but the unfiltered gradient, as "
    "printed by Brunot et al. 2016: not reliable",
}


class Optimum(eqx.Module):
    """The optimum of a least-squares fit, which can be linearised again.

    - `problem`: the minimised problem; `theta`: its parameters, those of a noise filter last;
      `start`: initial states.
    - `by_motion`: mean of J'r that the noise of the recorded motion causes; None if there is none.
    """

    problem: Problem
    theta: Float[Any, " values"]
    start: Float[Any, "recordings initials"]
    by_motion: Float[np.ndarray, " values"] | None = None


class Reduced(eqx.Module):
    """Residuals and derivatives by recording, with nuisances projected out.

    Nuisances are initial states and the noise filter's coefficients. `rows` marks rows that count.
    """

    residuals: list[Float[np.ndarray, "_samples outputs"]]
    jacobians: list[Float[np.ndarray, "_samples outputs parameters"]]
    spent: Float[np.ndarray, " outputs"]

    @classmethod
    def of(cls, optimum: Optimum, found: Sensitivity | None = None) -> "Reduced":
        """Residuals and derivatives at an optimum, from its linearisation if it exists."""
        problem = optimum.problem
        if found is None:
            found = linearise(problem, optimum.theta, optimum.start)
        p = problem.loop.theta.shape[0]
        found = absorb_start(found, problem.free)
        jacobian, residual = np.asarray(found.jacobian), np.asarray(found.residual)
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        own, past = flat[:, :p], flat[:, p:]
        past = past[:, np.any(past != 0, axis=0)]
        if past.shape[1]:
            own = own - past @ np.linalg.lstsq(past, own, rcond=1e-12)[0]
        own = own.reshape(*jacobian.shape[:-1], p)
        # Rows before the filter is filled are zero and do not count as degrees of freedom.
        kept = np.asarray(problem.batch.kept)
        residuals = [r[there] for r, there in zip(residual, kept, strict=True)]
        jacobians = [j[there] for j, there in zip(own, kept, strict=True)]
        return cls(residuals, jacobians, spent_by(problem))

    def filled(self) -> list[np.ndarray]:
        """Which rows of each recording and output are not blank, `(samples, outputs)`."""
        return [r != 0 for r in self.residuals]

    def spread(self, full: bool) -> Float[np.ndarray, "outputs outputs"]:
        """Covariance of the filtered residual, over its degrees of freedom."""
        stacked = np.concatenate(self.residuals)
        rows = np.sum(np.concatenate(self.filled()), axis=0)
        freedom = np.maximum(rows - self.spent, 1.0)
        covariance = stacked.T @ stacked / np.sqrt(np.outer(freedom, freedom))
        return covariance if full else np.diag(np.diag(covariance))


def spent_by(problem: Problem) -> Float[np.ndarray, " outputs"]:
    """Degrees of freedom of each output that are used by the estimated values."""
    outputs = problem.weights.shape[0]
    spent = np.full(outputs, problem.loop.theta.shape[0] / outputs)
    spent += float(np.sum(np.asarray(problem.free))) * 2 * problem.loop.joints / outputs
    if problem.coefficients is not None:
        rows = np.asarray(problem.coefficients.row)[np.asarray(problem.coefficients.there)]
        return spent + np.bincount(rows, minlength=outputs)
    # A given filter also counts, because it was usually estimated from the same residuals.
    taps = np.asarray(problem.noise)
    return spent + np.sum((taps != 0).reshape(outputs, -1), axis=1) - 1


def covariance_of(
    optimum: Optimum,
    kind: Deviations,
    noise: Noise = None,
    found: Sensitivity | None = None,
) -> tuple[Float[np.ndarray, "parameters parameters"], tuple[str, ...]]:
    """Covariance of the loop's parameters, and notes on undetermined directions.

    **Arguments:**

    - `kind`: see `SAID`.
    - `noise`: filters for the error's variance of the kind `"paper"`.
    - `found`: the linearisation at the optimum, if it exists.
    """
    problem = optimum.problem
    names = problem.loop.names
    scales = np.asarray(Bounds.of(problem.loop.free_parameters).scale)
    if kind == "paper":
        return determined_covariance(_papers_information(optimum, noise), names, scales)
    reduced = Reduced.of(optimum, found)
    jacobians, meat = reduced.jacobians, None
    if kind == "white":
        whiten = np.linalg.inv(np.linalg.cholesky(reduced.spread(problem.mix is not None)))
        jacobians = [np.einsum("ij,kjp->kip", whiten, j) for j in jacobians]
    own = np.asarray(sum(np.einsum("kop,koq->pq", j, j) for j in jacobians))
    rows = np.zeros((0, len(names))) if problem.prior is None else np.asarray(problem.prior.rows)
    known = rows.T @ rows
    if kind == "sandwich":
        meat = known + score_covariance(reduced.residuals, jacobians, own + known)
    elif kind == "newey_west":
        meat = known + newey_west(reduced.residuals, jacobians)
    if meat is not None and optimum.by_motion is not None:
        mean = optimum.by_motion[: len(names)]
        meat = meat + np.outer(mean, mean)
    covariance, lost = determined_covariance(own + known, names, scales, meat)
    if problem.prior is not None and np.isfinite(own).all():
        # A prior makes all deviations finite. Named is what the recordings alone do not determine.
        lost = determined_covariance(own, names, scales)[1]
    return covariance, lost


_plain = compiled(unfiltered)


def _papers_information(
    optimum: Optimum, noise: Noise
) -> Float[np.ndarray, "parameters parameters"]:
    """(A.1) as printed: one variance of the filtered error, and unfiltered gradients."""
    problem, n = optimum.problem, optimum.problem.loop.joints
    p = problem.loop.theta.shape[0]
    loop = problem.loop.with_theta(jnp.asarray(optimum.theta)[:p])
    start = jnp.asarray(optimum.start)
    batch = dataclasses.replace(problem.batch, q0=start[:, :n], v0=start[:, n:])
    units = jnp.ones_like(problem.weights)
    plain = _plain(loop, batch, units, problem.signals, False)
    raw, kept = np.asarray(plain.raw), np.asarray(batch.kept)
    total = sum(
        float(np.sum(innovations(x[there], noise) ** 2)) for x, there in zip(raw, kept, strict=True)
    )
    variance = total / kept.sum()
    jacobian = np.asarray(plain.jacobian)
    return np.einsum("rkop,rkoq->pq", jacobian, jacobian) / variance


def score_covariance(
    residuals: Sequence[Float[np.ndarray, "_samples outputs"]],
    jacobians: Sequence[Float[np.ndarray, "_samples outputs parameters"]],
    information: Float[np.ndarray, "parameters parameters"],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of J'r for coloured residuals, from their spectrum and that of J.

    Each output's residuals are modelled as one autoregressive process over all recordings, with the
    order chosen by AIC, and with a level for each recording, because noise that grows with the
    torque is strongest where the derivatives are largest. Outputs are assumed to be uncorrelated.
    The residual lacks what the parameters absorb, most of all at the frequencies of the motion, and
    its spectrum is corrected for that (leverage in the frequency domain).

    **Arguments:**

    - `information`: J'J, with that of a prior.
    """
    outputs, p = jacobians[0].shape[1:]
    length = np.sqrt(np.diag(information))
    length = np.where(length > 0, length, 1.0)
    units = np.outer(length, length)
    meat, inverse = np.zeros((p, p)), np.linalg.pinv(information / units, hermitian=True) / units
    for o in range(outputs):
        series = [centred(r[:, o]) for r in residuals]
        # Rows at which a joint is at rest are zero, and do not count.
        sizes = [max(np.count_nonzero(x), 1) for x in series]
        strengths = [
            float(np.sqrt(x @ x / size)) or 1.0 for x, size in zip(series, sizes, strict=True)
        ]
        # Low-passed residuals have almost no power above the cutoff, which makes a fitted filter
        # ill-conditioned: a white floor at -100 dB keeps it stable.
        floor = np.random.default_rng(0)
        noise = fit_ar(
            [
                x / strength + 1e-5 * floor.standard_normal(len(x)) * (x != 0)
                for x, strength in zip(series, strengths, strict=True)
            ]
        )
        for j, strength in zip(jacobians, strengths, strict=True):
            size = 1 << int(np.ceil(np.log2(2 * j.shape[0])))
            wave = np.fft.fft(j[:, o], size, axis=0)
            leverage = np.real(np.einsum("fp,pq,fq->f", wave.conj(), inverse, wave)) / j.shape[0]
            kept = np.maximum(1 - leverage, _KEPT)
            power = (strength**2 * noise.spectrum(size) / kept)[:, None]
            meat += np.real(wave.conj().T @ (power * wave)) / size
    return meat


# Smallest share of the noise at a frequency that a residual is assumed to keep.
_KEPT = 0.1


def newey_west(
    residuals: Sequence[Float[np.ndarray, "_samples outputs"]],
    jacobians: Sequence[Float[np.ndarray, "_samples outputs parameters"]],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of J'r from the products J'r of the rows (Newey and West 1987).

    Along a recorded motion the error is largest where the motion is least known, as at reversals
    and in bursts, where derivatives are large too. Correlations are assumed to decay within some
    rows, as those of a filtered error do.
    """
    p = jacobians[0].shape[-1]
    meat, rows = np.zeros((p, p)), sum(map(len, residuals))
    for r, j in zip(residuals, jacobians, strict=True):
        scores = np.einsum("ko,kop->kp", r, j)
        # The usual number of lags for Bartlett's weights.
        lags = min(int(np.ceil(4 * (len(scores) / 100) ** (2 / 9))), len(scores) - 1)
        meat += scores.T @ scores
        for lag in range(1, lags + 1):
            product = scores[lag:].T @ scores[:-lag]
            meat += (1 - lag / (lags + 1)) * (product + product.T)
    # The fit lowers the residual; an estimate of its variance allows for it in the same way.
    return meat * rows / max(rows - p, 1)


def optimum_of(fit: Fit, what: str) -> Optimum:
    """The optimum of a fit.

    **Raises:** `FitError` for fits that are not least squares on a simulation.
    """
    if fit.optimum is None:
        raise FitError(
            f"{fit.method!r} does not minimise the error of a simulation, so it has no {what}: "
            "fit by OEM, SeparablePEM or JointPEM"
        )
    return fit.optimum


def deviations(fit: Fit) -> "pd.DataFrame":
    """Standard deviations of a fit by every formula, side by side.

    **Arguments:**

    - `fit`: by `OEM`, `SeparablePEM` or `JointPEM`.

    **Returns:** a row for each parameter, a column for each of `"sandwich"`, `"newey_west"`,
    `"white"` (A.1) and `"paper"` (A.1 with the gradient of the unfiltered error, as in the paper's
    numbers).

    **Raises:** `FitError` for a fit by regression.
    """
    import pandas as pd

    optimum = optimum_of(fit, "deviations of that kind")
    columns = {}
    for kind in SAID:
        covariance, _ = covariance_of(optimum, kind, fit.noise)  # type: ignore[arg-type]
        columns[kind] = np.sqrt(np.diag(covariance))
    return pd.DataFrame(columns, index=pd.Index(fit.names, name="parameter"))


def with_deviations(fit: Fit, kind: Deviations) -> Fit:
    """The same fit, showing deviations of another kind.

    **Raises:** `FitError` for a fit by regression.
    """
    if kind not in SAID:
        raise FitError(f"there are no deviations of kind {kind!r}: {', '.join(map(repr, SAID))}")
    optimum = optimum_of(fit, "deviations of that kind")
    covariance, lost = covariance_of(optimum, kind, fit.noise)
    return dataclasses.replace(fit, covariance=covariance, undetermined=lost, deviations=SAID[kind])
