"""Damping that follows the quality of the last step."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Bool, Float

from .arrow import Unknowns
from .descent import Products, promised


class SearchState(eqx.Module):
    """The damping, and the factor by which it grows if the next step is refused."""

    damping: Float[Any, ""]
    growth: Float[Any, ""]


class Nielsen(optx.AbstractSearch):
    """Damping by the ratio of actual to predicted decrease (Nielsen 1999).

    A step is accepted if the squared error decreases. After each rejection the damping grows
    faster.

    **Arguments:**

    - `first`: damping of the first step, in units of the squared columns of J.
    - `least`: lower bound of the damping.
    """

    first: float = 1e-3
    least: float = 1e-10

    def init(self, y: Unknowns, f_info_struct: Products) -> SearchState:
        """The first damping."""
        kind = y[0].dtype
        return SearchState(jnp.asarray(self.first, kind), jnp.asarray(2.0, kind))

    def step(
        self,
        first_step: Bool[Any, ""],
        y: Unknowns,
        y_eval: Unknowns,
        f_info: Products,
        f_eval_info: Products,
        state: SearchState,
    ) -> tuple[Float[Any, ""], Bool[Any, ""], Any, SearchState]:
        """Step size, whether the trial point is accepted, and the next damping."""
        diff = y_eval[0] - y[0], y_eval[1] - y[1]
        ratio = (f_info.f - f_eval_info.f) / promised(diff, f_info)
        accept = first_step | (ratio > 0)
        better = state.damping * jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
        damping = jnp.where(accept, jnp.maximum(better, self.least), state.damping * state.growth)
        damping = jnp.where(first_step, state.damping, damping)
        growth = jnp.where(accept, 2.0, 2 * state.growth)
        return 1 / damping, accept, optx.RESULTS.successful, SearchState(damping, growth)
