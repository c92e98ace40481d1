"""How a loop is integrated: solver, steps, interpolation of the reference."""

from typing import ClassVar, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree


class RK4(diffrax.AbstractSolver):
    """The classical Runge–Kutta method of order four, for fixed steps (Kutta 1901).

    diffrax's own methods carry error estimates and dense output, which cost more than the
    physics of four states when neither is used.

    **Arguments:**

    - `rolled`: the stages as a loop, which is less to compile and to hold.
    """

    rolled: bool = eqx.field(static=True, default=False)
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: PyTree) -> int:
        """Four."""
        return 4

    def init(self, terms, t0, t1, y0, args) -> None:
        """It keeps nothing between steps."""
        return None

    def func(self, terms, t0, y0, args):
        """The vector field."""
        return terms.vf(t0, y0, args)

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

    **Arguments:**

    - `solver`: a diffrax solver.
    - `substeps`: steps between two samples; None to choose by the loop's fastest time constant.
    - `control`: a diffrax step-size controller; None for fixed steps, which are the fastest.
    - `adjoint`: of each adaptive solve; fixed steps are differentiated directly.
    - `interpolation`: of the reference between samples, `"cubic"`, `"linear"` or `"hold"`.
    - `settled`: whether jaxid has chosen `substeps`, and may choose more; no setting of a user's.
    """

    solver: diffrax.AbstractSolver = RK4()
    substeps: int | None = eqx.field(static=True, default=None)
    control: diffrax.AbstractStepSizeController | None = None
    adjoint: diffrax.AbstractAdjoint = diffrax.ForwardMode()
    interpolation: Literal["cubic", "linear", "hold"] = eqx.field(static=True, default="cubic")
    settled: bool = eqx.field(static=True, default=False)


def flow(
    stepping: Stepping,
    field,
    t0: Float[Array, ""],
    h: Float[Array, ""],
    x: PyTree[Float[Array, "..."]],
    substeps: Int[Array, ""] | None = None,
) -> PyTree[Float[Array, "..."]]:
    """The state after an interval of `h` seconds; `field(t, x, args)` gives its rate.

    A padded interval has no length and leaves the state as it is. `substeps` takes the place of
    the settings' own, for programs that serve any number; they have no reverse mode.
    """
    terms = diffrax.ODETerm(field)
    if stepping.control is not None:
        return _adaptive(stepping, terms, t0, h, x)
    known = substeps is None
    count = (stepping.substeps or 1) if substeps is None else substeps
    solver, dt = stepping.solver, h / count
    memory = solver.init(terms, t0, t0 + dt, x, None)

    def substep(carry, k):
        y, memory = carry
        start = t0 + k * dt
        y, _, _, memory, _ = solver.step(terms, start, start + dt, y, None, memory, False)
        return (y, memory), None

    if not known:
        return jax.lax.fori_loop(0, count, lambda k, c: substep(c, k)[0], (x, memory))[0]
    if stepping.substeps in (None, 1):
        return substep((x, memory), 0)[0][0]
    (x, _), _ = jax.lax.scan(substep, (x, memory), jnp.arange(stepping.substeps))
    return x


def _adaptive(
    stepping: Stepping,
    terms: diffrax.ODETerm,
    t0: Float[Array, ""],
    h: Float[Array, ""],
    x: Float[Array, " states"],
) -> Float[Array, " states"]:
    # A padded interval is solved over a token length, and its result is not used.
    length = jnp.where(h > 0, h, 1e-6)
    assert stepping.control is not None
    solution = diffrax.diffeqsolve(
        terms,
        stepping.solver,
        t0,
        t0 + length,
        length / (stepping.substeps or 1),
        x,
        stepsize_controller=stepping.control,
        adjoint=stepping.adjoint,
        saveat=diffrax.SaveAt(t1=True),
        max_steps=4096,
        throw=False,
    )
    assert solution.ys is not None
    finished = jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys[-1], jnp.nan)
    return jnp.where(h > 0, finished, x)
