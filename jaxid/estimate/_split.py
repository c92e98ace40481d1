"""Regressions on position and velocity: split equations, filter, estimate."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..effects import AbstractTransmission, Motion, recording_label
from ..errors import FitError
from ..parameters import Bounds, list_parameters, read_values, write_values
from ..recording import Recording, Recordings
from ..signals.smoothing import evened
from ..simulation.loads import effect_loads
from ..simulation.loop import ClosedLoop
from ..simulation.runs import Simulated
from ._encoder import Kernels, errors_of, row_errors, solve_weighted
from ._operators import Operator
from .covariance import score_covariance
from .idim import Solved, Stacked, regression_fit, solve
from .regression import effect_states, linear_parameters, regression
from .result import AbstractMethod, Fit, determined_covariance
from .states import AbstractStates

EncoderWeights = Literal["joint", "encoder"]


class Rows(eqx.Module):
    """The regression of one recording: equations and data for their weights.

    `states`: source of the motion. `transient`: further columns of each joint's rows, or None.
    `kernels`: impulse responses from recorded positions to the rows. `at`: samples of the rows.
    """

    columns: Float[np.ndarray, "rows joints parameters"]
    right: Float[np.ndarray, "rows joints"]
    transient: Float[np.ndarray, "rows columns"] | None
    motion: Simulated
    states: AbstractStates
    kernels: Kernels = eqx.field(static=True)
    at: slice = eqx.field(static=True)


def as_motion(motion: Simulated, recording: Recording) -> Motion:
    """A motion in the form that effects need, `(samples,)` before every axis."""
    n = motion.q.shape[0]
    label = jnp.full(n, recording_label(recording.name))
    signals = (motion.time, motion.q, motion.v, motion.a, motion.tau)
    t, q, v, a, tau = (jnp.asarray(x) for x in signals)
    held = jax.device_put(recording.held_at(np.asarray(motion.time)))
    return jax.vmap(Motion)(t, q, v, a, tau, jnp.zeros((n, 0)), label, held)


def split_torque(loop: ClosedLoop, at: Motion, once: bool) -> Float[Array, "4 samples joints"]:
    """Inverse dynamics minus delivered torque, in parts that need no acceleration.

    The first part is to be differentiated twice, the second once, the third not at all; the last is
    the delivered torque, with its sign. `once` adds the rate of the first part to the second.
    """
    parameters = list_parameters(loop.arm)
    values = read_values(loop.arm, parameters)
    states = effect_states(loop, at.t, at)

    def one(motion: Motion, own: tuple[Float[Array, " _"], ...]) -> Float[Array, "4 joints"]:
        delivered = motion
        for effect, state in zip(loop.effects, own, strict=True):
            seen = eqx.tree_at(lambda m: m.state, delivered, state)
            delivered = eqx.tree_at(lambda m: m.tau, delivered, effect.command(seen))

        def second(q):
            return loop.arm.split(q, motion.v).second @ values

        split = loop.arm.split(motion.q, motion.v)
        twice, rate = jax.jvp(second, (motion.q,), (motion.v,))
        first = split.first @ values
        if once:
            twice, first = jnp.zeros_like(twice), first + rate
        drive, link = effect_loads(loop, delivered, own, grouped=True)
        zeroth = split.zeroth @ values + drive + link
        return jnp.stack([twice, first, zeroth, -delivered.tau])

    return jnp.moveaxis(jax.vmap(one)(at, states), 1, 0)


@compiled
def _columns(loop: ClosedLoop, at: Motion, once: bool) -> tuple[Array, Array]:
    parameters = linear_parameters(loop)
    theta = read_values(loop, parameters)

    def torque(values):
        return split_torque(write_values(loop, parameters, values), at, once)

    rest, slope = jax.linearize(torque, theta)
    columns = jax.vmap(slope, out_axes=-1)(jnp.eye(len(theta)))
    return columns, columns @ theta - rest


def _check_effects(loop: ClosedLoop, method: AbstractMethod) -> None:
    for effect in loop.effects:
        if effect.inertial or effect.needs_acceleration or isinstance(effect, AbstractTransmission):
            raise FitError(
                f"{effect.effect_name()} needs an acceleration, which {type(method).__name__} does "
                "not have: use IDIM or OEM, or leave the effect out"
            )


def split_rows(
    loop: ClosedLoop,
    recording: Recording,
    method: AbstractMethod,
    states: AbstractStates,
    operator: Operator,
    transient: Literal["modelled", "dropped", "ignored"],
) -> Rows:
    """The equations of one recording through an operator.

    **Arguments:**

    - `method`: named in errors.
    - `states`: source of velocities. `operator`: with one or two poles.
    - `transient`: how the operator's unknown initial state is treated.

    **Raises:** `FitError` if an effect needs an acceleration, or no rows are left.
    """
    _check_effects(loop, method)
    states = states.resolved(recording)
    once = len(operator.poles) == 1
    motion = states.motion(recording)
    columns, right = (np.asarray(x) for x in _columns(loop, as_motion(motion, recording), once))
    period = loop.controller.period
    held = period is not None and abs(period / recording.period - 1) < 1e-3
    orders = (0, 1, 0, 0) if once else (2, 1, 0, 0)
    wide = np.concatenate([columns, right[..., None]], axis=-1)
    passed = sum(
        operator(k, part, held and place == 3)
        for place, (k, part) in enumerate(zip(orders, wide, strict=True))
        if not (once and place == 0)
    )
    assert isinstance(passed, np.ndarray)
    edge, factor = states.edge(recording), operator.factor
    start = edge
    if transient == "dropped":
        start = max(edge, int(np.ceil(10 / min(operator.poles) / operator.step)))
    at = slice(start, recording.samples - edge, factor)
    picked = passed[at]
    if picked.shape[0] * picked.shape[1] <= picked.shape[2] + 2 * loop.joints:
        raise FitError(
            f"{recording.name} has {picked.shape[0]} rows after its filter, too few for "
            f"{picked.shape[2] - 1} parameters: raise the poles, or record longer"
        )

    def kernels(x: np.ndarray) -> np.ndarray:
        q, v, _ = states.rates(recording, x)
        return np.stack([operator(0, q), operator(0, v), operator(1, v)])

    extra = operator.transient(np.asarray(motion.time))[at] if transient == "modelled" else None
    there = jax.tree.map(lambda x: x[at], motion)
    return Rows(picked[..., :-1], picked[..., -1], extra, there, states, kernels, at)


def motion_rows(loop: ClosedLoop, recording: Recording, states: AbstractStates) -> Rows:
    """The equations of one recording along position, velocity and acceleration as estimated."""
    states = states.resolved(recording)
    motion = states.motion(recording)
    columns, right = regression(loop, recording, motion)
    edge = states.edge(recording)
    at = slice(edge, recording.samples - edge, 1)

    def kernels(x: np.ndarray) -> np.ndarray:
        return np.stack(states.rates(recording, x))

    there = jax.tree.map(lambda x: x[at], motion)
    return Rows(columns[at], right[at], None, there, states, kernels, at)


def _without_transient(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Columns and right-hand side, with the transient projected out of each joint."""
    if rows.transient is None:
        return rows.columns, rows.right
    basis, _ = np.linalg.qr(rows.transient)

    def rest(x: np.ndarray) -> np.ndarray:
        return x - np.tensordot(basis, np.tensordot(basis.T, x, 1), 1)

    return rest(rows.columns), rest(rows.right)


def fit_rows(
    loop: ClosedLoop,
    recordings: Recordings,
    method: AbstractMethod,
    weights: EncoderWeights,
    rows_of: Callable[[Recording], Rows],
) -> Fit:
    """Weighted least squares on the rows of all recordings.

    **Arguments:**

    - `method`: as shown by results.
    - `weights`: `"joint"`, or `"encoder"` for the covariance that follows from the resolution.
    - `rows_of`: gives the rows of a recording.

    **Raises:** `FitError` if the resolution is not known, or the rows are too few.
    """
    started = time.perf_counter()
    if weights == "encoder":
        for recording in recordings:
            if recording.resolution is None:
                raise FitError(
                    f"{recording.name} has no encoder resolution: give resolution= "
                    "when it is read, or use weights='joint'"
                )
    # Operators, differences and series need even samples.
    even = Recordings.of([evened(recording) for recording in recordings])
    rows = [rows_of(recording) for recording in even]
    chosen = linear_parameters(loop)
    names = tuple(name for p in chosen for name in p.names)
    scales = np.asarray(Bounds.of(chosen).scale)
    pairs = [_without_transient(r) for r in rows]
    stacked = Stacked(
        np.concatenate([c for c, _ in pairs]),
        np.concatenate([r for _, r in pairs]),
        scales,
        tuple(len(r) for _, r in pairs),
    )
    solved = solve(stacked, names, "joint")
    if weights == "joint":
        solved = _coloured(stacked, solved, names)
        how = "sandwich estimate for coloured residuals"
    else:
        solved = _weighted(loop, even, rows, stacked, solved, names)
        how = "covariance of the encoder's errors, Q²/12 through every operator"
    fit = regression_fit(loop, recordings, method, stacked, solved, started)
    return dataclasses.replace(fit, deviations=how)


def _coloured(stacked: Stacked, solved: Solved, names: tuple[str, ...]) -> Solved:
    """The same solution, with deviations that allow for coloured residuals."""
    spread = np.sqrt(np.mean(solved.residual**2, axis=0))
    spread = np.where(spread > 0, spread, 1.0)
    residuals = stacked.split(solved.residual / spread)
    jacobians = stacked.split(stacked.columns / spread[:, None])
    information = np.asarray(sum(np.einsum("kop,koq->pq", j, j) for j in jacobians))
    meat = score_covariance(residuals, jacobians, information)
    covariance, lost = determined_covariance(information, names, stacked.scales, meat)
    return Solved(solved.theta, covariance, solved.residual, lost)


def _weighted(
    loop: ClosedLoop,
    recordings: Recordings,
    rows: Sequence[Rows],
    stacked: Stacked,
    solved: Solved,
    names: tuple[str, ...],
) -> Solved:
    """The solution with the covariance from a previous one, iterated twice."""
    chosen = linear_parameters(loop)
    heard = [
        errors_of(recording, r.states, r.kernels, r.at, r.at.step)
        for recording, r in zip(recordings, rows, strict=True)
    ]
    for _ in range(2):
        near = write_values(loop, chosen, jnp.asarray(solved.theta))
        whitened = []
        for recording, r, errors, left in zip(
            recordings, rows, heard, stacked.split(solved.residual), strict=True
        ):
            assert recording.resolution is not None
            at = as_motion(r.motion, recording)
            whitened.append(row_errors(near, at, errors, recording.resolution, left))
        found = solve_weighted(
            [r.columns for r in rows],
            [r.right for r in rows],
            [r.transient for r in rows],
            whitened,
            names,
            stacked.scales,
        )
        residual = stacked.right - stacked.columns @ found.theta
        solved = Solved(found.theta, found.covariance, residual, found.undetermined)
    return solved
