"""What the integrals of a law hold at the first sample of a recording."""

from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..compiling import compiled
from ..control import Reading, Reference, Sampled
from ..recording import Recording
from .loop import ClosedLoop

# Most grid points along which a law is computed, and the blocks from which deviations follow.
_POINTS, _BLOCKS = 1000, 20
# Smallest integral that counts, in standard deviations.
_SURE = 3.0
# Share of the recorded torque from which what the law leaves of it shows that it is another law.
_OTHER = 0.2


class Along(eqx.Module):
    """The inputs of a law along one recording, at its grid points.

    `time` is in s. `tick` marks the ticks of a sampled law. `signals` are the position and velocity
    that it reads, the reference's position, velocity and acceleration, rad or m and per s, and the
    known torque, N·m or N. `held` are the signals of `Reference.held`. `torque` is the recorded
    one, N·m or N, NaN between samples.
    """

    time: Float[Any, " points"]
    tick: Bool[Any, " points"]
    signals: Float[Any, "points 6 joints"]
    held: dict[str, Float[Any, "points joints"]]
    torque: Float[Any, "points joints"]

    @classmethod
    def of(
        cls,
        recording: Recording,
        grid: Float[np.ndarray, " points"],
        tick: Bool[np.ndarray, " points"],
        reference: Float[np.ndarray, "points 4 joints"],
        held: dict[str, Float[np.ndarray, "points joints"]],
    ) -> "Along":
        """The inputs from a recording, at grid points that contain its samples."""
        import scipy

        position = scipy.interpolate.CubicSpline(recording.time, recording.q)
        speed = position.derivative()
        if recording.v is not None:
            speed = scipy.interpolate.CubicSpline(recording.time, recording.v)
        read = np.stack([position(grid), speed(grid)], axis=1)
        torque = np.full((len(grid), recording.joints), np.nan)
        torque[np.searchsorted(grid, recording.time)] = recording.tau
        return cls(grid, tick, np.concatenate([read, reference], axis=1), held, torque)

    def first(self, points: int) -> "Along":
        """The same up to a number of points."""
        return jax.tree.map(lambda leaf: leaf[:points], self)


def integral_states(loop: ClosedLoop) -> Bool[np.ndarray, " states"]:
    """Which states of the law are integrals: their rate depends on none of its states."""
    law, some = loop.controller, jnp.linspace(0.1, 0.2, loop.joints)
    reading, reference = Reading(some, some), Reference(some, some, some, some)
    state = law.initial_state(reading)
    if not state.size or law.pace > 0:
        return np.zeros(state.size, bool)
    if law.period is None:
        rates = jax.jacfwd(lambda s: law.derivative(reading, reference, s))(state)
        return ~np.any(np.asarray(rates), axis=1)
    after = jax.jacfwd(lambda s: law.tick(reading, reference, s))(state)
    return np.all(np.asarray(after) == np.eye(state.size), axis=1)


def has_other_states(loop: ClosedLoop) -> bool:
    """Whether the law has states of its own that no recording shows: those of filters."""
    law = loop.controller
    law = law.law if isinstance(law, Sampled) else law
    if law.period is not None:
        # Readings and commands of the last ticks.
        return False
    zeros = jnp.zeros(loop.joints)
    return law.initial_state(Reading(zeros, zeros)).size > int(integral_states(loop).sum())


def integrals_at_start(
    loop: ClosedLoop, own: Bool[np.ndarray, " states"], recordings: Sequence[Along]
) -> Float[np.ndarray, "recordings states"]:
    """States to add to the law's initial ones, so that its torque is the recorded one.

    An arm that carries its weight, or that moves, has loaded the integrals of its law before
    the recording begins. The law is computed along the recorded motion, where its torque is linear
    in what they hold at the start; least squares over the first samples gives it. It is zero if it
    is not significant, or if the law does not give the recorded torque along the motion: then the
    law is wrong, or the torque is no recorded one.

    **Arguments:**

    - `own`: which states are integrals. `recordings`: the inputs of the law along each.
    """
    points = min(_POINTS, *(len(r.time) for r in recordings))
    found = np.zeros((len(recordings), len(own)))
    for k, record in enumerate(recordings):
        torque, slope = _torques(loop, record.first(points), own.nonzero()[0])
        given = record.torque[:points], np.asarray(torque), np.asarray(slope)
        found[k, own] = _significant(*given)
    return found


@compiled
def _torques(
    loop: ClosedLoop, along: Along, own: Any
) -> tuple[Float[Array, "points joints"], Float[Array, "points joints integrals"]]:
    """The law's torque along a recorded motion, N·m or N, and its derivative by the integrals."""
    law = loop.controller
    start = law.initial_state(Reading(along.signals[0, 0], along.signals[0, 1]))

    def command(signals, held, state):
        reading, reference = _inputs(signals, held)
        return law.command(reading, reference, state, loop.arm.mass_matrix(reading.q))

    def torque(held: Float[Array, " integrals"]):
        states = _states(loop, along, start.at[own].add(held))
        found = jax.vmap(command)(along.signals, along.held, states)
        return found, found

    slope, found = jax.jacfwd(torque, has_aux=True)(jnp.zeros(len(own)))
    return found, slope


def _inputs(
    signals: Float[Array, "6 joints"], held: dict[str, Float[Array, " joints"]]
) -> tuple[Reading, Reference]:
    q, v, q_ref, v_ref, a_ref, known = signals
    return Reading(q, v), Reference(q_ref, v_ref, a_ref, known, held)


def _states(
    loop: ClosedLoop, along: Along, start: Float[Array, " states"]
) -> Float[Array, "points states"]:
    """The law's states at the grid points; of a sampled law after the tick."""
    law = loop.controller
    if law.period is not None:

        def tick(state, now):
            ticked = law.tick(*_inputs(now.signals, now.held), state)
            state = jnp.where(now.tick, ticked, state)
            return state, state

        return jax.lax.scan(tick, start, along)[1]

    # Between two samples the inputs are those in the middle: exact to second order for integrals.
    # One solve over all points would take three times as long to compile.
    def step(state, ends):
        first, last = ends
        middle = jax.tree.map(lambda x, y: (x + y) / 2, *((e.signals, e.held) for e in ends))
        term = diffrax.ODETerm(lambda t, y, _: law.derivative(*_inputs(*middle), y))
        after, *_ = diffrax.Euler().step(term, first.time, last.time, state, None, None, False)
        return after, state

    ends = [jax.tree.map(lambda leaf, k=k: leaf[k], along) for k in (slice(-1), slice(1, None))]
    last, states = jax.lax.scan(step, start, tuple(ends))
    return jnp.concatenate([states, last[None]])


def _significant(
    tau: Float[np.ndarray, "points joints"],
    torque: Float[np.ndarray, "points joints"],
    slope: Float[np.ndarray, "points joints integrals"],
) -> Float[np.ndarray, " integrals"]:
    """Least-squares integrals; zero where they are not significant, or the law is another one.

    Deviations follow from the sums over blocks of samples, since what is left is no white noise.

    **Arguments:**

    - `tau`: recorded torque, NaN between samples. `torque`: the law's. `slope`: its derivative.
    """
    there = np.isfinite(tau) & np.isfinite(torque) & np.isfinite(slope).all(axis=2)
    left = np.where(there, tau - torque, 0.0)
    slope = np.where(there[..., None], slope, 0.0)
    inverse = np.linalg.pinv(np.einsum("kji,kjl->il", slope, slope), hermitian=True)
    held = inverse @ np.einsum("kji,kj->i", slope, left)

    def sums(torque: Float[np.ndarray, "points joints"]) -> Float[np.ndarray, "integrals blocks"]:
        along = np.einsum("kji,kj->ik", slope, torque)
        return np.stack([b.sum(axis=1) for b in np.array_split(along, _BLOCKS, axis=1)], axis=1)

    rest = sums(left - slope @ held)
    recorded = sums(np.where(there, tau, 0.0))
    deviation = np.sqrt(np.diag(inverse @ (rest @ rest.T) @ inverse))
    sure = np.abs(held) > _SURE * deviation
    same = np.linalg.norm(rest, axis=1) < _OTHER * np.linalg.norm(recorded, axis=1)
    return np.where(sure & same, held, 0.0)
