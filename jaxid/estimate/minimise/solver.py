"""Levenberg–Marquardt as an optimistix solver whose tolerance is in standard deviations."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .arrow import Arrow, Unknowns, empty_arrow
from .curvature import with_curvature
from .descent import BoundedDescent, DescentState, Products, promised
from .search import Nielsen, SearchState

# Step size above which a step counts as undamped.
FULL = 1e10
# Accepted steps over which the loss must fall by `worth`.
STEPS_JUDGED = 5
# Damping above which a step is shorter than rounding.
LARGEST_DAMPING = 1e12
# A refused step with more than this damping could not have lowered the loss noticeably. If a full
# step is also shorter than the typical error of the estimate (the square root of the number of
# estimated values, in standard deviations), jumps of the loss hide the minimum.
LARGE_DAMPING = 1e4


class SolverState(eqx.Module):
    """The state of the solver between steps.

    - `y_eval`: the next point to evaluate. `first`: whether no point was evaluated yet.
    - `f_info`: products at the last accepted point; `accepted`: whether this is the newest point.
    - `descent`: products that the next step uses, with the curvature along the last step. After a
      refused step they are `f_info`.
    - `result`: divergence if even the shortest step does not lower the loss.
    - `losses`: losses of the last accepted points, newest last, with infinity for missing points.
    """

    y_eval: Unknowns
    first: Bool[Any, ""]
    accepted: Bool[Any, ""]
    f_info: Products
    losses: Float[Any, " judged"]
    search: SearchState
    descent: DescentState
    terminate: Bool[Any, ""]
    result: Any
    steps: Int[Any, ""]


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Damped Gauss-Newton steps within bounds, for parameters and initial states together.

    The Hessian of a step is J'J. If this overestimates the curvature that the last step showed, it
    is corrected along that step (`with_curvature`); if a step is refused, the next one uses J'J.

    Unknowns are `(parameters, initial states by recording)`; the latter have the shape `(0, 0)` if
    there are none. Supports the following `options`:

    - `linearised`: `optimistix.FunctionInfo.EvalGradHessian` at the point to evaluate, with an
      `Arrow` for J'J, if the caller computes it (over threads, devices or pieces of a recording);
      `fn` is then not called. By default it is computed by forward mode through `fn`.
    - `rows`: number of residuals without padding; by default all.

    **Arguments:**

    - `descent`: the step for a given damping. `search`: the damping.
    - `tolerance`: it stops if a full step is shorter than this many standard deviations.
    - `worth`: it also stops if five accepted steps together lower the loss by less than this share.
      With sticking friction the loss has kinks, at which full steps stay long without a decrease.
    - `rtol`, `atol`, `norm`: required by optimistix; they are not used.

    A sampled law with quantised encoders makes the loss jump by small amounts. There it also stops
    if damped steps are refused and a full step is shorter than the typical error of the estimate.
    """

    descent: BoundedDescent
    search: Nielsen = Nielsen()
    tolerance: float = 1e-2
    worth: float = 1e-4
    rtol: float = 0.0
    atol: float = 0.0
    norm: Any = eqx.field(static=True, default=optx.max_norm)

    def init(self, fn: Any, y: Unknowns, args, options, f_struct, aux_struct, tags) -> SolverState:
        """The state before the first evaluation."""
        y = jnp.clip(y[0], self.descent.lower, self.descent.upper), jnp.asarray(y[1])
        zeros = jnp.zeros_like(y[0]), jnp.zeros_like(y[1])
        blank = Products(jnp.zeros(()), zeros, empty_arrow(y))
        return SolverState(
            y_eval=y,
            first=jnp.asarray(True),
            accepted=jnp.asarray(False),
            f_info=blank,
            losses=jnp.full(STEPS_JUDGED + 1, jnp.inf, y[0].dtype),
            search=self.search.init(y, blank),
            descent=self.descent.init(y, blank),
            terminate=jnp.asarray(False),
            result=optx.RESULTS.successful,
            steps=jnp.asarray(0),
        )

    def step(self, fn: Any, y: Unknowns, args, options, state: SolverState, tags):
        """Evaluates the trial point, accepts or refuses it, and proposes the next one."""
        if "linearised" in options:
            found, rows, aux = options["linearised"], options["rows"], None
        else:
            found, rows, aux = _linearised(fn, state.y_eval, args)
        size, accepted, _, search = self.search.step(
            state.first, y, state.y_eval, state.descent.f_info, found, state.search
        )

        def chosen(new, old):
            return jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)

        curved = with_curvature(found, state.f_info, state.y_eval[0] - y[0])
        y = chosen(state.y_eval, y)
        f_info = chosen(found, state.f_info)
        scales = self.descent.query(y, f_info, state.descent).scales
        descent = DescentState(y, chosen(curved, f_info), scales)
        losses = jnp.where(accepted, jnp.append(state.losses[1:], 2 * f_info.f), state.losses)
        # One compiled piece of code for both steps; it is most of the program.
        sizes = jnp.stack([size, jnp.full_like(size, FULL)])
        diffs = jax.lax.map(lambda x: self.descent.step(x, descent)[0], sizes)
        diff, full = (jax.tree.map(lambda x, k=k: x[k], diffs) for k in (0, 1))
        # The predicted decrease of a full step is half its squared length in deviations times the
        # residual's variance.
        decrease, variance = 2 * promised(full, descent.f_info), losses[-1] / rows
        settled = decrease <= self.tolerance**2 * variance
        flat = losses[0] - losses[-1] < self.worth * losses[-1]
        # Dummy unknowns and values at a bound do not move.
        count = sum(jnp.count_nonzero(x) for x in full)
        hidden = ~accepted & (search.damping > LARGE_DAMPING) & (decrease <= count * variance)
        stuck = search.damping > LARGEST_DAMPING
        state = SolverState(
            y_eval=jax.tree.map(jnp.add, y, diff),
            first=jnp.asarray(False),
            accepted=accepted,
            f_info=f_info,
            losses=losses,
            search=search,
            descent=descent,
            terminate=settled | flat | hidden | stuck,
            result=optx.RESULTS.where(
                stuck & ~settled & ~flat & ~hidden,
                optx.RESULTS.nonlinear_divergence,
                optx.RESULTS.successful,
            ),
            steps=state.steps + 1,
        )
        return y, state, aux

    def terminate(self, fn: Any, y: Unknowns, args, options, state: SolverState, tags):
        """Whether to stop, and why."""
        return state.terminate, state.result

    def postprocess(
        self, fn: Any, y: Unknowns, aux, args, options, state: SolverState, tags, result
    ):
        """The result for `optimistix.least_squares`."""
        return y, aux, {}


def _linearised(fn, y: Unknowns, args) -> tuple[Products, int, Any]:
    """Products of a function's residual at a point, by forward mode."""

    def flat(theta: Array, start: Array) -> tuple[Array, tuple[Array, Any]]:
        residual, aux = fn((theta, start), args)
        row = ravel_pytree(residual)[0]
        return row, (row, aux)

    (by_theta, by_start), (residual, aux) = jax.jacfwd(flat, (0, 1), has_aux=True)(*y)
    cross = jnp.einsum("kra,kp->rap", by_start, by_theta)
    hessian = Arrow(by_theta.T @ by_theta, jnp.einsum("kra,krb->rab", by_start, by_start), cross)
    grad = residual @ by_theta, jnp.einsum("k,kra->ra", residual, by_start)
    return Products(residual @ residual / 2, grad, hessian), residual.size, aux
