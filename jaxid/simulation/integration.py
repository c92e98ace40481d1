"""Integration of a loop through the intervals of a recording, by diffrax.

The unit of time is an interval (see `by_interval`), so the loop's inputs are looked up without a
search. Padding consists of intervals of zero length, which leave the state unchanged.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..control import Reading, Reference
from .batch import Interval
from .by_interval import (
    CutSteps,
    EqualSteps,
    OneStep,
    Rate,
    Scalars,
    ThroughIntervals,
    Window,
    WithinIntervals,
    apart,
    one_of,
    together,
)
from .dynamics import Instant, Outside, imposed, instant, reading
from .exponential import Exponential
from .loop import ClosedLoop
from .pruning import pruned
from .state import State, behind, read, rest, settle, unflatten
from .stepping import ready
from .unrolling import unrolled

SIGNALS = ("tau", "q", "v", "a", "delivered")


# --- one instant --------------------------------------------------------------------------------


def _line(ends: Float[Array, "2 joints"] | None, dt, h, joints: int) -> Float[Array, " joints"]:
    """Linear interpolation between two ends, at a time after the first."""
    if ends is None:
        return jnp.zeros(joints)
    return ends[0] + dt * (ends[1] - ends[0]) / jnp.where(h > 0, h, 1.0)


def _reference(interval: Interval, dt: Float[Array, ""]) -> Reference:
    c0, c1, c2, c3 = interval.reference
    q = c0 + dt * (c1 + dt * (c2 + dt * c3))
    v = c1 + dt * (2 * c2 + 3 * dt * c3)
    a = 2 * c2 + 6 * dt * c3
    return Reference(q, v, a, interval.torque[0] + dt * interval.torque[1], interval.held)


def outside_at(loop: ClosedLoop, interval: Interval, t: Float[Array, ""]) -> Outside:
    """External inputs at a time within an interval, s."""
    dt = t - interval.t0
    noise, rate, push, pull = (
        _line(ends, dt, interval.h, loop.joints)
        for ends in (interval.noise, interval.rate, interval.push, interval.pull)
    )
    bend = jnp.zeros(loop.joints)
    if interval.rate is not None:
        bend = (interval.rate[1] - interval.rate[0]) / jnp.where(interval.h > 0, interval.h, 1.0)
    return Outside(push, pull, Reading(noise, rate), bend)


def instant_at(loop: ClosedLoop, interval: Interval, t: Float[Array, ""], state: State) -> Instant:
    """The loop at a time within an interval, s."""
    outside = outside_at(loop, interval, t)
    return instant(loop, t, state, _reference(interval, t - interval.t0), outside, interval.label)


def initial(
    loop: ClosedLoop,
    intervals: Interval,
    q: Float[Array, " joints"],
    v: Float[Array, " joints"],
) -> Float[Array, " states"]:
    """The flat state at the start of a run, `(states,)`, at measured position and velocity."""
    first = jax.tree.map(lambda leaf: leaf[0], intervals)
    reference = _reference(first, jnp.zeros(()))
    start = rest(loop, *behind(loop, q, v))
    held = start.controller
    if first.integrals is not None:
        held = held + first.integrals
    held = loop.controller.running(read(loop, start.q, start.v), reference, held)
    start = dataclasses.replace(start, controller=held)
    return ravel_pytree(settle(loop, first.t0, start, reference, first.label))[0]


def start_slopes(
    loop: ClosedLoop,
    intervals: Interval,
    q: Float[Array, " joints"],
    v: Float[Array, " joints"],
) -> Float[Array, "states starts"]:
    """Derivative of `initial` by the free parameters, the position and the velocity.

    The columns are in this order, `(states, parameters + 2 joints)`.
    """
    n, p = loop.joints, loop.theta.shape[0]

    def begin(z: Float[Array, " starts"]) -> Float[Array, " states"]:
        return initial(loop.with_theta(z[:p]), intervals, z[p : p + n], z[p + n :])

    return jax.jacfwd(begin)(jnp.concatenate([loop.theta, q, v]))


def observe(
    loop: ClosedLoop, interval: Interval, x: Float[Array, " states"], rows: tuple[int, ...]
) -> tuple[Float[Array, " states"], Float[Array, "rows joints"]]:
    """The start of an interval: the state after a sampled law's tick, and rows of `SIGNALS`."""
    unravel = unflatten(loop)

    def begin(interval: Interval, x: Float[Array, " states"]):
        state = unravel(x)
        if loop.controller.period is not None:
            asked = _reference(interval, jnp.zeros(()))
            sensed = reading(loop, state, outside_at(loop, interval, interval.t0))
            ticked = loop.controller.tick(sensed, asked, state.controller)
            held = jnp.where(interval.tick, ticked, state.controller)
            state = dataclasses.replace(state, controller=held)
        now = instant_at(loop, interval, interval.t0, state)
        seen = (now.command, now.reading.q, now.reading.v, now.a, now.tau)
        return ravel_pytree(state)[0], jnp.stack([seen[row] for row in rows])

    # Along a given motion the instants are independent, so many are computed as one array.
    if imposed(loop) or loop.stepping.batched:
        return begin(interval, x)
    return unrolled(begin, interval, x)(interval, x)


# --- one solve ----------------------------------------------------------------------------------


def _rate(loop: ClosedLoop, intervals: Interval, x: Float[Array, " states"]) -> Rate:
    """The loop's equations, 1/s: a function of an interval, a time in it and a state.

    The state is unrolled to scalars, unless many intervals are computed in one batch.
    """
    unravel = unflatten(loop)

    def whole(interval: Interval, t: Float[Array, ""], x: Float[Array, " states"]):
        return ravel_pytree(instant_at(loop, interval, t, unravel(x)).derivative)[0]

    def rate(interval: Interval, t: Float[Array, ""], y: Scalars) -> Scalars:
        return tuple(whole(interval, t, jnp.stack(y)))

    if loop.stepping.batched:
        return whole
    first = one_of(intervals, jnp.asarray(0))
    return unrolled(rate, first, first.t0, tuple(x))


def with_tangents(
    fun: Callable[..., Any], loop: ClosedLoop, columns: int
) -> Callable[..., tuple[Any, Any]]:
    """A function of a state and its tangents that returns `fun` with its derivatives.

    **Arguments:**

    - `fun`: a function of a loop with some parameters and of a state.
    - `columns`: number of tangents; the first are by the loop's free parameters.
    """
    theta = loop.theta
    directions = jnp.eye(theta.shape[0], columns)

    def both(x, tangents):
        def along(d_theta, d_x):
            return jax.jvp(lambda at, x: fun(loop.with_theta(at), x), (theta, x), (d_theta, d_x))

        return jax.vmap(along, in_axes=(1, -1), out_axes=(None, -1))(directions, tangents)

    return both


def _solve(
    loop: ClosedLoop,
    rate: Rate,
    intervals: Interval,
    y0: PyTree[Array],
    saveat: diffrax.SaveAt,
    substeps: int | Int[Array, ""] | None = None,
    stop: float | Float[Array, ""] | None = None,
) -> diffrax.Solution:
    """Solves from the start of the first interval to the end of the last, or to `stop`."""
    stepping, count = loop.stepping, intervals.h.shape[0]
    substeps = _substeps(loop, substeps)

    def field(t, y, window):
        window = window.at(t)
        now = one_of(window.intervals, jnp.asarray(0))
        at = now.t0 + (t - window.first) * now.h
        slope = together(rate(now, at, apart(y)), y) if stepping.unrolled else rate(now, at, y)
        return jax.tree.map(lambda leaf: now.h * leaf, slope)

    made_jump, most = None, count
    control = stepping.control
    if stepping.plain:
        method = ThroughIntervals(stepping.solver, rate, substeps, stepping.unrolled)
        solver, steps = method, OneStep()
    elif control is None:
        solver, steps = WithinIntervals(ready(stepping)), EqualSteps(substeps)
        made_jump, most = True, substeps * count if isinstance(substeps, int) else None
    else:
        solver = WithinIntervals(ready(stepping))
        length = jnp.where(intervals.h > 0, intervals.h, 1.0)
        first = length[0] / substeps
        steps: Any = CutSteps(control, intervals.t0, length, first)  # type: ignore[reportCallIssue]
        most = stepping.max_steps * count
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        solver,
        0.0,
        float(count) if stop is None else stop,
        None,
        y0,
        Window(intervals),
        saveat=saveat,
        stepsize_controller=steps,
        adjoint=stepping.adjoint,
        max_steps=most,
        made_jump=made_jump,
        throw=False,
    )


def integrate(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    substeps: int | Int[Array, ""] | None = None,
) -> tuple[Float[Array, "points states"], Int[Array, ""]]:
    """One solve through all intervals: the states at grid points, and how it ended.

    After a failure of the solve, states are infinite.

    **Arguments:**

    - `intervals`: between grid points; the last one has zero length and ends the run.
    - `substeps`: replaces the number in the settings; a traced value serves any number.
    """
    if imposed(loop):
        return _states_along_reference(loop, intervals, x0, substeps), success()
    through = jax.tree.map(lambda leaf: leaf[:-1], intervals)
    rate = _rate(loop, through, x0)
    if loop.stepping.plain:
        return _at_steps(loop, rate, through, x0, substeps), success()
    saveat = diffrax.SaveAt(ts=jnp.arange(float(intervals.h.shape[0])))
    solution = _solve(loop, rate, through, x0, saveat, substeps)
    assert solution.ys is not None
    return solution.ys, _number(solution.result)


def _states_along_reference(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    substeps: int | Int[Array, ""] | None,
) -> Float[Array, "points states"]:
    """The states at grid points where the reference is the motion.

    Only the effects' own states are integrated.
    """
    unravel, count = unflatten(loop), intervals.h.shape[0]
    own = unravel(x0).effects
    if any(state.size for state in own):
        through = jax.tree.map(lambda leaf: leaf[:-1], intervals)
        rates = _rates_of_effects(loop, one_of(through, jnp.asarray(0)), x0)
        own = _at_steps(_for_effects(loop), rates, through, own, substeps)
    else:
        own = jax.tree.map(lambda state: jnp.zeros((count, 0)), own)

    def at(interval: Interval, own: tuple[Float[Array, " _"], ...]) -> Float[Array, " states"]:
        now = _reference(interval, jnp.zeros(()))
        q, v = behind(loop, now.q, now.v)
        return ravel_pytree(dataclasses.replace(unravel(x0), q=q, v=v, effects=own))[0]

    return jax.vmap(at)(intervals, own)


def _for_effects(loop: ClosedLoop) -> ClosedLoop:
    """The loop with the method for its effects' own states along an imposed motion."""
    stepping = dataclasses.replace(loop.stepping, solver=Exponential(), control=None)
    return dataclasses.replace(loop, stepping=stepping)


def _rates_of_effects(loop: ClosedLoop, interval: Interval, x: Float[Array, " states"]) -> Rate:
    """Rates of the effects' own states along an imposed motion, 1/s; otherwise as `_rate`."""
    state = unflatten(loop)(x)

    def rates(interval: Interval, t: Float[Array, ""], own: tuple[Float[Array, " _"], ...]):
        at = dataclasses.replace(state, effects=own)
        return instant_at(loop, interval, t, at).derivative.effects

    # Hardly any of them depends on the torque of the arm.
    return pruned(rates, interval, interval.t0, state.effects)


def integrate_with_tangents(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    start: Float[Array, "states columns"],
) -> tuple[Float[Array, "points states"], Float[Array, "points states columns"]]:
    """`integrate` with the derivative of every state, for RK4 with fixed steps.

    RK4 integrates the sensitivity equations together with the state. For fixed steps this is the
    exact derivative of the discrete run, equal to forward mode through the solve. Tracing takes
    half as long: forward mode and `vmap` would each trace all of diffrax again.
    """
    through = jax.tree.map(lambda leaf: leaf[:-1], intervals)

    # Jitted separately, because diffrax traces a step several times.
    @jax.jit
    def rate(interval, t, rows):
        def plain(loop, x):
            return _rate(loop, through, x0)(interval, t, x)

        return with_tangents(plain, loop, start.shape[1])(*rows)

    return _at_steps(loop, rate, through, (x0, start))


def _at_steps(loop, rate, through, y0, substeps=None):
    """States at grid points if every step is an interval: no interpolation, no failing steps."""
    ys = _solve(loop, rate, through, y0, diffrax.SaveAt(steps=True), substeps).ys
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), y0, ys)


def through_interval(
    loop: ClosedLoop,
    interval: Interval,
    x: Float[Array, " states"],
    substeps: int | Int[Array, ""] | None = None,
    alive: Bool[Array, ""] | None = None,
) -> tuple[Float[Array, " states"], Int[Array, ""]]:
    """The state at an interval's end, NaN if the solve fails, and how it ended.

    **Arguments:**

    - `alive`: False if there is nothing left to solve.
    """
    alone = jax.tree.map(lambda leaf: leaf[None], interval)
    if imposed(loop):
        state = unflatten(loop)(x)
        if not any(own.size for own in state.effects):
            return x, success()
        rates = _rates_of_effects(loop, interval, x)
        own = _one_step(_for_effects(loop), rates, alone, state.effects, substeps)
        return ravel_pytree(dataclasses.replace(state, effects=own))[0], success()
    rate = _rate(loop, alone, x)
    if loop.stepping.plain:
        return _one_step(loop, rate, alone, x, substeps), success()
    stop = None
    if alive is not None and loop.stepping.control is not None:
        stop = jnp.where(alive, 1.0, 0.0)
    solution = _solve(loop, rate, alone, x, diffrax.SaveAt(t1=True), substeps, stop)
    code = _number(solution.result)
    assert solution.ys is not None
    return jnp.where(code == 0, solution.ys[0], jnp.nan), code


def _one_step(loop, rate, alone, y, substeps):
    """A state at the end of an interval, by one of jaxid's own methods.

    The step cannot fail; a solve around it would only lengthen the compilation.
    """
    stepping, start = loop.stepping, jnp.zeros(())
    solver = ThroughIntervals(stepping.solver, rate, _substeps(loop, substeps), stepping.unrolled)
    return solver.step(None, start, start + 1, y, Window(alone), None, False)[0]


def _substeps(loop: ClosedLoop, given: int | Int[Array, ""] | None) -> int | Int[Array, ""]:
    return loop.stepping.substeps or 1 if given is None else given


# --- how a solve ended --------------------------------------------------------------------------


def success() -> Int[Array, ""]:
    """The result number of a successful solve."""
    return jnp.zeros((), jnp.int32)


def unless_finite(code: Int[Array, ""], values: Float[Array, "..."]) -> Int[Array, ""]:
    """The result number; if it is success and values are not finite, the number for that."""
    bad = ~jnp.all(jnp.isfinite(values))
    return jnp.where((code == 0) & bad, _number(diffrax.RESULTS.nonfinite), code)


def _number(result: Any) -> Int[Array, ""]:
    (number,) = jax.tree.leaves(result)
    return jnp.asarray(number, jnp.int32)


def reason(code: int | np.integer | Int[Array | np.ndarray, ""]) -> str:
    """The reason why a solve failed, in diffrax's words; empty after success."""
    kind = jax.tree.structure(diffrax.RESULTS.successful)
    return diffrax.RESULTS[jax.tree.unflatten(kind, [np.asarray(code)])]
