"""Signatures: the change of the closed loop's output that an effect would cause."""

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
from ..parameters import Parameter, list_parameters, read_values, write_values
from ..simulation.batch import Batch
from ..simulation.loads import effect_loads
from ..simulation.loop import ClosedLoop
from ..simulation.own_states import settled_states
from ..simulation.runs import each
from ..simulation.sharing import at_once, one_by_one, taken
from .finite import differences
from .hypotheses import Hypothesis, amplitudes, free_of
from .linear import Linearised, at_samples, respond

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
        states = settled_states(here, motion)

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
        states = tuple(settled_states(effect, run) for effect in loop.effects)
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


# Largest number of forces, in single precision, that are computed at once for one recording. Those
# of all hypotheses along a minute at 500 Hz need 5 GB for an arm of seven joints. What is compared
# of them needs a tenth.
_ROOM = 1 << 27


def _responses(
    loop: ClosedLoop,
    batch: Batch,
    linear: Linearised,
    stacks: Sequence[tuple[Placed, int]],
    hypotheses: Sequence[Hypothesis],
) -> Float[np.ndarray, "recordings rows outputs columns"]:
    """What is compared of responses to effects that are inputs of the linear system.

    **Arguments:**

    - `stacks`: stacked effects, with the number of columns of each.
    - `hypotheses`: the same effects with their columns.
    """
    reading = np.array(_columns(hypotheses, misreads), int)
    behind = np.array(
        _columns(hypotheses, lambda e: e.on_link) if "pull" in linear.places else [], int
    )
    left = left_for_links(loop, linear.motion)
    portions = _portions(stacks, left.shape[1] * left.shape[2])

    def along(k: int) -> Float[np.ndarray, "rows outputs columns"]:
        alone, one, remaining = taken((linear, batch, left), np.array([k]))
        found, first = [], 0
        for portion in portions:
            push, noise, rate = _all_forces(portion, alone.motion, remaining)
            last = first + push.shape[-1]
            table = np.asarray(respond(alone, "push", push))
            own, linked = (c[(c >= first) & (c < last)] - first for c in (reading, behind))
            table = table.copy() if len(own) or len(linked) else table
            if len(own):
                table[..., own] += respond(alone, "noise", noise)
                table[..., own] += respond(alone, "rate", rate)
            if len(linked):
                table[..., linked] = respond(alone, "pull", push[..., linked])
            found.append(at_samples(one, table)[0])
            first = last
        return np.concatenate(found, axis=-1)

    return np.stack(at_once(along, range(len(left))))


def _portions(stacks: Sequence[tuple[Placed, int]], size: int) -> list[list[Placed]]:
    """Stacked effects, divided so that a portion has few forces; at least one effect each.

    **Arguments:**

    - `stacks`: as for `_responses`. `size`: number of forces of one column.
    """
    found: list[list[Placed]] = [[]]
    room = _ROOM // size
    for stacked, width in stacks:
        count, first = len(stacked.own), 0
        while first < count:
            fits = room // width
            if not fits and found[-1]:
                found.append([])
                room = _ROOM // size
                continue
            last = min(count, first + max(1, fits))
            found[-1].append(_some(stacked, slice(first, last)))
            room, first = room - width * (last - first), last
    return found


def _some(stacked: Placed, rows: slice) -> Placed:
    return jax.tree.map(lambda x: x[rows] if eqx.is_array_like(x) else x, stacked)


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
) -> tuple[list[Hypothesis], Float[np.ndarray, "recordings rows outputs columns"]]:
    """Hypotheses and the compared part of their signatures, one column per amplitude.

    For effects at the joint, on the command or on the sensor, a signature is the response of the
    linear system. For transmissions and limits it is the difference between a simulation with the
    effect and the nominal one.
    """
    direct = [k for k, (effect, _) in enumerate(proposed) if not effect.finite]
    made: dict[int, Hypothesis] = {}
    blocks, stacks, at = [], [], 0
    groups = alike([proposed[k][0] for k in direct], loop.joints)
    if groups:
        say(f"{len(direct)} signatures by linear response")
        for stacked, places in groups:
            low, high = _amplitude_bounds(proposed[direct[places[0]]][0])
            stacks.append((stacked, len(low)))
            for place in places:
                effect, tests = proposed[direct[place]]
                columns = tuple(range(at, at + len(low)))
                made[direct[place]] = Hypothesis(effect, columns, low, high, tests)
                at += len(low)
        blocks.append(_responses(loop, batch, linear, stacks, list(made.values())))
    rest = [k for k in range(len(proposed)) if k not in made]
    say(f"{len(rest)} signatures by simulation")
    nominal = linear.seen[:, :, row]
    changes = differences(loop, batch, [proposed[k][0] for k in rest], row, nominal)
    simulated = []
    for place, change in zip(rest, changes, strict=True):
        effect, tests = proposed[place]
        with np.errstate(over="ignore"):  # a diverging loop is left out
            column = change.astype(np.float32)
        if np.isfinite(column).all():
            simulated.append(column)
            made[place] = Hypothesis(effect, (at,), *_amplitude_bounds(effect), tests)
            at += 1
    if simulated:
        blocks.append(at_samples(batch, np.stack(simulated, axis=-1)))
    return [made[k] for k in sorted(made)], np.concatenate(blocks, axis=-1)


def _amplitude_bounds(effect: AbstractEffect) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bounds of every amplitude; for a finite setting, of its multiple, which is positive."""
    linear = amplitudes(effect)
    if not linear:
        return (0.0,), (np.inf,)
    low = tuple(p.declaration.lower for p in linear for _ in range(p.size))
    return low, tuple(p.declaration.upper for p in linear for _ in range(p.size))
