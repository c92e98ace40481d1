"""Limits of a reference and its motion."""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import LimitsError
from ..recording import Recording
from ..signals.smoothing import even_times, signal_cutoff, smooth_motion


def _vector(value: object) -> Float[np.ndarray, " joints"]:
    return np.atleast_1d(np.asarray(value, dtype=np.float64))


class Limits(eqx.Module):
    """Limits of a reference and its motion, one value per joint, in SI units.

    **Arguments:**

    - `low`, `high`: of position. `speed`, `acceleration`, `torque`: magnitudes.
    - `workspace`: a function of a position, `(joints,)`, whose values must all be positive; for
      instance a `PlanarReach`. None for no such limit.

    **Raises:** `LimitsError` if they contradict each other.
    """

    low: Float[np.ndarray, " joints"] = eqx.field(converter=_vector)
    high: Float[np.ndarray, " joints"] = eqx.field(converter=_vector)
    speed: Float[np.ndarray, " joints"] = eqx.field(converter=_vector)
    acceleration: Float[np.ndarray, " joints"] = eqx.field(converter=_vector)
    torque: Float[np.ndarray, " joints"] = eqx.field(converter=_vector)
    workspace: Callable[[Float[Array, " joints"]], Float[Array, " values"]] | None = None

    def __check_init__(self):
        joints = len(self.low)
        for name in ("high", "speed", "acceleration", "torque"):
            value = getattr(self, name)
            if len(value) != joints:
                raise LimitsError(
                    f"limits.{name} has {len(value)} values, but limits.low has {joints}: give one "
                    "per joint"
                )
            for j, x in enumerate(value, start=1):
                if name != "high" and not x > 0:
                    raise LimitsError(f"limits.{name} of joint {j} is {x:g}: it must be positive")
        for j, (low, high) in enumerate(zip(self.low, self.high, strict=True), start=1):
            if not low < high:
                raise LimitsError(
                    f"limits.low of joint {j} is {low:g}, not below limits.high of {high:g}: "
                    "exchange or widen them"
                )

    @classmethod
    def of(cls, recordings: Iterable[Recording]) -> "Limits":
        """Limits that recordings reached: measured positions and torques, rates of the reference.

        Without a reference, rates are those of the low-passed measured positions.
        """
        rows = list(recordings)
        speed, acceleration = [], []
        for r in rows:
            time, q = r.time, r.q_ref
            if q is None:
                time, q = even_times(r), smooth_motion(r, signal_cutoff(r))
            v = np.gradient(q, time, axis=0)
            speed.append(np.abs(v).max(axis=0))
            acceleration.append(np.abs(np.gradient(v, time, axis=0)).max(axis=0))
        return cls(
            np.min([r.q.min(axis=0) for r in rows], axis=0),
            np.max([r.q.max(axis=0) for r in rows], axis=0),
            np.max(speed, axis=0),
            np.max(acceleration, axis=0),
            np.max([np.abs(r.tau).max(axis=0) for r in rows], axis=0),
        )


class PlanarReach(eqx.Module):
    """Keeps the tip of an arm whose links turn in a plane inside a box.

    x points along the stretched arm at q = 0 (down, for a hanging arm), y a quarter turn further.

    **Arguments:**

    - `lengths`: of all links, m. `low`, `high`: corners of the box, (x, y), m.
    """

    lengths: tuple[float, ...] = eqx.field(static=True)
    low: tuple[float, float] = eqx.field(static=True)
    high: tuple[float, float] = eqx.field(static=True)

    def __check_init__(self):
        for axis, low, high in zip("xy", self.low, self.high, strict=True):
            if not low < high:
                raise LimitsError(
                    f"the workspace's {axis} goes from {low:g} to {high:g} m: widen it"
                )

    def __call__(self, q: Float[Array, " joints"]) -> Float[Array, "4"]:
        """Distance of the tip from the four sides, positive inside, m."""
        angle = jnp.cumsum(q)
        lengths = jnp.asarray(self.lengths)
        x, y = jnp.sum(lengths * jnp.cos(angle)), jnp.sum(lengths * jnp.sin(angle))
        return jnp.stack([x - self.low[0], self.high[0] - x, y - self.low[1], self.high[1] - y])


# The limits of a joint, in the order of `margins_along`: magnitudes have two sides.
SIDES = ("low", "high", "speed", "speed", "acceleration", "acceleration", "torque", "torque")


def margins_along(
    limits: Limits,
    signals: Float[Array, "3 points joints"],
    tau: Float[Array, "points joints"],
) -> tuple[Float[Array, "points 8 joints"], Float[Array, "points sides"]]:
    """Margin of a motion to each limit, as a fraction of it; negative if it is violated."""
    q, v, a = signals
    span = limits.high - limits.low
    rates = [(v, limits.speed), (a, limits.acceleration), (tau, limits.torque)]
    rows = [(q - limits.low) / span, (limits.high - q) / span]
    rows += [1 + sign * x / most for x, most in rates for sign in (-1.0, 1.0)]
    inside = jnp.zeros((q.shape[0], 0))
    if limits.workspace is not None:
        inside = jax.vmap(limits.workspace)(q)
    return jnp.stack(rows, axis=1), inside
