"""The damped Gauss-Newton step within bounds."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ...linear_algebra import solve
from .arrow import Arrow, Unknowns

Products = optx.FunctionInfo.EvalGradHessian


class DescentState(eqx.Module):
    """Start of the step, its products, and the largest squared columns of J so far."""

    y: Unknowns
    f_info: Products
    scales: Unknowns


class BoundedDescent(optx.AbstractDescent):
    """The step of Levenberg and Marquardt within bounds, with initial states eliminated.

    Damping is the inverse of the step size, scaled by the largest columns of J so far (Moré 1978).
    A parameter that would leave its bounds stops at the bound, and the step of the others is
    computed again.

    **Arguments:**

    - `lower`, `upper`: bounds of the parameters, `(parameters,)`.
    """

    lower: Float[Any, " parameters"]
    upper: Float[Any, " parameters"]

    def init(self, y: Unknowns, f_info_struct: Products) -> DescentState:
        """A state before the first point, with products of zeros."""
        return DescentState(y, f_info_struct, f_info_struct.grad)

    def query(self, y: Unknowns, f_info: Products, state: DescentState) -> DescentState:
        """Stores the products at an accepted point."""
        assert isinstance(f_info.hessian, Arrow)
        sizes = f_info.hessian.diagonal()
        scales = jnp.maximum(sizes[0], state.scales[0]), jnp.maximum(sizes[1], state.scales[1])
        return DescentState(y, f_info, scales)

    def step(self, step_size: Float[Any, ""], state: DescentState) -> tuple[Unknowns, Any]:
        """The step with damping `1 / step_size`."""
        hessian = state.f_info.hessian
        assert isinstance(hessian, Arrow)
        damped = hessian.damped(1 / step_size, state.scales)
        matrix, slope, inner = damped.reduced(state.f_info.grad)
        theta = within(matrix, slope, self.lower - state.y[0], self.upper - state.y[0])
        start = -inner[..., -1] - inner[..., :-1] @ theta
        return (theta, start), optx.RESULTS.successful


def within(
    matrix: Float[Any, "parameters parameters"],
    slope: Float[Any, " parameters"],
    low: Float[Any, " parameters"],
    high: Float[Any, " parameters"],
) -> Float[Any, " parameters"]:
    """The solution of `matrix step = -slope` for parameters that do not end on a bound."""
    size = jnp.diag(matrix)
    unit = jnp.sqrt(jnp.where(size > 0, size, 1.0))
    scaled = matrix / (unit * unit[:, None])
    stuck = ((low >= 0) & (slope > 0)) | ((high <= 0) & (slope < 0))
    first = jnp.where(stuck, jnp.where(slope > 0, low, high), 0.0)

    def again(carry: tuple[Array, Array, Bool[Any, ""]]) -> Bool[Any, ""]:
        return carry[2]

    def solved(carry: tuple[Array, Array, Bool[Any, ""]]) -> tuple[Array, Array, Array]:
        step, held, _ = carry
        known = jnp.where(held, step * unit, 0.0)
        rest = jnp.where(held, known, -slope / unit - scaled @ known)
        of_open = jnp.where(held | held[:, None], jnp.eye(len(slope)), scaled)
        step = jnp.where(held, step, solve(of_open, rest) / unit)
        beyond = ~held & ((step < low) | (step > high))
        step = jnp.where(beyond, jnp.clip(step, low, high), step)
        return step, held | beyond, jnp.any(beyond) & ~jnp.all(held | beyond)

    return jax.lax.while_loop(again, solved, (first, stuck, ~jnp.all(stuck)))[0]


def promised(diff: Unknowns, f_info: Products) -> Float[Any, ""]:
    """Decrease of f that the quadratic model of the products predicts for a step."""
    bent = f_info.hessian.mv(diff)
    along = optx.FunctionInfo.EvalGrad(f_info.f, f_info.grad).compute_grad_dot(diff)
    return -along - sum(jnp.vdot(a, b) for a, b in zip(diff, bent, strict=True)) / 2
