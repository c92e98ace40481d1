"""Number of steps that a loop needs between two samples."""

import dataclasses
import math
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..compiling import compiled
from ..control import Reading, Reference
from ..effects import NOBODY, Coulomb
from ..errors import JaxidWarning, ModelError
from ..recording import Recordings
from .batch import held_at, held_names
from .checks import check_joints
from .dynamics import Outside, imposed, instant
from .loop import ClosedLoop
from .state import rest, unflatten
from .stepping import RK4

# Steps between two samples above which a simulation is reported as slow, and is refused.
MANY, TOO_MANY = 64, 10_000


# Largest step, in time constants at standstill: one that is accurate before anything is known of
# the run, and half of what is stable, for a run whose accuracy is known.
ACCURATE, HALF_STABLE = 0.25, 1.25


def with_substeps(
    loop: ClosedLoop, recordings: Recordings, longest_step: float = ACCURATE
) -> ClosedLoop:
    """The loop with the number of steps between samples chosen, if the user did not set it.

    A step is at most 2.5 ms, and at most a quarter of the fastest time constant at standstill,
    where friction is steepest. It is short enough for a bristle to be stable at speed. Time
    constants do not limit implicit solvers. If an added effect with its own states needs more
    steps, a number chosen before is raised. A step-size controller needs no number.

    **Arguments:**

    - `longest_step`: largest step in fastest time constants at standstill.

    **Raises:** `ModelError` if more than 10 000 steps are needed; warns with `JaxidWarning` if more
    than 64 are needed.
    """
    check_joints(loop, recordings[0])
    before, settled = loop.stepping.substeps, loop.stepping.settled
    if loop.stepping.control is not None or (
        before is not None and not (settled and _has_states(loop))
    ):
        return loop
    period = loop.controller.period
    longest = max(r.period for r in recordings)
    interval = longest if period is None else min(longest, period)
    if imposed(loop) or isinstance(loop.stepping.solver, diffrax.AbstractImplicitSolver):
        still, moving = 0.0, 0.0
    else:
        still, moving = _rates(loop, recordings)
    if before is None:
        # For a stiff assumed law the relative error of the torque is about (pace · step)⁴ / 20.
        pace = 7 * loop.controller.pace
        rate = max(1 / 2.5e-3, still / longest_step, moving / 2, pace)
    else:
        rate = max(before / interval, still / 2, moving / 2)
    return set_substeps(loop, steps_at(rate, interval, loop.name), settled=True)


def needed_substeps(
    loop: ClosedLoop, recordings: Recordings, longest_step: float = ACCURATE
) -> float:
    """Steps between two samples that a loop needs; infinite if they are too many. No warnings.

    **Arguments:**

    - `longest_step`: as for `with_substeps`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", JaxidWarning)
        try:
            return with_substeps(loop, recordings, longest_step).stepping.substeps or 1
        except ModelError:
            return math.inf


def steps_at(rate: float, interval: float, name: str) -> int:
    """Number of steps at a rate, 1/s, that fill an interval, s.

    **Arguments:**

    - `name`: of the loop.

    **Raises:** `ModelError` if there are too many; warns with `JaxidWarning` if there are many.
    """
    steps = max(math.ceil(interval * rate - 1e-9), 1)
    said = (
        f"{name} needs steps of at most {1 / rate:.2g} s, which are {steps} between two samples "
        f"{interval:.3g} s apart"
    )
    if steps > TOO_MANY:
        raise ModelError(
            f"{said}, more than {TOO_MANY}: look for a parameter that makes it stiff, or choose "
            "an implicit solver, jaxid.Stepping(solver=diffrax.Kvaerno5(), control=...)"
        )
    if steps > MANY:
        remedy = "a parameter may make it too stiff, and an implicit solver needs fewer"
        _say(f"{said}: {remedy} (jaxid.Stepping(solver=diffrax.Kvaerno5(), control=...))")
    return steps


def refined(steps: float, name: str) -> int:
    """Number of steps that the error of a coarser run requires; warns if there are many.

    **Arguments:**

    - `steps`: required between two samples; limited to 10 000.
    - `name`: of the loop.
    """
    taken = math.ceil(min(steps, TOO_MANY))
    if taken > MANY:
        error = "" if steps <= TOO_MANY else f", but its error would require {steps:.3g}"
        _say(
            f"{name} is integrated with {taken} steps between two samples{error}: a solver of "
            "higher order or with a controller needs fewer (jaxid.Stepping)"
        )
    return taken


def _say(what: str) -> None:
    warnings.warn(what, JaxidWarning, stacklevel=2)


def set_substeps(loop: ClosedLoop, substeps: int | None, settled: bool = False) -> ClosedLoop:
    """The loop with that many steps between two grid points.

    **Arguments:**

    - `settled`: whether jaxid has chosen the number.
    """
    stepping = dataclasses.replace(loop.stepping, substeps=substeps, settled=settled)
    return dataclasses.replace(loop, stepping=stepping)


def _has_states(loop: ClosedLoop) -> bool:
    return any(effect.initial_state().size for effect in loop.effects)


def with_rolled_stages(loop: ClosedLoop) -> ClosedLoop:
    """The loop with the stages of its steps in a loop: for derivatives, and for many settings.

    Unrolled stages are fastest for a single simulation. With all tangents, four unrolled stages
    exceed the registers and first cache of a core; they are half as fast and slower to compile.
    """
    solver = loop.stepping.solver
    if not isinstance(solver, RK4):
        return loop
    rolled = dataclasses.replace(solver, rolled=True)
    stepping = dataclasses.replace(loop.stepping, solver=rolled)
    return dataclasses.replace(loop, stepping=stepping)


# Number of joints above which unrolled derivatives have too many scalars.
UNROLLED = 3


def with_batches(loop: ClosedLoop) -> ClosedLoop:
    """The loop for derivatives of many intervals in one batch, if it has many joints.

    The equations of a few joints are unrolled, and their tangents integrated with the state. Those
    of many joints are not one kernel but hundreds, each called for every step. With 16 intervals in
    a batch, a Jacobian of six joints takes a twelfth of the time. Needs fixed steps of RK4.
    """
    stepping = loop.stepping
    if loop.joints <= UNROLLED or not stepping.plain or imposed(loop):
        return loop
    solver = RK4(rolled=True, batched=True)
    return dataclasses.replace(loop, stepping=dataclasses.replace(stepping, solver=solver))


def with_forward_mode(loop: ClosedLoop) -> ClosedLoop:
    """The loop with an adjoint for forward mode, if its own supports reverse mode only."""
    if isinstance(loop.stepping.adjoint, diffrax.ForwardMode | diffrax.DirectAdjoint):
        return loop
    stepping = dataclasses.replace(loop.stepping, adjoint=diffrax.ForwardMode())
    return dataclasses.replace(loop, stepping=stepping)


def with_reverse_mode(loop: ClosedLoop, points: int) -> ClosedLoop:
    """The loop with an adjoint that allows reverse-mode derivatives of its sensitivities.

    **Arguments:**

    - `points`: number of grid points; as many states are stored, so none is computed twice.
    """
    if loop.stepping.plain:
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=points)
    else:
        adjoint = diffrax.DirectAdjoint()
    stepping = dataclasses.replace(loop.stepping, adjoint=adjoint)
    return dataclasses.replace(loop, stepping=stepping)


def fastest_rate(loop: ClosedLoop, recordings: Recordings) -> float:
    """Largest eigenvalue of the loop's equations at standstill along the recordings, 1/s."""
    return _rates(loop, recordings)[0]


# Step times fastest rate at which explicit methods are still stable; 2.78 for RK4.
_STABLE = 2.5
# By how much smoothings are reduced at a time, and how often at most.
_SHARPER, _TIMES = 1.5, 30
# Smallest dry friction for which steps have to be stable, as a share of the torque.
_FRICTION = 0.1


def sharpest(loop: ClosedLoop, recordings: Recordings) -> float:
    """Factor down to which the loop's estimated smoothings of a sign may be reduced.

    With sharper signs, the loop's fixed steps would not be stable at standstill. Zero if there is
    no such limit.

    **Arguments:**

    - `loop`: with its number of steps set.
    """
    signs = [p for p in loop.free_parameters if p.place[-1] == "smoothing"]
    stepping = loop.stepping
    implicit = isinstance(stepping.solver, diffrax.AbstractImplicitSolver)
    if not signs or imposed(loop) or implicit or stepping.control is not None:
        return 0.0
    period = loop.controller.period
    longest = max(r.period for r in recordings)
    step = (longest if period is None else min(longest, period)) / (stepping.substeps or 1)
    factor, levels = 1.0, _levels(loop, recordings)
    for _ in range(_TIMES):
        sharper = factor / _SHARPER
        values = levels | {p.name: sharper * float(p.where(loop)) for p in signs}
        if fastest_rate(loop.with_values(**values), recordings) * step > _STABLE:
            break
        factor = sharper
    return factor


def _levels(loop: ClosedLoop, recordings: Recordings) -> dict[str, float]:
    """Estimated levels of dry friction, by name, each at least a share of its joint's torque.

    A level of zero, from which an estimate may start, would allow any smoothing.
    """
    tau = np.concatenate([r.tau for r in recordings])
    least = _FRICTION * np.sqrt(np.mean(tau**2, axis=0))
    return {
        p.name: max(float(p.where(loop)), float(least[effect.joint - 1]))
        for k, effect in enumerate(loop.effects)
        if isinstance(effect, Coulomb)
        for p in loop.free_parameters
        if p.place == ("effects", k, "level")
    }


def _rates(loop: ClosedLoop, recordings: Recordings) -> tuple[float, float]:
    """Largest eigenvalues at standstill, and at the highest speed over ten samples, 1/s."""
    few = [np.arange(0, r.samples, max(1, r.samples // 8)) for r in recordings]
    still = np.concatenate([r.q[rows] for r, rows in zip(recordings, few, strict=True)])
    names, q, v = held_names(recordings), [], []
    told = [held_at(r, r.time[rows], names) for r, rows in zip(recordings, few, strict=True)]
    for r in recordings:
        span = min(10, r.samples - 1)
        speed = (r.q[span:] - r.q[:-span]) / (r.time[span:] - r.time[:-span])[:, None]
        fastest = np.abs(speed).argmax(axis=0)
        q.append(r.q[fastest])
        v.append(speed[fastest])
        told.append(held_at(r, r.time[fastest], names))
    speed = np.concatenate([np.zeros_like(still), *v])
    held = {name: np.concatenate([row[name] for row in told]) for name in names}
    at = jax.device_put((np.concatenate([still, *q]), speed, held))
    slopes = np.asarray(_slopes(loop, *at))
    return _largest(slopes[: len(still)]), _largest(slopes[len(still) :])


@compiled
def _slopes(
    loop: ClosedLoop,
    q: Float[Array, "points joints"],
    v: Float[Array, "points joints"],
    held: dict[str, Float[Array, "points joints"]],
) -> Float[Array, "points n n"]:
    zeros = jnp.zeros(loop.joints)

    def rate(x, at, speed, held):
        reference = Reference(at, speed, zeros, zeros, held)
        state = unflatten(loop)(x)
        outside = Outside(zeros, zeros, Reading(zeros, zeros), zeros)
        now = instant(loop, jnp.zeros(()), state, reference, outside, jnp.asarray(NOBODY))
        return ravel_pytree(now.derivative)[0]

    def slope(at, speed, held):
        return jax.jacfwd(rate)(ravel_pytree(rest(loop, at, speed))[0], at, speed, held)

    return jax.vmap(slope)(q, v, held)


def _largest(slopes: Float[np.ndarray, "points n n"]) -> float:
    """Largest magnitude of an eigenvalue; zero if no slope is finite."""
    usable = slopes[np.isfinite(slopes).all(axis=(1, 2))]
    return float(np.abs(np.linalg.eigvals(usable)).max()) if len(usable) else 0.0
