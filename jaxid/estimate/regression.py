"""Linear regression from signals: filtered motion, columns, decimation."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..effects import Motion, recording_label
from ..errors import FitError
from ..parameters import Parameter, read_values, write_values
from ..recording import Recording
from ..signals.smoothing import even_times, resampled, signal_cutoff, smooth_motion
from ..simulation.loads import inverse
from ..simulation.loop import ClosedLoop
from ..simulation.runs import Simulated


class Filtering(eqx.Module):
    """Band-pass filtering and decimation after Gautier 1997.

    **Arguments:**

    - `cutoff`: cutoff of the low-pass on position, applied forward and backward, Hz; by default the
      frequency above which the recorded motion's spectrum is noise.
    - `rate`: sample rate after decimation, Hz; by default the cutoff.
    - `order`: order of the Butterworth filter.
    - `trim`: time dropped at both ends, s; by default five samples after decimation.
    """

    cutoff: float | None = eqx.field(static=True, default=None)
    rate: float | None = eqx.field(static=True, default=None)
    order: int = eqx.field(static=True, default=4)
    trim: float | None = eqx.field(static=True, default=None)

    def on(self, recording: Recording) -> "Filtering":
        """The same with a fixed cutoff; the spectrum is then computed only once."""
        return dataclasses.replace(self, cutoff=self.settled(recording)[0])

    def settled(self, recording: Recording) -> tuple[float, int, int]:
        """Cutoff in Hz, decimation factor and samples to drop, for a recording.

        **Raises:** `FitError` for a cutoff above the Nyquist rate, or too few samples.
        """
        if min(x for x in (self.cutoff, self.rate, self.order, 1) if x is not None) <= 0:
            raise FitError(f"{self!r}: give a cutoff, a rate and an order above zero")
        cutoff = self.cutoff or signal_cutoff(recording)
        if cutoff >= recording.rate / 2:
            raise FitError(
                f"a cutoff of {cutoff:g} Hz is above half the sample rate of {recording.name} "
                f"({recording.rate:g} Hz): lower it"
            )
        factor = max(1, round(recording.rate / (self.rate or cutoff)))
        trim = 5 * factor - 1 if self.trim is None else round(self.trim * recording.rate)
        if recording.samples - 2 * trim < 4 * factor:
            raise FitError(
                f"{recording.name} has {recording.samples} samples, too few for decimation by "
                f"{factor} with {trim} samples dropped at each end: raise rate or lower trim"
            )
        return cutoff, factor, trim


def filtered(recording: Recording, filtering: Filtering) -> Simulated:
    """Position, velocity and acceleration by zero-phase filtering and central differences.

    Uneven samples are first interpolated to an even grid.
    """
    cutoff, _, _ = filtering.settled(recording)
    time = even_times(recording)
    q = smooth_motion(recording, cutoff, filtering.order)
    dt = time[1] - time[0]
    v = np.gradient(q, dt, axis=0)
    a = np.gradient(v, dt, axis=0)
    tau = resampled(recording.time, recording.tau, time)
    return Simulated(time, q, v, a, tau, tau, np.zeros((recording.samples, 0)))


def linear_parameters(loop: ClosedLoop) -> tuple[Parameter, ...]:
    """The free parameters in which torque is linear.

    **Raises:** `FitError` if there are none.
    """
    found = tuple(p for p in loop.free_parameters if p.declaration.linear)
    if not found:
        raise FitError(
            f"{loop.name} has no free parameter in which torque is linear: use OEM, or free one"
        )
    return found


def effect_states(
    loop: ClosedLoop, time: Float[Array, " samples"], motion: Motion
) -> tuple[Float[Array, "samples _"], ...]:
    """The effects' states along a given motion, by Heun's method between samples.

    `motion` has `(samples,)` before every axis.
    """

    def body(states, pair):
        now, then, h = pair
        rates, after = [], []
        for effect, x in zip(loop.effects, states, strict=True):
            start = effect.derivative(eqx.tree_at(lambda m: m.state, now, x))
            guess = x + h * start
            end = effect.derivative(eqx.tree_at(lambda m: m.state, then, guess))
            rates.append(x)
            after.append(x + h * (start + end) / 2)
        return tuple(after), tuple(rates)

    following = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), motion)
    steps = jnp.diff(time, append=time[-1:])
    start = tuple(effect.initial_state() for effect in loop.effects)
    return jax.lax.scan(body, start, (motion, following, steps))[1]


def mismatch(loop: ClosedLoop, at: Motion) -> Float[Array, "samples joints"]:
    """Inverse dynamics minus delivered torque at the samples, `(samples, joints)`."""
    states = effect_states(loop, at.t, at)

    def one(motion: Motion, own: tuple[Float[Array, " _"], ...]) -> Float[Array, " joints"]:
        delivered = motion
        for effect, state in zip(loop.effects, own, strict=True):
            seen = eqx.tree_at(lambda m: m.state, delivered, state)
            delivered = eqx.tree_at(lambda m: m.tau, delivered, effect.command(seen))
        return inverse(loop, delivered, own) - delivered.tau

    return jax.vmap(one)(at, states)


@compiled
def _columns(loop: ClosedLoop, at: Motion) -> tuple[Array, Array]:
    parameters = linear_parameters(loop)
    theta = read_values(loop, parameters)

    def torque(values: Float[Array, " parameters"]) -> Float[Array, "samples joints"]:
        return mismatch(write_values(loop, parameters, values), at)

    rest, slope = jax.linearize(torque, theta)
    columns = jax.vmap(slope, out_axes=-1)(jnp.eye(len(theta)))
    return columns, jnp.einsum("kjp,p->kj", columns, theta) - rest


def regression(
    loop: ClosedLoop, recording: Recording, motion: Simulated
) -> tuple[Float[np.ndarray, "samples joints parameters"], Float[np.ndarray, "samples joints"]]:
    """Columns and right-hand side of the inverse dynamic model, equation (4), along a motion.

    **Arguments:**

    - `loop`: arm and effects; held parameters stay at their values.
    - `recording`: the recording of the torque.
    - `motion`: filtered or simulated position, velocity and acceleration; `tau` is the torque to
      explain.
    """
    n = motion.q.shape[0]
    label = np.full(n, recording_label(recording.name))
    still, held = np.zeros((n, 0)), recording.held_at(np.asarray(motion.time))
    along = (motion.time, motion.q, motion.v, motion.a, motion.tau, still, label, held)
    shapes = jax.eval_shape(jax.vmap(Motion), *along)
    leaves = jax.tree.leaves(along)
    at = jax.device_put(jax.tree.unflatten(jax.tree.structure(shapes), leaves))
    columns, right = _columns(loop, at)
    return np.asarray(columns), np.asarray(right)


def decimator(
    recording: Recording, filtering: Filtering
) -> Callable[[Float[np.ndarray, "samples *axes"]], Float[np.ndarray, "kept *axes"]]:
    """The parallel filter of torque and all columns, with its decimation."""
    import scipy

    _, factor, trim = filtering.settled(recording)

    def apply(x: np.ndarray) -> np.ndarray:
        inner = x[trim : x.shape[0] - trim]
        return inner if factor == 1 else scipy.signal.decimate(inner, factor, axis=0)

    return apply
