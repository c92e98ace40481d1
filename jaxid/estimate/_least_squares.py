"""The residual of a simulated loop as a function of its parameters, and its minimisation."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..loop import ClosedLoop
from ..parameters import Bounds
from ..simulate import SIGNALS, Batch, initial, run_with_sensitivities
from ._base import Status


class Sensitivity(eqx.Module):
    """Weighted residual of a batch and its derivatives, at one set of parameter values.

    `residual` is zero where there is no sample; `start` is its derivative by each recording's own
    initial position and velocity.
    """

    residual: Float[Array, "recordings samples outputs"]
    jacobian: Float[Array, "recordings samples outputs parameters"]
    start: Float[Array, "recordings samples outputs initials"] | None


@eqx.filter_jit
def sensitivity(
    loop: ClosedLoop,
    batch: Batch,
    weights: Float[Array, " outputs"],
    signals: tuple[str, ...],
    free_start: bool,
) -> Sensitivity:
    """Weighted residual (measured less simulated) and its exact derivatives.

    **Arguments:**

    - `weights`: one over the deviation of each output, `(signals · joints,)`.
    - `signals`: which of `"tau"` and `"q"` are outputs.
    - `free_start`: whether initial states are parameters too.
    """
    rows = tuple(SIGNALS.index(s) for s in signals)
    p, n = loop.theta.shape[0], loop.joints

    def one(intervals, at, q0, v0):
        by_start = jax.jacfwd(lambda z: initial(loop, z[:n], z[n:]))(jnp.concatenate([q0, v0]))
        x0 = initial(loop, q0, v0)
        extra = 2 * n if free_start else 0
        start = jnp.concatenate([jnp.zeros((x0.shape[0], p)), by_start[:, :extra]], axis=1)
        seen, slopes = run_with_sensitivities(loop, intervals, x0, start, rows)
        if at is not None:
            seen, slopes = seen[at], slopes[at]
        k = seen.shape[0]
        return seen.reshape(k, -1), slopes.reshape(k, len(rows) * n, p + extra)

    seen, slopes = jax.vmap(one)(batch.intervals, batch.at, batch.q0, batch.v0)
    measured = jnp.concatenate([getattr(batch, s) for s in signals], axis=-1)
    scale = weights * batch.mask[..., None]
    residual = (measured - seen) * scale
    slopes = -slopes * scale[..., None]
    if batch.band is not None:
        residual, slopes = batch.band(residual), batch.band(slopes)
    return Sensitivity(residual, slopes[..., :p], slopes[..., p:] if free_start else None)


def absorb_start(
    found: Sensitivity, free: Float[Array, " recordings"]
) -> tuple[Sensitivity, Float[Array, "recordings initials"]]:
    """Takes out what initial states can explain (variable projection, Kaufman 1975).

    **Arguments:**

    - `free`: one for recordings whose initial state is estimated, else zero.

    **Returns:** residual and derivatives with that removed, and the step of the initial states.
    """
    assert found.start is not None
    shape = found.residual.shape

    def one(residual, jacobian, start, flag):
        flat = start.reshape(-1, start.shape[-1])
        basis, triangle = jnp.linalg.qr(flat)
        basis = flag * basis
        r, j = residual.reshape(-1), jacobian.reshape(-1, jacobian.shape[-1])
        along = basis.T @ r
        step = -flag * jnp.linalg.lstsq(triangle, along)[0]
        return r - basis @ along, j - basis @ (basis.T @ j), step

    r, j, step = jax.vmap(one)(found.residual, found.jacobian, found.start, free)
    return Sensitivity(r.reshape(shape), j.reshape(*shape, -1), None), step


class Problem(eqx.Module):
    """The least-squares problem in unbounded coordinates, for optimistix.

    Where values are not physical or the simulation fails, the residual is so large that the step
    is refused.
    """

    loop: ClosedLoop
    batch: Batch
    weights: Float[Array, " outputs"]
    free: Float[Array, " recordings"]
    bounds: Bounds
    signals: tuple[str, ...] = eqx.field(static=True)
    free_start: bool = eqx.field(static=True)

    def at(self, z: Float[Array, " parameters"]) -> tuple[Sensitivity, Array]:
        """Residual with derivatives by z, and the step of the initial states."""
        loop = self.loop.with_theta(self.bounds.inside(z))
        found = sensitivity(loop, self.batch, self.weights, self.signals, self.free_start)
        step = jnp.zeros((self.free.shape[0], 2 * loop.joints))
        if self.free_start:
            found, step = absorb_start(found, self.free)
        physical = loop.arm.smallest_inertia() > 0
        usable = physical & jnp.all(jnp.isfinite(found.residual))
        usable = usable & jnp.all(jnp.isfinite(found.jacobian))
        residual = jnp.where(usable, found.residual, REFUSED)
        jacobian = jnp.where(usable, found.jacobian, 0.0)
        return Sensitivity(residual, jacobian, None), step

    def __call__(self, z: Float[Array, " parameters"], args: None):
        """The flat residual, with the sensitivities as auxiliary output."""

        @jax.custom_jvp
        def evaluate(z):
            found, step = self.at(z)
            return found.residual.reshape(-1), (found, step)

        @evaluate.defjvp
        def evaluate_jvp(primals, tangents):
            (z,), (dz,) = primals, tangents
            found, step = self.at(z)
            slope = jax.vmap(lambda d: jax.jvp(self.bounds.inside, (z,), (d,))[1])
            by_z = found.jacobian.reshape(-1, z.shape[0]) @ slope(jnp.eye(z.shape[0])).T
            aux = (found, step)
            # The sensitivities are reported, not differentiated.
            still = jax.tree.map(jnp.zeros_like, aux)
            return (found.residual.reshape(-1), aux), (by_z @ dz, still)

        return evaluate(z)


REFUSED = 1e6


@eqx.filter_jit
def _begin(problem: Problem, solver: optx.LevenbergMarquardt, z: Float[Array, " parameters"]):
    return eqx.filter(_fresh(problem, solver, z), eqx.is_array)


def _fresh(problem: Problem, solver: optx.LevenbergMarquardt, z: Float[Array, " parameters"]):
    f_struct, aux_struct = eqx.filter_eval_shape(problem, z, None)
    return solver.init(problem, z, None, {}, f_struct, aux_struct, frozenset())


@eqx.filter_jit
def _step(problem: Problem, solver: optx.LevenbergMarquardt, z: Float[Array, " parameters"], carry):
    # optimistix keeps traced functions in its state; only arrays may cross the boundary of a
    # compiled step, so that one compilation serves every fit of this structure.
    static = eqx.filter(_fresh(problem, solver, z), eqx.is_array, inverse=True)
    state = eqx.combine(carry, static)
    z, state, _ = solver.step(problem, z, None, {}, state, frozenset())
    loss = jnp.sum(state.f_info.residual**2)
    return z, eqx.filter(state, eqx.is_array), state.aux, loss, state.terminate


class Minimum(eqx.Module):
    """Where a minimisation ended."""

    z: Float[Array, " parameters"]
    found: Sensitivity
    start_step: Float[Array, "recordings initials"]
    status: Status = eqx.field(static=True)
    iterations: int = eqx.field(static=True)


def minimise(
    problem: Problem,
    z: Float[Array, " parameters"],
    solver: optx.LevenbergMarquardt,
    max_steps: int,
    say: Callable[[str], None],
) -> Minimum:
    """Levenberg–Marquardt by optimistix, one compiled step at a time.

    **Arguments:**

    - `z`: start, in the problem's coordinates.
    - `max_steps`: largest number of steps, refused ones included.
    - `say`: told about every step.
    """
    carry = _begin(problem, solver, z)
    best, refused, still, last = np.inf, 0, 0, None
    for k in range(1, max_steps + 1):
        z, carry, last, loss, done = _step(problem, solver, z, carry)
        loss = float(loss)
        say(f"iteration {k}, weighted squared error {loss:.6g}")
        if k == 1 and loss >= REFUSED**2:
            return Minimum(z, last[0], last[1], Status.diverged, k)
        refused = refused + 1 if loss >= best else 0
        # A parameter that leans on its bound moves on for ever without changing anything.
        still = still + 1 if 0 <= best - loss < 1e-9 * loss and not refused else 0
        best = min(best, loss)
        if bool(done) or still >= 3 or (refused >= 3 and flat(last[0])):
            return Minimum(z, last[0], last[1], Status.converged, k)
        if refused >= 25:
            return Minimum(z, last[0], last[1], Status.stalled, k)
    assert last is not None
    return Minimum(z, last[0], last[1], Status.max_steps, max_steps)


def flat(found: Sensitivity) -> bool:
    """Whether the residual is orthogonal to its derivatives, to what rounding allows."""
    r = np.asarray(found.residual).reshape(-1)
    j = np.asarray(found.jacobian).reshape(len(r), -1)
    size = np.linalg.norm(j, axis=0) * np.linalg.norm(r)
    return bool(np.all(np.abs(j.T @ r) <= 1e-5 * np.where(size > 0, size, 1.0)))
