"""Signatures: the change of the closed loop's output that an effect would cause."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..effects import AbstractEffect, Motion
from ..effects.placed import Placed, alike, along_effects
from ..linear_algebra import exponential
from ..parameters import Parameter, list_parameters, read_values, write_values
from ..simulation.batch import Batch
from ..simulation.loads import effect_loads
from ..simulation.loop import ClosedLoop
from ..simulation.runs import each
from ..simulation.sharing import at_once, one_by_one, taken
from .finite import differences
from .hypotheses import Hypothesis, amplitudes, free_of
from .linear import Linearised, respond

# Slopes that differ by less, relative to the largest one, share their exponential: sample times are
# often rounded.
_SAME = 1e-3


def _settled_states(effect: AbstractEffect, motion: Motion) -> Float[Array, "points states"]:
    """The effect's own states along a motion, by an exponential step for each interval.

    Friction and lags make the states stiff. The step is exact if the rate is linear in the state
    and its input is linear from sample to sample.
    """
    first = jax.tree.map(lambda leaf: leaf[0], motion)
    start = effect.settled(eqx.tree_at(lambda m: m.state, first, effect.initial_state()))
    n = start.shape[0]
    if n == 0:
        return jnp.zeros((motion.t.shape[0], 0))
    # One state has a closed form. Otherwise an exponential is computed where the slope changes.
    weights = _weights_of_one if n == 1 else _weights

    def body(carry, pair):
        (x, known), (now, then) = carry, pair
        middle = jax.tree.map(lambda a, b: 0.5 * (a + b), now, then)
        middle = dataclasses.replace(middle, label=now.label)

        def rate(state, at):
            return effect.derivative(eqx.tree_at(lambda m: m.state, at, state))

        h = then.t - now.t
        slope, begin, end = jax.jacfwd(rate)(x, middle), rate(x, now), rate(x, then)
        known = weights(h * slope, known)
        return (x + known.rate @ (h * begin) + known.change @ (h * (end - begin)), known), x

    following = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), motion)
    # No slope is known at first.
    known = _Weights(jnp.full((n, n), jnp.inf), jnp.eye(n), jnp.eye(n))
    return jax.lax.scan(body, (start, known), (motion, following))[1]


class _Weights(eqx.Module):
    """Matrices W and V with x(1) - x(0) = W r + V c, for x' = slope (x - x(0)) + r + t c."""

    slope: Float[Array, "states states"]
    rate: Float[Array, "states states"]
    change: Float[Array, "states states"]


def _weights_of_one(slope: Float[Array, "1 1"], known: _Weights) -> _Weights:
    small = jnp.abs(slope) < 1e-4
    safe = jnp.where(small, 1.0, slope)
    rate = jnp.where(small, 1 + slope / 2, jnp.expm1(safe) / safe)
    change = jnp.where(small, 0.5 + slope / 6, (rate - 1) / safe)
    return _Weights(slope, rate, change)


def _weights(slope: Float[Array, "states states"], known: _Weights) -> _Weights:
    """The known matrices, unless the slope is another one."""
    n = slope.shape[0]

    def computed() -> _Weights:
        # The integrals are blocks of the exponential of a larger matrix (Van Loan 1978).
        zero, one = jnp.zeros((n, n)), jnp.eye(n)
        blocks = [[slope, one, zero], [zero, zero, one], [zero, zero, zero]]
        found = exponential(jnp.block(blocks))
        return _Weights(slope, found[:n, n : 2 * n], found[:n, 2 * n :])

    apart = jnp.max(jnp.abs(slope - known.slope)) > _SAME * jnp.max(jnp.abs(slope))
    return jax.lax.cond(apart, computed, lambda: known)


Forces = tuple[
    Float[Array, "*points joints columns"],
    Float[Array, "*points joints columns"],
    Float[Array, "*points joints columns"],
]
AllForces = tuple[
    Float[Array, "*points joints columns"],
    Float[Array, "*points joints reading"],
    Float[Array, "*points joints reading"],
]


def _forces(effect: AbstractEffect, motion: Motion, left: Float[Array, "points joints"]) -> Forces:
    """Additions to joint torque, position reading and velocity reading, by amplitude."""
    linear = amplitudes(effect)
    along = _force_by(effect, linear, motion, left)
    if linear:
        return jax.jacfwd(along)(read_values(effect, linear))
    return jax.tree.map(lambda x: x[..., None], along(jnp.zeros(0)))


def _force_by(
    effect: AbstractEffect,
    parameters: tuple[Parameter, ...],
    motion: Motion,
    left: Float[Array, "points joints"],
) -> Callable[[Float[Array, " values"]], Any]:
    """The same as a function of some of the effect's parameters."""

    def along(values: Float[Array, " values"]):
        here = write_values(effect, parameters, values) if parameters else effect
        # Computed here, because a parameter may affect the rate of a state.
        states = _settled_states(here, motion)

        def one(at: Motion, state, rest):
            at = eqx.tree_at(lambda m: m.state, at, state)
            loaded = eqx.tree_at(lambda m: m.tau, at, rest) if effect.loaded else at
            q, v = jax.jvp(here.read, (at.q,), (at.v,))
            return here.command(at) - at.tau - here.torque(loaded), q - at.q, v - at.v

        return jax.vmap(one)(motion, states, left)

    return along


def force_and_slopes(
    placed: Placed,
    motion: Motion,
    left: Float[Array, "recordings points joints"],
    fields: tuple[str, ...] | None = None,
) -> Forces:
    """Additions by an effect along each run, and their derivatives by its free parameters.

    **Arguments:**

    - `motion`: nominal, `(recordings, points)` first. `left`: torque that remains for the links,
      N·m or N.
    - `fields`: names of the fields for derivatives; by default those of free parameters.

    **Returns:** torque on the joint, N·m or N, position reading, rad or m, and velocity reading,
    rad/s or m/s; the first column is the value, the others are derivatives.
    """
    return one_by_one(lambda one: _force_and_slopes(placed, one[0], one[1], fields), (motion, left))


@compiled
def _force_and_slopes(
    placed: Placed,
    motion: Motion,
    left: Float[Array, "recordings points joints"],
    fields: tuple[str, ...] | None,
) -> Forces:
    effect = placed.effect
    free = free_of(effect)
    if fields is not None:
        free = tuple(p for p in list_parameters(effect) if p.place[-1] in fields)
    values = read_values(effect, free) if free else jnp.zeros(0)

    def of_run(run: Motion, left) -> Forces:
        along = _force_by(effect, free, placed.motion(run), left[:, placed.own])
        both = along(values), jax.jacfwd(along)(values)
        found = jax.tree.map(lambda x, d: jnp.concatenate([x[..., None], d], -1), *both)
        return placed.back(found)

    return each(of_run, motion, left)


def torques_of(
    effects: Sequence[AbstractEffect],
    motion: Motion,
    left: Float[Array, "recordings points joints"],
) -> Float[Array, "recordings points joints effects"]:
    """Torque on the joints by effects of one structure at their values, N·m or N.

    **Arguments:** as for `force_and_slopes`.
    """
    ((stacked, _),) = alike(effects, motion.q.shape[-1])
    return one_by_one(lambda one: _torques_of(stacked, one[0], one[1]), (motion, left))


@compiled
def _torques_of(
    stacked: Placed, motion: Motion, left: Float[Array, "recordings points joints"]
) -> Float[Array, "recordings points joints effects"]:
    def of_run(run: Motion, left):
        def own(placed: Placed):
            by = _force_by(placed.effect, (), placed.motion(run), left[:, placed.own])
            return placed.back(by(jnp.zeros(0))[0])

        return jnp.moveaxis(along_effects(own, stacked), 0, -1)

    return each(of_run, motion, left)


def left_for_links(loop: ClosedLoop, motion: Motion) -> Float[Array, "recordings points joints"]:
    """Torque that remains for the links after the loop's effects on the drives, along the runs."""
    return one_by_one(lambda one: _left_for_links(loop, one), motion)


@compiled
def _left_for_links(loop: ClosedLoop, motion: Motion) -> Float[Array, "recordings points joints"]:
    def remaining(at: Motion, states: tuple[Float[Array, " _"], ...]):
        return at.tau - effect_loads(loop, at, states, grouped=True)[0]

    def along(run: Motion):
        states = tuple(_settled_states(effect, run) for effect in loop.effects)
        return jax.vmap(remaining)(run, states)

    return jax.vmap(along)(motion)


@compiled
def _all_forces(
    groups: list[Placed],
    motion: Motion,
    left: Float[Array, "recordings points joints"],
) -> AllForces:
    """Forces of all hypotheses, with one trace for each structure and a `vmap` over its settings.

    It does not depend on the loop, so it is not compiled again when the model grows. Additions to
    sensor readings are computed only for effects of sensors.
    """

    def of_run(run: Motion, left) -> AllForces:
        pushes, noises, rates = [], [], []
        for stacked in groups:

            def own(placed: Placed) -> Forces:
                moved, rest = placed.motion(run), left[:, placed.own]
                return placed.back(_forces(placed.effect, moved, rest))

            forces = along_effects(own, stacked)
            push, noise, rate = (_by_point(x.astype(jnp.float32)) for x in forces)
            pushes.append(push)
            if misreads(stacked.effect):
                noises.append(noise)
                rates.append(rate)
        none = [jnp.zeros((*left.shape, 0), jnp.float32)]
        return (
            jnp.concatenate(pushes, -1),
            jnp.concatenate(noises or none, -1),
            jnp.concatenate(rates or none, -1),
        )

    return jax.vmap(of_run)(motion, left)


def _by_point(x: Float[Array, "settings points joints columns"]) -> Float[Array, "..."]:
    """The same array as `(points, joints, settings · columns)`."""
    return jnp.moveaxis(x, 0, 2).reshape(*x.shape[1:3], -1)


def misreads(effect: AbstractEffect) -> bool:
    """Whether the effect acts on a sensor's reading."""
    return type(effect).read is not AbstractEffect.read


def _responses(
    loop: ClosedLoop,
    linear: Linearised,
    stacks: list[Placed],
    hypotheses: Sequence[Hypothesis],
) -> Float[np.ndarray, "recordings points outputs columns"]:
    """Responses to effects that are inputs of the linear system, one run after the other.

    The forces of all runs together would be several times as large as the table.
    """
    reading = _columns(hypotheses, misreads)
    behind = _columns(hypotheses, lambda e: e.on_link) if "pull" in linear.places else []
    left = left_for_links(loop, linear.motion)

    def along(k: int) -> Float[np.ndarray, "points outputs columns"]:
        alone, remaining = taken((linear, left), np.array([k]))
        push, noise, rate = _all_forces(stacks, alone.motion, remaining)
        table = np.array(respond(alone, "push", push))
        if reading:
            table[..., reading] += respond(alone, "noise", noise)
            table[..., reading] += respond(alone, "rate", rate)
        if behind:
            table[..., behind] = respond(alone, "pull", push[..., np.array(behind)])
        return table[0]

    return np.stack(at_once(along, range(len(left))))


def _columns(
    hypotheses: Sequence[Hypothesis], which: Callable[[AbstractEffect], bool]
) -> list[int]:
    return [c for h in hypotheses if which(h.effect) for c in h.columns]


def signatures(
    loop: ClosedLoop,
    batch: Batch,
    linear: Linearised,
    proposed: Sequence[tuple[AbstractEffect, float]],
    row: int,
    say: Callable[[str], None],
) -> tuple[list[Hypothesis], Float[np.ndarray, "recordings points outputs columns"]]:
    """Hypotheses and the table of their signatures, one column per amplitude.

    For effects at the joint, on the command or on the sensor, a signature is the response of the
    linear system. For transmissions and limits it is the difference between a simulation with the
    effect and the nominal one.
    """
    direct = [k for k, (effect, _) in enumerate(proposed) if not effect.finite]
    made: dict[int, Hypothesis] = {}
    blocks, at = [], 0
    groups = alike([proposed[k][0] for k in direct], loop.joints)
    if groups:
        say(f"{len(direct)} signatures by linear response")
        for _, places in groups:
            low, high = _amplitude_bounds(proposed[direct[places[0]]][0])
            for place in places:
                effect, tests = proposed[direct[place]]
                columns = tuple(range(at, at + len(low)))
                made[direct[place]] = Hypothesis(effect, columns, low, high, tests)
                at += len(low)
        stacks = [stacked for stacked, _ in groups]
        blocks.append(_responses(loop, linear, stacks, list(made.values())))
    rest = [k for k in range(len(proposed)) if k not in made]
    say(f"{len(rest)} signatures by simulation")
    nominal = linear.seen[:, :, row]
    changes = differences(loop, batch, [proposed[k][0] for k in rest], row, nominal)
    for place, change in zip(rest, changes, strict=True):
        effect, tests = proposed[place]
        with np.errstate(over="ignore"):  # a diverging loop is left out
            column = change.astype(np.float32)
        if np.isfinite(column).all():
            blocks.append(column[..., None])
            made[place] = Hypothesis(effect, (at,), *_amplitude_bounds(effect), tests)
            at += 1
    return [made[k] for k in sorted(made)], np.concatenate(blocks, axis=-1)


def _amplitude_bounds(effect: AbstractEffect) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bounds of every amplitude; for a finite setting, of its multiple, which is positive."""
    linear = amplitudes(effect)
    if not linear:
        return (0.0,), (np.inf,)
    low = tuple(p.declaration.lower for p in linear for _ in range(p.size))
    return low, tuple(p.declaration.upper for p in linear for _ in range(p.size))
