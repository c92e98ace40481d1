"""Settings of a loop's integration: solver, steps, interpolation of the reference."""

import inspect
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import PyTree

from ..errors import ModelError
from .exponential import Exponential
from .fixed_step import AbstractFixedStep


class RK4(AbstractFixedStep):
    """The classical Runge–Kutta method of order four, for fixed steps (Kutta 1901).

    **Arguments:**

    - `rolled`: whether the stages are a loop, which compiles faster and needs less memory.
    - `batched`: whether many intervals are computed as one batch, so equations remain arrays.
    """

    rolled: bool = eqx.field(static=True, default=False)
    batched: bool = eqx.field(static=True, default=False)

    def order(self, terms: PyTree) -> int:
        """Four."""
        return 4

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step from t0 to t1."""
        h = t1 - t0

        def along(k, share):
            return jax.tree.map(lambda y, d: y + share * h * d, y0, k)

        def stage(carry, share_and_weight):
            (k, y1), (share, weight) = carry, share_and_weight
            k = terms.vf(t0 + share * h, along(k, share), args)
            return (k, jax.tree.map(lambda y, d: y + weight * h * d, y1, k)), None

        if self.rolled:
            tableau = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6
            nothing = jax.tree.map(jnp.zeros_like, y0)
            (_, y1), _ = jax.lax.scan(stage, (nothing, y0), tableau)
        else:
            k1 = terms.vf(t0, y0, args)
            k2 = terms.vf(t0 + h / 2, along(k1, 0.5), args)
            k3 = terms.vf(t0 + h / 2, along(k2, 0.5), args)
            k4 = terms.vf(t1, along(k3, 1.0), args)
            y1 = jax.tree.map(
                lambda y, a, b, c, d: y + h / 6 * (a + 2 * b + 2 * c + d), y0, k1, k2, k3, k4
            )
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


class Stepping(eqx.Module):
    """Settings of the integration.

    Every diffrax solver that takes an ordinary differential equation as one term can be used, with
    fixed steps or with a step-size controller. Steps always end at samples, where the interpolated
    reference may have a kink or a jump. Along a recorded motion only states of effects are
    integrated, always by fixed steps of an exponential method.

    **Arguments:**

    - `solver`: a diffrax solver. An implicit one whose root finder has no tolerances takes them
      from `control`; with fixed steps it uses Newton's method with tolerance 1e-9.
    - `substeps`: fixed steps between two samples; None to choose by the loop's fastest time
      constant. With a controller, the first step tried is the sample period divided by this number.
    - `control`: an adaptive diffrax step-size controller, in seconds; None for fixed steps, which
      are the fastest.
    - `adjoint`: how a run is differentiated. Sensitivities use forward mode; an adjoint for reverse
      mode only is for users who differentiate a run themselves.
    - `interpolation`: of the reference between samples, `"cubic"`, `"linear"` or `"hold"`.
    - `max_steps`: largest number of adaptive steps, for each interval between samples on average.
    - `settled`: whether jaxid has chosen `substeps`, and may choose more; not set by users.

    **Raises:** `ModelError` for a solver or controller that cannot integrate a loop.
    """

    solver: diffrax.AbstractSolver = RK4()
    substeps: int | None = eqx.field(static=True, default=None)
    control: diffrax.AbstractStepSizeController | None = None
    adjoint: diffrax.AbstractAdjoint = diffrax.ForwardMode()
    interpolation: Literal["cubic", "linear", "hold"] = eqx.field(static=True, default="cubic")
    max_steps: int = eqx.field(static=True, default=1000)
    settled: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        name = type(self.solver).__name__
        if not _whole(self.solver):
            raise ModelError(
                f"{name} needs equations in several terms, but a loop has one term: choose another "
                "solver, for example diffrax.Tsit5() or diffrax.Kvaerno5()"
            )
        if self.substeps is not None and self.substeps < 1:
            raise ModelError(f"substeps is {self.substeps}, but it must be at least 1")
        if self.control is None:
            return
        if not isinstance(self.control, diffrax.AbstractAdaptiveStepSizeController):
            raise ModelError(
                f"{type(self.control).__name__} does not adapt its steps: leave out control, and "
                "set the number of steps between two samples by Stepping(substeps=...)"
            )
        if not isinstance(self.solver, diffrax.AbstractAdaptiveSolver):
            raise ModelError(
                f"{name} gives no error estimate, which {type(self.control).__name__} needs: "
                "choose another solver, or leave out control for fixed steps"
            )

    @property
    def batched(self) -> bool:
        """Whether many intervals are computed as one batch; then equations are not unrolled."""
        return isinstance(self.solver, RK4) and self.solver.batched

    @property
    def plain(self) -> bool:
        """Whether it is one of jaxid's own methods with fixed steps, which cannot fail."""
        return isinstance(self.solver, AbstractFixedStep) and self.control is None

    @property
    def unrolled(self) -> bool:
        """Whether equations are functions of scalars."""
        return not (self.batched or isinstance(self.solver, Exponential))


def _whole(solver: diffrax.AbstractSolver) -> bool:
    """Whether a solver takes the equations as one term."""
    form: Any = solver.term_structure
    return inspect.isclass(form) and issubclass(diffrax.ODETerm, form)


def ready(stepping: Stepping) -> diffrax.AbstractSolver:
    """The solver with the settings that diffrax would give to an unwrapped solver in a solve.

    An implicit solver whose root finder has no tolerances takes them from the step-size controller.
    Fixed steps have no controller. diffrax's own root finder is designed for one: with tight
    tolerances it mistakes rounding for divergence. It is then replaced by Newton's method.
    """
    solver: Any = stepping.solver
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        names = [n for n in ("rtol", "atol", "norm") if not _is_set(solver.root_finder, n)]
        if names and stepping.control is None:
            newton = optimistix.Newton(rtol=1e-9, atol=1e-9)
            solver = eqx.tree_at(lambda s: s.root_finder, solver, newton)
        elif names:
            given = [getattr(stepping.control, name) for name in names]
            at = lambda s: [getattr(s.root_finder, name) for name in names]  # noqa: E731
            solver = eqx.tree_at(at, solver, given)
    if isinstance(solver, diffrax.AbstractRungeKutta) and solver.scan_kind is None:
        # The kind of loop over the stages determines which derivatives are possible.
        kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
        kind = kinds.get(type(stepping.adjoint))
        solver = eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
    return solver


def _is_set(finder: Any, name: str) -> bool:
    value = getattr(finder, name)
    return callable(value) or eqx.is_array_like(value)
