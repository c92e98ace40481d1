"""The equations of motion of a closed loop."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..arms import AbstractArm
from ..control import Reading, Reference
from ..effects import AbstractEffect, AbstractTransmission, DriveGain, Motion
from .loads import effect_loads, turns
from .loop import ClosedLoop
from .state import State, behind, read

# Number of Newton steps for friction that depends on acceleration, linearly between few kinks.
_KINKS = 3


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solves a small positive-definite system, unrolled: a call of LAPACK would be slower."""
    n = right.shape[0]
    rows = [[matrix[i, j] for j in range(n)] for i in range(n)]
    b = [right[i] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [rows[i][j] - factor * rows[k][j] for j in range(n)]
            b[i] = b[i] - factor * b[k]
    x: list[Float[Array, ""]] = [b[0]] * n
    for i in reversed(range(n)):
        rest_of_row = sum((rows[i][j] * x[j] for j in range(i + 1, n)), jnp.zeros(()))
        x[i] = (b[i] - rest_of_row) / rows[i][i]
    return jnp.stack(x)


def forward(
    loop: ClosedLoop,
    q: Float[Array, " joints"],
    v: Float[Array, " joints"],
    torque: Float[Array, " joints"],
    added: Float[Array, "joints joints"],
) -> Float[Array, " joints"]:
    """Accelerations of the links under a torque, `(joints,)`, rad/s² or m/s².

    **Arguments:**

    - `q`, `v`: position and velocity of the links. `torque`: on them, N·m or N.
    - `added`: inertia in addition to that of the links, kg·m² or kg.
    """
    if loop.stepping.batched:
        return _forward(loop.arm, q, v, torque, added)
    matrix = loop.arm.mass_matrix(q) + added
    return solve_positive(matrix, torque - loop.arm.bias(q, v))


@eqx.filter_custom_jvp
def _forward(arm: AbstractArm, q, v, torque, added):
    """`forward` of an arm, with derivatives that follow from those of inverse dynamics.

    Differentiating the inertia matrix, the bias and the solution would take several times as long
    (Carpentier, Mansard 2018).
    """
    return solve_positive(arm.mass_matrix(q) + added, torque - arm.bias(q, v))


@_forward.def_jvp
def _forward_jvp(primals, tangents):
    arm, q, v, torque, added = primals
    d_arm, d_q, d_v, d_torque, d_added = tangents
    matrix = arm.mass_matrix(q) + added
    # The inverse, because it serves many tangents.
    inverse = jax.vmap(lambda unit: solve_positive(matrix, unit))(jnp.eye(len(q)))
    a = inverse @ (torque - arm.bias(q, v))
    by_q, by_v = arm.inverse_slopes(q, v, a)
    change = jnp.zeros_like(a)
    for slope, along in ((by_q, d_q), (by_v, d_v)):
        if along is not None:
            change = change - slope @ along
    if d_torque is not None:
        change = change + d_torque
    if d_added is not None:
        change = change - d_added @ a
    if jax.tree.leaves(d_arm):
        _, by_arm = eqx.filter_jvp(lambda arm: arm.inverse(q, v, a), (arm,), (d_arm,))
        change = change - by_arm
    return a, inverse @ change


class Outside(eqx.Module):
    """External inputs of the loop at one instant; vectors are `(joints,)`.

    `push` is torque on the drives, `pull` on the links (the two are equivalent if the transmission
    is rigid and nothing depends on the load). `noise` is added to the sensor readings, and
    `noise_rate` is the rate of change of the velocity noise.
    """

    push: Float[Array, " joints"]
    pull: Float[Array, " joints"]
    noise: Reading
    noise_rate: Float[Array, " joints"]


class Instant(eqx.Module):
    """All quantities at one instant of the loop; vectors are `(joints,)`.

    `command` is the controller's output, which is recorded, `tau` the torque that the drives
    deliver, `a` the acceleration of the drives.
    """

    reading: Reading
    command: Float[Array, " joints"]
    tau: Float[Array, " joints"]
    a: Float[Array, " joints"]
    derivative: State


def _added_inertia(
    loop: ClosedLoop, motion: Motion, states: tuple[Float[Array, " _"], ...]
) -> Float[Array, "joints joints"]:
    n = loop.joints
    inertial = [(e, s) for e, s in zip(loop.effects, states, strict=True) if e.inertial]
    if not inertial:
        return jnp.zeros((n, n))

    def torque(a: Float[Array, " joints"]) -> Float[Array, " joints"]:
        at = dataclasses.replace(motion, a=a)
        pieces = [e.torque(dataclasses.replace(at, state=s)) for e, s in inertial]
        return sum(pieces[1:], pieces[0])

    return jax.jacfwd(torque)(motion.a)


def instant(
    loop: ClosedLoop,
    t: Float[Array, ""],
    state: State,
    reference: Reference,
    outside: Outside,
    label: Int[Array, ""],
) -> Instant:
    """The closed loop at one instant: readings, command, delivered torque and accelerations.

    **Arguments:**

    - `t`: time, s.
    - `state`: state of the loop.
    - `reference`: reference of the controller.
    - `outside`: external inputs.
    - `label`: index of the recording.
    """
    if imposed(loop):
        return _along_reference(loop, t, state, reference, outside, label)
    seen = reading(loop, state, outside)
    mass = loop.arm.mass_matrix(state.q)
    command = loop.controller.command(seen, reference, state.controller, mass)
    if loop.controller.imposes:
        a, none = solve_positive(mass, command), jnp.zeros(0)
        motion = Motion(t, state.q, state.v, a, jnp.zeros_like(a), none, label, reference.held)
        rigid = command + loop.arm.bias(state.q, state.v)
        command = rigid + _beside_bodies(loop, motion, state, rigid, outside)
    tau = loop.controller.acting(command, state.controller)
    still, none = jnp.zeros_like(state.q), jnp.zeros(0)
    motion = Motion(t, state.q, state.v, still, tau, none, label, reference.held)
    # An effect's own states depend on the signal at its input, so that lags in series compose.
    arriving = []
    for effect, own in zip(loop.effects, state.effects, strict=True):
        arriving.append(motion.tau)
        seen_by = dataclasses.replace(motion, state=own)
        motion = dataclasses.replace(motion, tau=effect.command(seen_by))
    a, twisting = _accelerations(loop, motion, state, outside)
    rates = []
    for k, (effect, own) in enumerate(zip(loop.effects, state.effects, strict=True)):
        if k in twisting:
            rates.append(jnp.stack([own[1], twisting[k]]))
        else:
            at = dataclasses.replace(motion, a=a, tau=arriving[k], state=own)
            rates.append(effect.derivative(at))
    law = loop.controller.derivative(seen, reference, state.controller)
    return Instant(seen, command, motion.tau, a, State(state.v, a, tuple(rates), law))


def reading(loop: ClosedLoop, state: State, outside: Outside) -> Reading:
    """What the sensors read, unless the motion is imposed."""
    seen = read(loop, state.q, state.v)
    return Reading(seen.q + outside.noise.q, seen.v + outside.noise.v)


def imposed(loop: ClosedLoop) -> bool:
    """Whether the motion is the reference itself and need not be simulated.

    The law must impose the motion. No effect may give the arm a motion of its own, and each drive
    may only multiply its command; otherwise the command does not follow from torque.
    """
    return loop.controller.imposes and not any(
        isinstance(effect, AbstractTransmission)
        or (_drives(effect) and not isinstance(effect, DriveGain))
        for effect in loop.effects
    )


def _drives(effect: AbstractEffect) -> bool:
    """Whether the effect changes a command."""
    return type(effect).command is not AbstractEffect.command


def _along_reference(
    loop: ClosedLoop,
    t: Float[Array, ""],
    state: State,
    reference: Reference,
    outside: Outside,
    label: Int[Array, ""],
) -> Instant:
    """Inverse dynamics at one instant, for the motion at which the sensors read the reference."""
    noise, seen = outside.noise, Reading(reference.q, reference.v)
    at = seen.q - noise.q, seen.v - noise.v
    rates = seen.v - noise.v, reference.a - outside.noise_rate
    (q, v), (_, a) = jax.jvp(lambda q, v: behind(loop, q, v), at, rates)
    still, none = jnp.zeros_like(q), jnp.zeros(0)
    motion = Motion(t, q, v, a, still, none, label, reference.held, imposed=True)
    rigid = loop.arm.inverse(q, v, a)
    tau = rigid + _beside_bodies(loop, motion, state, rigid, outside)
    command = _commanded(loop, motion, tau) + reference.tau
    rates, arriving = [], dataclasses.replace(motion, tau=command)
    for effect, own in zip(loop.effects, state.effects, strict=True):
        arriving = dataclasses.replace(arriving, state=own)
        rates.append(effect.derivative(arriving))
        arriving = dataclasses.replace(arriving, tau=effect.command(arriving))
    law = loop.controller.derivative(seen, reference, state.controller)
    return Instant(seen, command, tau, a, State(v, a, tuple(rates), law))


def _commanded(
    loop: ClosedLoop, motion: Motion, tau: Float[Array, " joints"]
) -> Float[Array, " joints"]:
    """The command at which the drives deliver a torque, `(joints,)`; they only multiply it."""
    drives = [effect for effect in loop.effects if _drives(effect)]
    if not drives:
        return tau

    def delivered(command: Float[Array, " joints"]) -> Float[Array, " joints"]:
        for effect in drives:
            command = effect.command(dataclasses.replace(motion, tau=command))
        return command

    # The gains of the joints are independent.
    return tau / delivered(jnp.ones_like(tau))


def _beside_bodies(
    loop: ClosedLoop,
    motion: Motion,
    state: State,
    rigid: Float[Array, " joints"],
    outside: Outside,
) -> Float[Array, " joints"]:
    """Torque that a motion needs in addition to `rigid`, minus external torque."""
    helped, grouped = outside.push + outside.pull, motion.imposed
    if any(effect.loaded for effect in loop.effects):
        # Load-dependent effects depend on the torque that the motion needs without them.
        pairs = zip(loop.effects, state.effects, strict=True)
        kept = [(e, s) for e, s in pairs if not e.loaded]
        others = loop.with_effects([e for e, _ in kept])
        drive, link = effect_loads(others, motion, tuple(s for _, s in kept), grouped=grouped)
        motion = dataclasses.replace(motion, tau=rigid - helped + drive + link)
    own, push = state.effects, outside.push
    drive, link = effect_loads(loop, motion, own, push=push, needed=True, grouped=grouped)
    return drive + link - helped


def _accelerations(
    loop: ClosedLoop, motion: Motion, state: State, outside: Outside
) -> tuple[Float[Array, " joints"], dict[int, Float[Array, ""]]]:
    """Accelerations of the drives, and of each transmission's twist, by the effect's index."""
    added = _added_inertia(loop, motion, state.effects)
    own = state.effects
    if any(effect.needs_acceleration for effect in loop.effects):
        drive, link = effect_loads(loop, motion, own, push=outside.push, curves=False)
        without = motion.tau - drive - link + outside.push + outside.pull
        motion = dataclasses.replace(motion, a=forward(loop, motion.q, motion.v, without, added))
    transmissions = [
        (k, e) for k, e in enumerate(loop.effects) if isinstance(e, AbstractTransmission)
    ]
    if transmissions:
        return _through_transmissions(loop, motion, state, transmissions, outside, added)
    if any(e.geared for e in loop.effects) and any(map(turns, loop.effects)):
        return _behind_rotors(loop, motion, own, outside, added), {}
    # Terms proportional to acceleration are already on the left-hand side.
    drive, link = effect_loads(loop, motion, own, push=outside.push, inertia=False)
    torque = motion.tau - drive - link + outside.push + outside.pull
    return forward(loop, motion.q, motion.v, torque, added), {}


def _behind_rotors(
    loop: ClosedLoop,
    motion: Motion,
    own: tuple[Float[Array, " _"], ...],
    outside: Outside,
    added: Float[Array, "joints joints"],
) -> Float[Array, " joints"]:
    """Accelerations if friction depends on the torque behind rotors, and so on acceleration.

    Newton's method. Friction is linear in a joint's acceleration between few kinks, so it acts as
    inertia of the joint.

    **Arguments:**

    - `own`: the effects' own states. `added`: inertia of the effects.
    """

    def needed(a: Float[Array, " joints"]) -> Float[Array, " joints"]:
        push = outside.push
        drive, link = effect_loads(loop, motion, own, push=push, inertia=False, spinning=a)
        return drive + link

    available, a = motion.tau + outside.push + outside.pull, motion.a
    for _ in range(_KINKS):
        torque, slope = jax.jvp(needed, (a,), (jnp.ones_like(a),))
        left = available - torque + slope * a
        a = forward(loop, motion.q, motion.v, left, added + jnp.diag(slope))
    return a


def _through_transmissions(
    loop: ClosedLoop,
    motion: Motion,
    state: State,
    transmissions: list[tuple[int, AbstractTransmission]],
    outside: Outside,
    added: Float[Array, "joints joints"],
) -> tuple[Float[Array, " joints"], dict[int, Float[Array, ""]]]:
    """Rotors on the drive's side, the other inertia on the link's side (Spong 1987)."""
    q, v = state.q, state.v
    rotors = passed = jnp.zeros_like(q)
    apart = jnp.zeros_like(q, bool)
    for k, transmission in transmissions:
        j, there = transmission.joint - 1, transmission.present()
        twist, rate = jnp.where(there, state.effects[k], 0.0)
        q, v = q.at[j].add(twist), v.at[j].add(rate)
        passed = passed.at[j].set(transmission.through(twist, rate))
        apart = apart.at[j].set(there)
        rotors = rotors.at[j].set(jnp.where(there, transmission.rotor, 0.0))
    links = dataclasses.replace(motion, q=q, v=v)
    # The acceleration of the rotors is not known here.
    none, own, push = jnp.zeros_like(q), state.effects, outside.push
    drive, held = effect_loads(loop, motion, own, links, push=push, inertia=False, spinning=none)
    available = motion.tau - drive + outside.push
    on_link = jnp.where(apart, passed, available)
    reaching = on_link - held + outside.pull
    link = forward(loop, q, v, reaching, added - jnp.diag(rotors))
    a, twisting = link, {}
    for k, transmission in transmissions:
        j, there = transmission.joint - 1, transmission.present()
        turned = (available[j] - on_link[j]) / transmission.rotor
        a = a.at[j].set(jnp.where(there, turned, link[j]))
        twisting[k] = jnp.where(there, link[j] - turned, 0.0)
    return a, twisting
