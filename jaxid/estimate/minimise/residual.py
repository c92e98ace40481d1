"""The residual of a simulated loop as a function of its parameters, and its exact derivatives."""

from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...compiling import compiled
from ...linear_algebra import column_basis
from ...simulation.batch import Batch
from ...simulation.integration import SIGNALS, initial, start_slopes
from ...simulation.loop import ClosedLoop
from ...simulation.runs import each, run, run_with_sensitivities
from .filtering import filtered_by, known_rows

if TYPE_CHECKING:
    # The type checker does not know that derivatives were kept.
    ByParameters: TypeAlias = Any
    ByStart: TypeAlias = Any
else:
    ByParameters = Float[Any, "recordings samples outputs parameters"] | None
    ByStart = Float[Any, "recordings samples outputs initials"] | None


class Sensitivity(eqx.Module):
    """Weighted residual of a batch and its derivatives, at one set of parameter values.

    `residual` is zero at padding; `start` is its derivative by each recording's own
    initial position and velocity, None if it is not estimated. `raw` is the residual before the
    noise filter. Derivatives that were not kept are None. `result` is zero for recordings whose
    simulation succeeded, see `jaxid.simulation.reason`.
    """

    raw: Float[Any, "recordings samples outputs"]
    residual: Float[Any, "recordings samples outputs"]
    jacobian: ByParameters
    start: ByStart
    result: Int[Any, " recordings"]


@compiled
def sensitivity(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    noise: Float[Array, "outputs taps"],
    signals: tuple[str, ...],
    free_start: bool,
) -> Sensitivity:
    """Weighted residual (measured minus simulated) and its exact derivatives.

    **Arguments:**

    - `weights`: inverse deviation of each output, `(signals · joints,)`.
    - `noise`: the polynomial A of each output's noise filter 1/A, padded with zeros.
    - `signals`: which of `"tau"` and `"q"` are outputs.
    - `free_start`: whether initial states are parameters too.
    """
    plain = unfiltered(loop, batch, weights, signals, free_start)
    return through_filter(
        plain, noise, known_rows(noise, batch.kept, jnp.zeros(len(batch.q0), int))
    )


def unfiltered(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    signals: tuple[str, ...],
    free_start: bool,
) -> Sensitivity:
    """`sensitivity` before any noise filter; this is the only simulation."""
    x, tangents = beginning(loop, batch, free_start)
    return sensitivity_from(loop, batch, weights, signals, x, tangents)[0]


def beginning(
    loop: ClosedLoop, batch: Batch, free_start: bool
) -> tuple[Float[Array, "recordings states"], Float[Array, "recordings states columns"]]:
    """Initial states of recordings, and their derivatives.

    Columns are the loop's parameters and, if estimated, the initial position and velocity.
    """
    columns = loop.theta.shape[0] + (2 * loop.joints if free_start else 0)

    def one(intervals, q0, v0):
        slopes = start_slopes(loop, intervals, q0, v0)
        return initial(loop, intervals, q0, v0), slopes[:, :columns]

    return each(one, batch.intervals, batch.q0, batch.v0)


def sensitivity_from(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    signals: tuple[str, ...],
    x: Float[Array, "recordings states"],
    tangents: Float[Array, "recordings states columns"],
) -> tuple[
    Sensitivity, Float[Array, "recordings states"], Float[Array, "recordings states columns"]
]:
    """`unfiltered` from given states and tangents; also returns those at the end."""
    rows = tuple(SIGNALS.index(s) for s in signals)
    p, n = loop.theta.shape[0], loop.joints

    def one(intervals, at, x, tangents):
        found = run_with_sensitivities(loop, intervals, x, tangents, rows)
        seen, slopes = found.seen, found.slopes
        if at is not None:
            seen, slopes = seen[at], slopes[at]
        k = seen.shape[0]
        seen, slopes = seen.reshape(k, -1), slopes.reshape(k, len(rows) * n, slopes.shape[-1])
        return seen, slopes, found.end, found.end_slopes, found.result

    seen, slopes, *end, result = each(one, batch.intervals, batch.at, x, tangents)
    scale = weights * batch.mask[..., None]
    measured = jnp.concatenate([getattr(batch, s) for s in signals], axis=-1)
    simulated, by_delay = simulated_with_slopes(loop, batch, seen * scale)
    residual = batch.compared(measured * scale) - simulated
    slopes = -batch.compared(slopes * scale[..., None], loop.controller.late)
    by_start = slopes[..., p:] if slopes.shape[-1] > p else None
    return Sensitivity(residual, residual, slopes[..., :p] - by_delay, by_start, result), *end


def simulated_with_slopes(
    loop: ClosedLoop, batch: Batch, x: Float[Array, "recordings samples outputs"]
) -> tuple[
    Float[Array, "recordings rows outputs"], Float[Array, "#recordings #rows #outputs parameters"]
]:
    """Simulated signals as they are compared, and their derivatives by the delay of the torque.

    The simulated signals are advanced. If the measured ones were delayed, their noise would depend
    on the delay, and a fit would choose the delay with the smallest noise.

    **Arguments:**

    - `x`: weighted simulated signals, `(recordings, samples, outputs)`, zero at padding.
    """
    if batch.band is None:
        return batch.compared(x), jnp.zeros((1, 1, 1, loop.theta.shape[0]))
    late, one = loop.controller.late, jnp.ones(())
    simulated, by_delay = jax.jvp(lambda late: batch.compared(x, late), (late,), (one,))
    change = jax.jacfwd(lambda theta: loop.with_theta(theta).controller.late)(loop.theta)
    return simulated, by_delay[..., None] * change


def raw_residual(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    signals: tuple[str, ...],
) -> Float[Array, "recordings samples outputs"]:
    """Weighted residual before any noise filter, without derivatives."""
    rows = jnp.asarray([SIGNALS.index(s) for s in signals])

    def one(intervals, at, q0, v0):
        _, seen, _ = run(loop, intervals, initial(loop, intervals, q0, v0))
        seen = seen[:, rows] if at is None else seen[at][:, rows]
        return seen.reshape(seen.shape[0], -1)

    seen = each(one, batch.intervals, batch.at, batch.q0, batch.v0)
    scale = weights * batch.mask[..., None]
    measured = jnp.concatenate([getattr(batch, s) for s in signals], axis=-1)
    return batch.compared(measured * scale) - batch.compared(seen * scale, loop.controller.late)


def through_filter(
    plain: Sensitivity,
    noise: Float[Array, "..."],
    known: Bool[Array, "recordings samples outputs"],
) -> Sensitivity:
    """Residual and derivatives through the inverse of the noise filters.

    **Arguments:**

    - `noise`: polynomials, `(outputs, taps)`, or matrices of polynomials for coupled outputs,
      `(outputs, outputs, taps)`; padded with zeros.
    - `known`: filtered rows that count.
    """
    p = plain.jacobian.shape[-1]
    columns = [plain.raw[..., None], plain.jacobian]
    if plain.start is not None:
        columns.append(plain.start)
    white = filtered_by(noise, jnp.concatenate(columns, axis=-1))
    white = white * known[..., None]
    by_start = None if plain.start is None else white[..., p + 1 :]
    return Sensitivity(plain.raw, white[..., 0], white[..., 1 : p + 1], by_start, plain.result)


def absorb_start(found: Sensitivity, free: Float[Array, " recordings"]) -> Sensitivity:
    """Projects initial states out of the derivatives.

    **Arguments:**

    - `free`: one for recordings whose initial state is estimated, else zero.
    """
    if found.start is None:
        return found
    count, p = found.jacobian.shape[0], found.jacobian.shape[-1]
    j = found.jacobian.reshape(count, -1, p)
    s = (found.start * free[:, None, None, None]).reshape(count, j.shape[1], -1)
    # Columns may be dependent, or zero for a given start, so a full decomposition is needed.
    basis, size = jax.vmap(column_basis)(s)
    basis = jnp.where((size > 1e-10 * size[:, :1])[:, None, :], basis, 0.0)
    j = j - basis @ jnp.einsum("rka,rkp->rap", basis, j)
    return Sensitivity(
        found.raw, found.residual, j.reshape(found.jacobian.shape), None, found.result
    )


def mixed(found: Sensitivity, mix: Float[Array, "outputs outputs"]) -> Sensitivity:
    """Filtered residual and derivatives with outputs combined by a matrix."""
    start = None if found.start is None else jnp.einsum("ij,rkja->rkia", mix, found.start)
    return Sensitivity(
        found.raw,
        jnp.einsum("ij,rkj->rki", mix, found.residual),
        jnp.einsum("ij,rkjp->rkip", mix, found.jacobian),
        start,
        found.result,
    )
