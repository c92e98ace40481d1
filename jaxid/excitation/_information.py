"""Differentiable information matrices of the parameters along a reference."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..effects import NOBODY, AbstractEffect, Motion
from ..errors import check_words
from ..estimate.regression import linear_parameters, mismatch
from ..parameters import Parameter, read_values, write_values
from ..simulation.batch import Interval
from ..simulation.integration import initial
from ..simulation.loop import ClosedLoop
from ..simulation.runs import run_with_sensitivities
from ..simulation.steps import with_reverse_mode

Kind = Literal["inverse-dynamics", "closed-loop"]
Criterion = Literal["determinant", "deviation", "condition"]


def along(
    time: Float[Array, " points"],
    signals: Float[Array, "3 points joints"],
    tau: Float[Array, "points joints"],
) -> Motion:
    """Position, velocity, acceleration and commanded torque, in the form that effects need."""
    n = time.shape[0]
    q, v, a = signals
    return jax.vmap(Motion)(time, q, v, a, tau, jnp.zeros((n, 0)), jnp.full(n, NOBODY))


@compiled
def torque_along(
    loop: ClosedLoop, time: Float[Array, " points"], signals: Float[Array, "3 points joints"]
) -> Float[Array, "points joints"]:
    """Torque to command for a motion; drives that lag are assumed to follow immediately."""
    acting = [type(e).command is not AbstractEffect.command for e in loop.effects]
    lags = [on and e.initial_state().size for e, on in zip(loop.effects, acting, strict=True)]
    prompt = [e for e, late in zip(loop.effects, lags, strict=True) if not late]
    loop = loop.with_effects(prompt)

    def lacking(tau):
        return mismatch(loop, along(time, signals, tau))

    tau = jnp.zeros_like(signals[0])
    if all(type(e).command is AbstractEffect.command and not e.loaded for e in prompt):
        return lacking(tau)
    # The delivered torque and friction that grows with it are almost affine in the command, so a
    # few steps of Newton's method suffice.
    for _ in range(4):
        missing, slope = jax.jvp(lacking, (tau,), (jnp.ones_like(tau),))
        tau = tau - missing / jnp.minimum(slope, -0.1)
    return tau


def chosen_parameters(loop: ClosedLoop, kind: Kind) -> tuple[Parameter, ...]:
    """The parameters to determine; for inverse dynamics, those in which torque is linear."""
    return linear_parameters(loop) if kind == "inverse-dynamics" else loop.free_parameters


@compiled
def inverse_columns(
    loop: ClosedLoop, time: Float[Array, " points"], signals: Float[Array, "3 points joints"]
) -> Float[Array, "points joints parameters"]:
    """The inverse-dynamics regressor along a motion, and the torque that the motion needs."""
    chosen = linear_parameters(loop)
    at = along(time, signals, torque_along(loop, time, signals))

    def torque(values):
        return mismatch(write_values(loop, chosen, values), at)

    return jax.jacfwd(torque)(read_values(loop, chosen))


def intervals_of(
    loop: ClosedLoop,
    time: Float[Array | np.ndarray, " points"],
    signals: Float[Array, "3 points joints"],
) -> Interval:
    """A reference in the simulation's form: cubics that match positions and velocities."""
    q, v, _ = signals
    h = jnp.append(jnp.diff(jnp.asarray(time)), 0.0)
    safe = jnp.where(h > 0, h, 1.0)[:, None]
    move = jnp.append(jnp.diff(q, axis=0), jnp.zeros_like(q[:1]), axis=0) / safe
    then = jnp.append(v[1:], v[-1:], axis=0)
    second = (3 * move - 2 * v - then) / safe
    third = (v + then - 2 * move) / safe**2
    n, joints = q.shape
    # A sampled law is evaluated at every grid point except the last.
    ticks = jnp.arange(n) < n - 1
    return jax.vmap(Interval)(
        jnp.asarray(time),
        h,
        ticks,
        jnp.full(n, NOBODY),
        jnp.stack([q, v, second, third], axis=1),
        jnp.zeros((n, 2, joints)),
        {},
    )


@compiled
def closed_loop_columns(
    loop: ClosedLoop,
    time: Float[Array | np.ndarray, " points"],
    signals: Float[Array, "3 points joints"],
) -> tuple[Float[Array, "points 3 joints"], Float[Array, "points joints parameters"]]:
    """Torque, position and velocity of the loop that tracks a reference, at rest at the start.

    **Returns:** `(points, 3, joints)`, and the derivative of torque by the free parameters.
    """
    # The design needs the gradient of these columns.
    loop = with_reverse_mode(loop, len(time))
    intervals = intervals_of(loop, time, signals)
    q0, v0 = signals[0, 0], jnp.zeros_like(signals[0, 0])
    theta = loop.theta

    def begin(values):
        return initial(loop.with_theta(values), intervals, q0, v0)

    x0, start = begin(theta), jax.jacfwd(begin)(theta)
    found = run_with_sensitivities(loop, intervals, x0, start, (0, 1, 2))
    seen, by = found.seen, found.slopes
    return seen, by[:, 0]


def information_of(
    columns: Float[Array, "points joints parameters"], noise: Float[Array, " joints"]
) -> Float[Array, "parameters parameters"]:
    """Information matrix for white torque noise with these standard deviations, `(joints,)`."""
    scaled = columns / noise[:, None]
    return jnp.einsum("kjp,kjq->pq", scaled, scaled)


def _by_size(
    information: Float[Array, "parameters parameters"], scales: Float[Array, " parameters"]
) -> tuple[Float[Array, "parameters parameters"], Float[Array, " parameters"]]:
    """Correlations of the columns, and their norms; each parameter is in units of its scale."""
    p = information.shape[0]
    scaled = information * jnp.outer(scales, scales)
    size = jnp.sqrt(jnp.diag(scaled))
    size = jnp.where(size > 0, size, 1.0)
    # Parameters that are not identifiable have no finite deviation; a floor near rounding error
    # keeps the criterion finite.
    return scaled / jnp.outer(size, size) + 1e-13 * jnp.eye(p), size


def log_volume(
    information: Float[Array, "parameters parameters"], scales: Float[Array, " parameters"]
) -> Float[Array, ""]:
    """Half the log det of the covariance per parameter: the size of the error ellipsoid."""
    correlated, size = _by_size(information, scales)
    value = jnp.linalg.slogdet(correlated)[1] + 2 * jnp.sum(jnp.log(size))
    return -value / (2 * information.shape[0])


def log_deviation(
    information: Float[Array, "parameters parameters"], scales: Float[Array, " parameters"]
) -> Float[Array, ""]:
    """Logarithm of the geometric mean of the deviations, each in units of its scale."""
    correlated, size = _by_size(information, scales)
    variances = jnp.diag(jnp.linalg.inv(correlated))
    return jnp.mean(jnp.log(jnp.maximum(variances, 1.0)) / 2 - jnp.log(size))


def log_condition(
    information: Float[Array, "parameters parameters"], scales: Float[Array, " parameters"]
) -> Float[Array, ""]:
    """Logarithm of the condition number of the columns, each in units of its scale."""
    values = jnp.linalg.eigvalsh(information * jnp.outer(scales, scales))
    return 0.5 * jnp.log(values[-1] / jnp.maximum(values[0], 1e-13 * values[-1]))


class Settings(eqx.Module):
    """How references are scored: the kind of information, the criterion, and the noise."""

    kind: Kind = eqx.field(static=True)
    criterion: Criterion = eqx.field(static=True)
    noise: Float[np.ndarray, " joints"]
    scales: Float[np.ndarray, " parameters"]

    def __check_init__(self):
        check_words(self)

    def judge(self, information: Float[Array, "parameters parameters"]) -> Float[Array, ""]:
        """The criterion, to be minimised."""
        by = {"determinant": log_volume, "deviation": log_deviation, "condition": log_condition}
        return by[self.criterion](information, jnp.asarray(self.scales))
