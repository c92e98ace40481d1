"""Simulation of a loop along recordings, and its exact sensitivities."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..compiling import compiled
from ..recording import Recording, Recordings
from ..signals.standstill import Standstill
from .batch import Batch, Interval, prepare
from .dynamics import imposed
from .integration import (
    initial,
    integrate,
    integrate_with_tangents,
    observe,
    success,
    through_interval,
    unless_finite,
    with_tangents,
)
from .loop import ClosedLoop
from .sharing import one_by_one
from .steps import (
    UNROLLED,
    set_substeps,
    with_batches,
    with_forward_mode,
    with_rolled_stages,
    with_substeps,
)


class Simulated(eqx.Module):
    """Signals of one simulation at the samples, `(samples, joints)`, in SI units.

    `q` and `v` are the sensor readings, `tau` the commanded torque as it is recorded, `a` the
    acceleration of the drives and `delivered` their torque. `states` is the whole state,
    `(samples, states)`. `result` is zero if the solve succeeded; `jaxid.simulation.reason` explains
    other numbers. It is None for signals that were not simulated.
    """

    time: Float[Array | np.ndarray, "*batch samples"]
    q: Float[Array | np.ndarray, "*batch samples joints"]
    v: Float[Array | np.ndarray, "*batch samples joints"]
    a: Float[Array | np.ndarray, "*batch samples joints"]
    tau: Float[Array | np.ndarray, "*batch samples joints"]
    delivered: Float[Array | np.ndarray, "*batch samples joints"]
    states: Float[Array | np.ndarray, "*batch samples states"]
    result: Any = None


class Sensitivities(eqx.Module):
    """A run with the derivatives of its signals by parameters and further columns.

    - `seen`, `slopes`: signals and their derivatives at every grid point.
    - `end`, `end_slopes`: the state at the last grid point and its derivatives.
    - `result`: zero if the solve succeeded, see `reason`.
    """

    seen: Float[Array, "points rows joints"]
    slopes: Float[Array, "points rows joints columns"]
    end: Float[Array, " states"]
    end_slopes: Float[Array, "states columns"]
    result: Int[Array, ""]


# The fields of `Simulated` that have a row for each sample.
BY_SAMPLE = ("time", "q", "v", "a", "tau", "delivered", "states")


def each(fun: Callable, *args):
    """Maps a function over recordings: sequentially on a CPU, as one batch on an accelerator.

    One recording's states stay in a core's registers and first cache; a batch's do not.

    **Arguments:**

    - `args`: pytrees with `(recordings,)` before the axes of each leaf.
    """
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda one: fun(*one), args)
    return jax.vmap(fun)(*args)


def run(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    substeps: Int[Array, ""] | None = None,
    rows: tuple[int, ...] = tuple(range(5)),
) -> tuple[Float[Array, "points states"], Float[Array, "points rows joints"], Int[Array, ""]]:
    """One run from a flat initial state: states and signals at every grid point, and its result.

    **Arguments:**

    - `substeps`: a traced number, for programs that serve any number; None for the loop's own.
    - `rows`: which of `SIGNALS`.

    **Returns:** states, signals, and the result number: zero is success, see `reason`. After a
    failure of the solve, states and signals are not finite.
    """
    if loop.controller.period is not None:
        states, seen, code = _ticking(loop, intervals, x0, substeps, rows)
    else:
        states, code = integrate(loop, intervals, x0, substeps)
        seen = at_points(loop, lambda i, x: observe(loop, i, x, rows)[1], intervals, states)
    return states, seen, unless_finite(code, states[-1])


# Intervals of a batch whose derivatives are computed together; more leave the caches.
_BLOCK = 16


def at_points(loop: ClosedLoop, fun: Callable, *args):
    """Maps a function of an interval and more over grid points: as one batch if the motion is
    given, in small batches for loops `with_batches`, otherwise one after the other."""
    if loop.stepping.batched:
        found = jax.lax.map(lambda block: jax.vmap(fun)(*block), _blocks(args))
        count = jax.tree.leaves(args)[0].shape[0]
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], found)
    return jax.vmap(fun)(*args) if imposed(loop) else each(fun, *args)


def _blocks(args):
    """Leaves of `(points, ...)` as `(blocks, _BLOCK, ...)`; the last point fills the last block."""

    def parted(leaf):
        missing = -leaf.shape[0] % _BLOCK
        filled = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)])
        return filled.reshape(-1, _BLOCK, *leaf.shape[1:])

    return jax.tree.map(parted, args)


def _ticking(loop, intervals, x0, substeps, rows):
    """A run under a sampled law, interval by interval, because the law acts between intervals."""

    def body(carry, interval):
        x, code = carry
        held, seen = observe(loop, interval, x, rows)
        after, own = through_interval(loop, interval, held, substeps, code == 0)
        return (
            jnp.where(code == 0, after, jnp.nan),
            jnp.where(code == 0, own, code),
        ), (x, seen)

    start = x0, success()
    (_, code), (states, seen) = jax.lax.scan(body, start, intervals)
    return states, seen, code


def advance(
    loop: ClosedLoop, interval: Interval, x: Float[Array, " states"]
) -> tuple[Float[Array, " states"], Float[Array, "5 joints"], Int[Array, ""]]:
    """One interval: the state at its end, the signals at its start, and the result.

    **Arguments:**

    - `interval`: the inputs of the loop.
    - `x`: the state at its start, flat, `(states,)`.

    **Returns:** the state, `(states,)`, the rows of `SIGNALS`, `(5, joints)`, and the result
    number.
    """
    held, seen = observe(loop, interval, x, tuple(range(5)))
    after, code = through_interval(loop, interval, held)
    return after, seen, code


def run_with_sensitivities(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    start: Float[Array, "states columns"],
    rows: tuple[int, ...],
) -> Sensitivities:
    """One run, and the exact derivative of its signals by the loop's free parameters.

    All tangents are integrated together: each stage of each step is computed for all at once.

    **Arguments:**

    - `intervals`, `x0`: as in `run`.
    - `start`: derivative of `x0` by the parameters, and by any further columns,
      `(states, columns)`.
    - `rows`: which of `SIGNALS`.
    """
    if with_batches(loop).stepping.batched:
        return _in_batches(loop, intervals, x0, start, rows)
    loop, columns = with_rolled_stages(loop), start.shape[1]
    if loop.stepping.plain and loop.controller.period is None and not imposed(loop):
        states, tangents = integrate_with_tangents(loop, intervals, x0, start)

        def at(interval, x, tangents):
            shown = lambda loop, x: observe(loop, interval, x, rows)[1]  # noqa: E731
            return with_tangents(shown, loop, columns)(x, tangents)

        seen, slopes = at_points(loop, at, intervals, states, tangents)
        code = unless_finite(success(), states[-1])
        return Sensitivities(seen, slopes, states[-1], tangents[-1], code)
    theta, loop = loop.theta, with_forward_mode(loop)

    def shown(theta, x0):
        states, seen, code = run(loop.with_theta(theta), intervals, x0, rows=rows)
        return (seen, states[-1]), code

    def along(d_theta, d_start):
        return jax.jvp(shown, (theta, x0), (d_theta, d_start), has_aux=True)

    directions = jnp.eye(theta.shape[0], columns), start
    (seen, end), (slopes, end_slopes), code = jax.vmap(along, in_axes=1, out_axes=(None, -1, None))(
        *directions
    )
    return Sensitivities(seen, slopes, end, end_slopes, code)


def _in_batches(
    loop: ClosedLoop,
    intervals: Interval,
    x0: Float[Array, " states"],
    start: Float[Array, "states columns"],
    rows: tuple[int, ...],
) -> Sensitivities:
    """`run_with_sensitivities` of a loop `with_batches`: tangents follow from the derivatives of
    single intervals."""
    states, seen, code = run(with_rolled_stages(loop), intervals, x0, rows=rows)
    many = with_batches(loop)
    theta, m, p = loop.theta, x0.shape[0], loop.theta.shape[0]
    # The last grid point ends the run; points that fill a block follow it.
    inside = jnp.arange(states.shape[0]) < states.shape[0] - 1

    def at(interval: Interval, x: Float[Array, " states"]):
        def one(u):
            own = many.with_theta(u[m:])
            held, shown = observe(own, interval, u[:m], rows)
            after, _ = through_interval(own, interval, held)
            return jnp.concatenate([after, shown.ravel()])

        return jax.jacfwd(one)(jnp.concatenate([x, theta]))

    def along(tangents, point):
        slope, going = point
        change = slope[:, :m] @ tangents
        change = change.at[:, :p].add(slope[:, m:])
        return jnp.where(going, change[:m], tangents), change[m:]

    def through(tangents, block):
        interval, x, going = block
        return jax.lax.scan(along, tangents, (jax.vmap(at)(interval, x), going))

    last, slopes = jax.lax.scan(through, start, _blocks((intervals, states, inside)))
    slopes = slopes.reshape(-1, *slopes.shape[2:])[: len(states)]
    slopes = slopes.reshape(*seen.shape, start.shape[1])
    return Sensitivities(seen, slopes, states[-1], last, code)


@compiled
def _simulate(loop: ClosedLoop, batch: Batch, substeps: Int[Array, ""] | None) -> Simulated:
    if loop.joints > UNROLLED:
        # Half of the compilation, which takes longer than dozens of runs.
        loop = with_rolled_stages(loop)

    def one(intervals, at, q0, v0, time):
        states, seen, code = run(loop, intervals, initial(loop, intervals, q0, v0), substeps)
        if at is not None:
            states, seen = states[at], seen[at]
        tau, q, v, a, delivered = jnp.moveaxis(seen, 1, 0)
        return Simulated(time, q, v, a, tau, delivered, states, code)

    return each(one, batch.intervals, batch.at, batch.q0, batch.v0, batch.time)


def simulate(
    loop: ClosedLoop,
    recordings: Recording | Recordings | Sequence[Recording],
    *,
    noise: Sequence[np.ndarray] | None = None,
) -> tuple[Simulated, ...]:
    """Simulates the loop along recordings, with their references and initial states.

    **Arguments:**

    - `loop`: the model.
    - `recordings`: give references and initial states.
    - `noise`: added to the sensor readings, `(samples, joints)` for each recording; it is fed back
      through the controller.

    **Returns:** one `Simulated` for each recording.

    **Raises:** `RecordingError` or `ModelError` if loop and recordings do not match.
    """
    recordings = Recordings.of(recordings)
    batch = prepare(loop, recordings, noise)
    return by_recording(simulate_batch(with_substeps(loop, recordings), batch), recordings)


def by_recording(
    together: Simulated, recordings: Recordings | Sequence[Recording]
) -> tuple[Simulated, ...]:
    """Splits the runs of a batch, `(recordings, samples, ...)`, without the padding."""
    return tuple(
        jax.tree.map(
            lambda leaf, k=k, r=r: np.asarray(leaf[(k, slice(r.samples))[: np.ndim(leaf)]]),
            together,
        )
        for k, r in enumerate(recordings)
    )


def simulate_batch(loop: ClosedLoop, batch: Batch) -> Simulated:
    """Simulates the loop along a batch; leaves have `(recordings, samples)` first, padded."""
    substeps: Any = None
    forward = isinstance(loop.stepping.adjoint, diffrax.ForwardMode)
    if loop.stepping.control is None and forward:
        # One program serves any number of steps; refining them needs no compilation.
        substeps = np.asarray(loop.stepping.substeps or 1)
        loop = set_substeps(loop, None, settled=False)
    batch = batch.uncompared()
    # Neither affects the signals, and a program would depend on them.
    loop = dataclasses.replace(loop, standstill=Standstill(), held=(), freed=())
    return jax.device_get(one_by_one(lambda one: _simulate(loop, one, substeps), batch))
