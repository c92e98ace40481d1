"""Joint prediction error method: physical parameters and noise filters in one minimisation."""

import dataclasses
import time
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..display.progress import working
from ..errors import NoiseError
from ..noise import ARFilter, Criterion, Noise, VectorAR, check_series
from ..parameters import Bounds
from ..recording import Recordings
from ..simulation.batch import prepare
from ..simulation.loop import ClosedLoop
from ..simulation.steps import with_substeps
from .converge import Converged, converge
from .covariance import Deviations
from .minimise import Coefficients, Minimum, Problem, Stopping, minimise
from .oem import OEM
from .pem import Order, keeping, noise_filters
from .pieces import compared_signals, estimated_starts, first_weights, pieces_of
from .prior import prior_of
from .reporting import report
from .result import AbstractMethod, Fit, Status
from .start import start_values


class JointPEM(AbstractMethod):
    """Prediction error method, equations (7) and (11) of Brunot et al. 2016, in one minimisation.

    Minimises the determinant of the prediction error's covariance over physical parameters, AR
    coefficients and initial states together (Ljung 1999, section 7.5). The residual is linear in
    the coefficients, so one run of the simulation's sensitivities gives all derivatives.

    **Arguments:**

    - `oem`: output, start, initial states and bounds are those of this method.
    - `orders`: orders of the AR filters, one for each output; their coefficients start at zero.
      None to fit by `oem` first, choose orders from its residuals, and start from these filters.
    - `criterion`, `highest`, `white`: for the choice of orders, as for `SeparablePEM`.
    - `coupled`: whether every output's filter depends on the past of all outputs.
    - `deviations`: `"white"` for (A.1), `"sandwich"` or `"paper"`.

    **Raises:** `NoiseError` if the data do not allow such filters; its `fit` is the fit so far.
    """

    oem: OEM = OEM()
    orders: tuple[int, ...] | None = eqx.field(static=True, default=None)
    criterion: Criterion = eqx.field(static=True, default="aic")
    highest: int = eqx.field(static=True, default=50)
    white: float | None = eqx.field(static=True, default=0.05)
    coupled: bool = eqx.field(static=True, default=False)
    deviations: Deviations = eqx.field(static=True, default="white")

    def __repr__(self) -> str:
        said = self.criterion if self.orders is None else f"orders={self.orders}"
        return f"JointPEM({said}{', coupled' if self.coupled else ''})"

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the loop's free parameters; called by `jaxid.fit`."""
        started = time.perf_counter()
        recordings.common_period()
        deadline = started + self.oem.max_seconds
        with working(f"JointPEM of {loop.name}", self.oem.progress) as say:
            loop = with_substeps(start_values(loop, recordings, self.oem.start, say), recordings)
            orders, noise, first = self._orders(loop, recordings, say, deadline)
            if first is not None:
                loop = first.loop
            done = _converge_jointly(self, loop, recordings, orders, noise, say, deadline)
        total = done.iterations + (0 if first is None else first.iterations)
        done = dataclasses.replace(done, iterations=total)
        seconds = time.perf_counter() - started
        return report(self.deviations, done, recordings, seconds, self, estimated_noise(done))

    def _orders(
        self,
        loop: ClosedLoop,
        recordings: Recordings,
        say: Callable[[str], None],
        deadline: float,
    ) -> tuple[Sequence[int], Noise, Converged | None]:
        """Orders; if they are not given, also the filters and the fit to start from."""
        if self.orders is not None:
            return self.orders, None, None
        first = converge(self.oem, loop, recordings, say, deadline=deadline)
        with keeping(first, self.oem, recordings):
            order = Order(self.criterion, self.highest, self.white)
            noise = noise_filters(first, order, None, self.coupled)
        if isinstance(noise, VectorAR):
            return [noise.order] * noise.outputs, noise, first
        return [f.order for f in noise], noise, first


def _converge_jointly(
    method: JointPEM,
    loop: ClosedLoop,
    recordings: Recordings,
    orders: Sequence[int],
    noise: Noise,
    say: Callable[[str], None],
    deadline: float,
) -> Converged:
    """Minimises repeatedly with the updated noise covariance, until the covariance converges.

    At convergence the gradient of the squared error equals the gradient of the determinant.
    """
    oem = method.oem
    pieces, signals = pieces_of(recordings, oem.window), compared_signals(oem, loop)
    batch = prepare(loop, pieces)
    free = jnp.asarray(estimated_starts(oem, pieces, batch))
    weights = jnp.asarray(first_weights(loop, pieces, signals))
    outputs = weights.shape[0]
    if len(orders) != outputs:
        raise NoiseError(f"{len(orders)} orders are given for {outputs} outputs: give one for each")
    coefficients = Coefficients.of(orders, method.coupled)
    size = 16 * (max(orders, default=0) // 16 + 1)
    shape = (outputs, outputs, size) if method.coupled else (outputs, size)
    identity = jnp.eye(outputs) if method.coupled else 1.0
    blank = jnp.zeros(shape).at[..., 0].set(identity)
    bounds, extra = Bounds.of(loop.free_parameters), coefficients.row.shape[0]
    lower = jnp.concatenate([bounds.lower, jnp.full(extra, -jnp.inf)])
    upper = jnp.concatenate([bounds.upper, jnp.full(extra, jnp.inf)])
    problem = Problem(
        loop, batch, weights, blank, free, lower, upper, signals, bool(free.any()),
        mesh=oem.mesh, coefficients=coefficients, mix=jnp.eye(outputs),
        prior=prior_of(loop, recordings),
    )  # fmt: skip
    _check_samples(problem, orders)
    theta = jnp.concatenate([loop.theta, jnp.asarray(_starting(problem, noise))])
    start = jnp.concatenate([batch.q0, batch.v0], axis=1)
    total, worth = 0, 1e-2
    while True:
        left = oem.max_steps - total
        settings = Stopping(oem.tolerance, worth, left, deadline, oem.solver)
        minimum = minimise(problem, theta, start, settings, say)
        total += minimum.iterations
        theta, start = minimum.point.theta, minimum.point.start
        ended = not minimum.status.simulated or minimum.status is Status.max_seconds
        if ended or total >= oem.max_steps:
            break
        mix = _new_mix(problem, minimum)
        change = np.abs(mix @ np.linalg.inv(np.asarray(problem.mix)) - np.eye(outputs)).max()
        if change < 0.1 and worth < 1e-2:
            break
        worth = 1e-4 if change < 0.1 else worth
        problem = dataclasses.replace(problem, mix=jnp.asarray(mix))
    own = loop.theta.shape[0]
    fitted = loop.with_theta(theta[:own])
    return Converged(
        loop=fitted,
        pieces=pieces,
        batch=batch,
        weights=weights,
        minimum=minimum,
        problem=problem,
        signals=signals,
        iterations=total,
    )


def _check_samples(problem: Problem, orders: Sequence[int]) -> None:
    """Checks that the recordings allow the orders, before the computation."""
    kept = np.asarray(problem.batch.kept)
    batch = problem.batch
    signals = [
        np.asarray(batch.compared(getattr(batch, s) * batch.mask[..., None]))
        for s in problem.signals
    ]
    for output, order in enumerate(orders):
        signal, joint = divmod(output, problem.loop.joints)
        series = [x[there, joint] for x, there in zip(signals[signal], kept, strict=True)]
        check_series(series, order, f"joint {joint + 1}")


def _starting(problem: Problem, noise: Noise) -> Float[np.ndarray, " coefficients"]:
    """Coefficients of given filters for weighted outputs, in the problem's order, or zeros."""
    coefficients, w = problem.coefficients, np.asarray(problem.weights)
    assert coefficients is not None
    there = np.asarray(coefficients.there)
    if noise is None:
        return np.zeros(len(there))
    size = problem.noise.shape[-1]
    if isinstance(noise, VectorAR):
        taps = noise.taps(size) * np.outer(w, 1 / w)[..., None]
    else:
        taps = np.zeros((len(w), len(w), size))
        taps[np.arange(len(w)), np.arange(len(w))] = [f.taps(size) for f in noise]
    at = (np.asarray(x) for x in (coefficients.row, coefficients.column, coefficients.lag))
    return np.where(there, taps[tuple(at)], 0.0)


def _innovation_covariance(
    problem: Problem, minimum: Minimum
) -> Float[np.ndarray, "outputs outputs"]:
    """Covariance of the filtered error in weighted units, over rows with a filled filter."""
    assert problem.mix is not None
    e = np.asarray(minimum.point.found.residual) @ np.linalg.inv(np.asarray(problem.mix)).T
    count = np.sum(np.any(e != 0, axis=2))
    floor = 1e-18 * np.eye(e.shape[2])
    return np.einsum("rki,rkj->ij", e, e) / max(count, 1) + floor


def _new_mix(problem: Problem, minimum: Minimum) -> Float[np.ndarray, "outputs outputs"]:
    covariance = _innovation_covariance(problem, minimum)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def estimated_noise(done: Converged) -> tuple[ARFilter, ...] | VectorAR:
    """The noise filters at the minimum, in the outputs' own units."""
    problem, w = done.problem, np.asarray(done.weights)
    assert problem.coefficients is not None
    own = done.loop.theta.shape[0]
    values = jnp.asarray(done.minimum.point.theta[own:])
    taps = np.asarray(problem.coefficients.into(problem.noise, values))
    covariance = _innovation_covariance(problem, done.minimum) / np.outer(w, w)
    lags, rows = np.asarray(problem.coefficients.lag), np.asarray(problem.coefficients.row)
    if taps.ndim == 3:
        order = int(lags.max(initial=0))
        matrices = np.moveaxis(taps[..., 1 : order + 1], -1, 0) * np.outer(1 / w, w)
        return VectorAR(matrices, covariance)
    orders = [int(lags[rows == k].max(initial=0)) for k in range(len(w))]
    return tuple(
        ARFilter(row[1 : n + 1], float(v))
        for row, n, v in zip(taps, orders, np.diag(covariance), strict=True)
    )
