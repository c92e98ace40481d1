"""The loop along a run as a linear time-varying system: one linearisation, many inputs."""

import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiling import compiled
from ..effects import AbstractTransmission, Motion
from ..simulation.batch import Batch, Interval
from ..simulation.compared import compared_series, compared_table
from ..simulation.dynamics import imposed
from ..simulation.integration import SIGNALS, initial, start_slopes
from ..simulation.loads import link_load
from ..simulation.loop import ClosedLoop
from ..simulation.runs import advance, at_points, each, run
from ..simulation.sharing import one_by_one
from ..simulation.state import unflatten
from ..simulation.steps import with_batches, with_forward_mode, with_rolled_stages
from ..simulation.widening import widened

Place = Literal["push", "noise", "rate", "pull"]


class Linearised(eqx.Module):
    """Exact derivatives of every interval along the runs of a batch.

    The system is x' = A x + B u, y = C x + D u. The input u contains the free parameters, then each
    of `places` at both ends of an interval: torque on the drives (`push`), additions to the
    positions (`noise`) and velocities (`rate`) that the sensors read, and torque on the links
    (`pull`) if transmissions or load-dependent friction separate them from the drives. Each leaf
    has `(recordings, points)` first, except `start`, the derivatives of the first state by the free
    parameters, the position and the velocity. `direct` is true along an imposed motion, where
    torques change no state. `motion` is the nominal motion, `seen` the signals of `SIGNALS`.
    """

    A: Float[Array, "recordings points states states"]
    B: Float[Any, "recordings points states inputs"]
    C: Float[Array, "recordings points outputs states"]
    D: Float[Any, "recordings points outputs inputs"]
    start: Float[Any, "recordings states starts"]
    motion: Motion
    seen: Float[Array, "recordings points 5 joints"]
    places: tuple[Place, ...] = eqx.field(static=True)
    direct: bool = eqx.field(static=True, default=False)

    def inputs(self, place: Place) -> slice:
        """The inputs of a place, at the beginning and the end of an interval."""
        joints, last = self.motion.q.shape[-1], self.B.shape[-1]
        first = last - 2 * joints * (len(self.places) - self.places.index(place))
        return slice(first, first + 2 * joints)


def linearise(loop: ClosedLoop, batch: Batch, output: str) -> Linearised:
    """Runs the loop and linearises every interval.

    **Arguments:**

    - `output`: which of `SIGNALS` is compared.
    """
    batch = batch.uncompared()
    wide, own = widened(loop)
    others = wide.theta.shape[0]

    def along(one: Batch) -> Linearised:
        found = _linearised(wide, one, output)

        def of_loop(slopes: Any) -> Float[np.ndarray, "..."]:
            inputs = np.append(own, np.arange(others, slopes.shape[-1]))
            return np.asarray(slopes)[..., inputs]

        B, D, start = of_loop(found.B), of_loop(found.D), of_loop(found.start)
        return dataclasses.replace(found, B=B, D=D, start=start)

    linear = one_by_one(along, batch)
    torques = [linear.inputs(place) for place in ("push", "pull") if place in linear.places]
    direct = not any(np.any(np.asarray(linear.B[..., inputs])) for inputs in torques)
    return dataclasses.replace(linear, direct=direct)


@compiled
def _linearised(loop: ClosedLoop, batch: Batch, output: str) -> Linearised:
    loop = with_forward_mode(with_rolled_stages(loop))
    many = with_batches(loop)
    n, theta, row = loop.joints, loop.theta, SIGNALS.index(output)
    p = theta.shape[0]
    parted = any(isinstance(e, AbstractTransmission) or e.loaded for e in loop.effects)
    places: tuple[Place, ...] = ("push", "noise", "rate", *(("pull",) if parted else ()))
    ends = jnp.zeros((2 * len(places), n))

    def one(u, interval, x):
        outside = dict(zip(places, u[p:].reshape(-1, 2, n), strict=True))
        forced = dataclasses.replace(interval, **outside)
        # A failed solve is not finite, so its result number is not needed.
        after, seen, _ = advance(many.with_theta(u[:p]), forced, x)
        return jnp.concatenate([after, seen[row]]), seen

    def at(interval, x):
        m = x.shape[0]
        u = jnp.concatenate([x, theta, ends.ravel()])
        slope, seen = jax.jacfwd(lambda w: one(w[m:], interval, w[:m]), has_aux=True)(u)
        return slope[:m, :m], slope[:m, m:], slope[m:, :m], slope[m:, m:], seen

    def whole(intervals: Interval, q0, v0):
        x0 = initial(loop, intervals, q0, v0)
        # The signals are those of `at`, so that the equations are compiled only once.
        states, _, _ = run(loop, intervals, x0)
        a, b, c, d, seen = at_points(many, at, intervals, states)
        start = start_slopes(loop, intervals, q0, v0)
        still = jnp.zeros((states.shape[0], 0))
        motion = jax.vmap(Motion)(
            intervals.t0,
            states[:, :n],
            states[:, n : 2 * n],
            seen[:, 3],
            seen[:, 4],
            still,
            intervals.label,
            intervals.held,
        )
        own = jax.vmap(lambda x: unflatten(loop)(x).effects)(states)
        load = jax.vmap(lambda at, own: link_load(loop, at, own))(motion, own)
        motion = jax.vmap(
            lambda at, load: dataclasses.replace(at, load=load, imposed=imposed(loop))
        )(motion, load)
        return a, b, c, d, start, motion, seen

    return Linearised(*each(whole, batch.intervals, batch.q0, batch.v0), places=places)


def base_columns(
    linear: Linearised, parameters: int, free_start: bool
) -> Float[Array, "recordings points outputs columns"]:
    """Derivative of the output by the loop's own parameters, and by initial states if free.

    Initial states have one set of columns, which applies to each recording separately.
    """
    return one_by_one(lambda one: _base_columns(one, parameters, free_start), linear)


@compiled
def _base_columns(
    linear: Linearised, parameters: int, free_start: bool
) -> Float[Array, "recordings points outputs columns"]:

    def one(a, b, c, d, start):
        first = start if free_start else start[:, :parameters]
        extra = first.shape[1] - parameters

        def body(s, step):
            a, b = step
            return a @ s + jnp.pad(b, ((0, 0), (0, extra))), s

        _, history = jax.lax.scan(body, first, (a, b[..., :parameters]))
        direct = jnp.pad(d[..., :parameters], ((0, 0), (0, 0), (0, extra)))
        return c @ history + direct

    return each(one, linear.A, linear.B, linear.C, linear.D, linear.start)


def respond(
    linear: Linearised,
    place: Place,
    values: Float[Array | np.ndarray, "recordings points joints columns"],
) -> Float[Array, "recordings points outputs columns"]:
    """Response of the output to inputs given at the points, linear in between.

    **Arguments:**

    - `place`: one of `linear.places`.
    - `values`: one column per hypothesis: N·m or N; rad or m; rad/s or m/s.
    """
    # Only the inputs of the place: the others would be copied for each recording, and a program
    # would be compiled for each number of free parameters.
    inputs = linear.inputs(place)
    b, d = linear.B[..., inputs], linear.D[..., inputs]
    if linear.direct and place in ("push", "pull"):
        return one_by_one(lambda one: _direct_response(*one), (d, values))
    first = _first_state(linear, place)
    system = linear.A, b, linear.C, d, first
    return one_by_one(lambda one: _response(*one), (*system, values))


def _first_state(linear: Linearised, place: Place) -> Float[Any, "recordings states joints"]:
    """Derivative of the first state by the inputs of a place at the first point."""
    joints, last = linear.motion.q.shape[-1], linear.start.shape[-1]
    if place not in ("noise", "rate"):
        return np.zeros((*linear.start.shape[:2], joints))
    # A run starts at the position and velocity that the sensors read.
    first = last - joints * (2 if place == "noise" else 1)
    return -linear.start[..., first : first + joints]


@compiled
def _direct_response(
    d: Float[Any, "recordings points outputs inputs"],
    values: Float[Any, "recordings points joints columns"],
) -> Float[Array, "recordings points outputs columns"]:
    after = jnp.concatenate([values[:, 1:], values[:, -1:]], axis=1)
    both = jnp.concatenate([values, after], axis=2)
    return d.astype(values.dtype) @ both


# With more states a product of matrices is faster than one loop over the columns: with 36 states
# and 5000 columns by a factor of five, with 16 states and 600 columns by nothing.
_FEW_STATES = 16


@compiled
def _response(
    a: Float[Any, "recordings points states states"],
    b: Float[Any, "recordings points states inputs"],
    c: Float[Any, "recordings points outputs states"],
    d: Float[Any, "recordings points outputs inputs"],
    first: Float[Any, "recordings states joints"],
    values: Float[Any, "recordings points joints columns"],
) -> Float[Array, "recordings points outputs columns"]:
    def times(matrix, columns):
        if a.shape[-1] > _FEW_STATES:
            return matrix @ columns
        # In this form XLA fuses the four products into one loop over the columns.
        return jnp.sum(matrix[:, :, None] * columns[None], axis=1)

    def one(a, b, c, d, first, values):
        def body(carry, step):
            s, now = carry
            a, b, c, d, then = step
            u = jnp.concatenate([now, then])
            return (times(a, s) + times(b, u), then), times(c, s) + times(d, u)

        after = jnp.concatenate([values[1:], values[-1:]])
        s = times(first.astype(values.dtype), values[0])
        matrices = (x.astype(values.dtype) for x in (a, b, c, d))
        return jax.lax.scan(body, (s, values[0]), (*matrices, after))[1]

    return each(one, a, b, c, d, first, values)


def sampled(batch: Batch, tree: Any) -> Any:
    """Leaves of `(recordings, points, ...)` at the samples; the grid may be finer."""
    if batch.at is None:
        return tree
    rows = np.arange(len(batch.at))[:, None], np.asarray(batch.at)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def at_samples(
    batch: Batch, x: Float[np.ndarray, "recordings points outputs *columns"]
) -> Float[np.ndarray, "recordings rows outputs *columns"]:
    """Rows at the samples, in the compared band; zero for padding."""
    table = sampled(batch, np.asarray(x))
    columns = table.shape[3:]
    found = compared_table(
        batch.band, batch.moving, batch.mask, table.reshape(*table.shape[:3], -1)
    )
    return found.reshape(*found.shape[:3], *columns)


def series_at_samples(
    batch: Batch,
    output: Int[np.ndarray, " series"],
    x: Float[np.ndarray, "recordings points series"],
) -> Float[np.ndarray, "recordings rows series"]:
    """The same for series that each belong to one output."""
    return compared_series(batch.band, batch.moving, batch.mask, output, sampled(batch, x))


def row_period(
    time: Float[np.ndarray, "recordings rows"], mask: Bool[np.ndarray, "recordings rows"]
) -> float:
    """Time between compared rows, s. Padding of recordings that are shorter repeats their end."""
    longest = int(mask.sum(axis=1).argmax())
    return float(np.median(np.diff(time[longest, mask[longest]])))


def at_rows(batch: Batch, tree: Any) -> Any:
    """Leaves of `(recordings, points, ...)` without filtering, at the compared rows."""
    if batch.band is None:
        return sampled(batch, tree)
    return jax.tree.map(batch.band.picked, sampled(batch, tree))
