"""The closed loop: arm, effects, controller and sensors, and its equations of motion."""

import dataclasses
import html
import math
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..arms import AbstractArm
from ..control import AbstractController, Reading, Reference
from ..effects import AbstractEffect, AbstractTransmission, Motion
from ..errors import ModelError
from ..parameters import (
    Parameter,
    Vector,
    list_parameters,
    read_values,
    set_by_name,
    sliding_unit,
    write_values,
)
from .stepping import Stepping


class State(eqx.Module):
    """The loop's state: drive positions and velocities, the effects' states, the controller's."""

    q: Float[Array, " joints"]
    v: Float[Array, " joints"]
    effects: tuple[Float[Array, " _"], ...]
    controller: Float[Array, " states"]


class ClosedLoop(eqx.Module):
    """An arm with its effects under feedback control.

    **Arguments:**

    - `arm`: rigid bodies.
    - `controller`: acts on what the sensors read.
    - `effects`: friction and whatever else; the order is that of the signal through the drive.
    - `name`: how results call the robot.
    - `held`: names of parameters that fits leave at their values.
    - `freed`: names of parameters that fits estimate although they are not free by declaration.
    - `resolution`: step of the simulated encoders, `(joints,)`, rad or m; None for ideal ones.
    - `stepping`: how it is integrated.
    """

    arm: AbstractArm
    controller: AbstractController
    effects: tuple[AbstractEffect, ...] = eqx.field(default=(), converter=tuple)
    name: str = eqx.field(static=True, default="robot")
    held: frozenset[str] = eqx.field(static=True, default=frozenset(), converter=frozenset)
    freed: frozenset[str] = eqx.field(static=True, default=frozenset(), converter=frozenset)
    resolution: tuple[float, ...] | None = eqx.field(static=True, default=None)
    stepping: Stepping = Stepping()

    def __check_init__(self):
        for effect in self.effects:
            joint = getattr(effect, "joint", None)
            if joint is not None and not 1 <= joint <= self.joints:
                raise ModelError(
                    f"{effect.effect_name()} is on joint {joint}, but {self.name} has joints 1 to "
                    f"{self.joints}: joints count from 1"
                )
        joints = [e.joint for e in self.effects if isinstance(e, AbstractTransmission)]
        for joint in joints:
            if joints.count(joint) > 1:
                raise ModelError(
                    f"{self.name} has two transmissions on joint {joint}: keep the one that gives "
                    "way between its drive and its link"
                )

    @property
    def joints(self) -> int:
        """How many joints the arm has."""
        return self.arm.joints

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every parameter of the arm, the effects and the controller."""
        return list_parameters(self)

    @property
    def free_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that a fit estimates, in the order of its vectors."""
        return tuple(
            p
            for p in self.parameters
            if (p.declaration.free or p.name in self.freed) and p.name not in self.held
        )

    @property
    def names(self) -> tuple[str, ...]:
        """One name for each value that a fit estimates."""
        return tuple(name for p in self.free_parameters for name in p.names)

    def unit(self, parameter: Parameter) -> str:
        """A parameter's unit, where its joint slides in m and N."""
        unit, joint = parameter.declaration.unit, parameter.joint
        slides = joint is not None and self.arm.prismatic()[joint - 1]
        return sliding_unit(unit) if slides else unit

    @property
    def theta(self) -> Vector:
        """The values that a fit estimates, `(parameters,)`."""
        return read_values(self, self.free_parameters)

    def with_theta(self, theta: Vector) -> "ClosedLoop":
        """The same loop with other values for its free parameters, `(parameters,)`.

        **Raises:** `ModelError` where they are not as many.
        """
        parameters = self.free_parameters
        count = sum(p.size for p in parameters)
        if theta.shape != (count,):
            raise ModelError(
                f"theta has shape {theta.shape}, but {self.name} has {count} free parameters: give "
                "one value for each of loop.names, in that order"
            )
        return write_values(self, parameters, theta)

    def with_values(self, **values: float) -> "ClosedLoop":
        """The same loop with parameters set by name.

        **Raises:** `ModelError` for a name it does not have.
        """
        return set_by_name(self, **values)

    def hold(self, *names: str, **values: float) -> "ClosedLoop":
        """The same loop with parameters that fits leave alone, at given values if there are any.

        **Raises:** `ModelError` for a name it does not have.
        """
        chosen = {*names, *values}
        self._check_names(chosen)
        loop = self.with_values(**values) if values else self
        return dataclasses.replace(loop, held=loop.held | chosen, freed=loop.freed - chosen)

    def free(self, *names: str) -> "ClosedLoop":
        """The same loop with parameters that fits estimate.

        **Raises:** `ModelError` for a name it does not have.
        """
        self._check_names(names)
        return dataclasses.replace(
            self, held=self.held - frozenset(names), freed=self.freed | frozenset(names)
        )

    def _check_names(self, names: Iterable[str]) -> None:
        known = [p.name for p in self.parameters]
        for name in names:
            if name not in known:
                raise ModelError(
                    f"there is no parameter {name!r} in this model: it has {', '.join(known)}"
                )

    def add(self, *effects: AbstractEffect) -> "ClosedLoop":
        """The same loop with more effects."""
        return dataclasses.replace(self, effects=(*self.effects, *effects))

    def with_effects(self, effects: Iterable[AbstractEffect]) -> "ClosedLoop":
        """The same loop with these effects; what is held or freed stays so with its effect.

        A parameter's name may change as another of its kind comes or goes.
        """
        loop = dataclasses.replace(self, effects=tuple(effects))
        places = {id(effect): k for k, effect in enumerate(loop.effects)}
        names = {p.where.steps: p.name for p in loop.parameters}  # type: ignore[attr-defined]
        moved = {}
        for p in self.parameters:
            first, *steps = p.where.steps  # type: ignore[attr-defined]
            if first == "effects":
                steps[0] = places.get(id(self.effects[steps[0]]))
            moved[p.name] = names.get((first, *steps))
        return dataclasses.replace(
            loop,
            held=frozenset(moved.get(name) for name in self.held) - {None},
            freed=frozenset(moved.get(name) for name in self.freed) - {None},
        )

    def without(self, name: str, joint: int | None = None) -> "ClosedLoop":
        """The same loop without the effects of a name, on one joint or on all.

        **Arguments:**

        - `name`: as in tables, for instance `"coulomb"`.
        - `joint`: counted from 1; None for all.

        **Raises:** `ModelError` if there is no such effect.
        """

        def named(effect: AbstractEffect) -> bool:
            where = getattr(effect, "joint", None)
            return effect.effect_name() == name and (joint is None or where == joint)

        kept = tuple(effect for effect in self.effects if not named(effect))
        if len(kept) == len(self.effects):
            there = sorted({effect.effect_name() for effect in self.effects})
            where = "" if joint is None else f" on joint {joint}"
            raise ModelError(
                f"there is no effect {name!r}{where} to take away: the loop has {', '.join(there)}"
            )
        return self.with_effects(kept)

    def _repr_html_(self) -> str:
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in _row(self, p)) + "</tr>"
            for p in self.parameters
        )
        head = "".join(f"<th>{name}</th>" for name in ("parameter", "value", "unit", "bounds", ""))
        return (
            f"<p>{html.escape(repr(self).split(';')[0])}; {type(self.controller).__name__})</p>"
            f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        )

    def __repr__(self) -> str:
        effects = ", ".join(
            effect.effect_name() + (f"({effect.joint})" if hasattr(effect, "joint") else "")  # type: ignore[attr-defined]
            for effect in self.effects
        )
        values = ", ".join(
            f"{p.name} {float(p.where(self)):.4g}" for p in self.free_parameters if not p.several
        )
        return (
            f"ClosedLoop({self.name}: {type(self.arm).__name__} with {effects}; "
            f"{type(self.controller).__name__}; {values})"
        )


def _row(loop: ClosedLoop, p: Parameter) -> tuple[str, ...]:
    """A parameter's line in the loop's table: name, value, unit, bounds, whether fits leave it."""
    low, high = p.declaration.lower, p.declaration.upper
    bounds = [f"≥ {low:g}" if low > -math.inf else "", f"≤ {high:g}" if high < math.inf else ""]
    value = "several" if p.several else f"{float(p.where(loop)):.4g}"
    free = any(p.name == other.name for other in loop.free_parameters)
    return p.name, value, loop.unit(p), " ".join(filter(None, bounds)), "" if free else "held"


def rest(loop: ClosedLoop, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> State:
    """The state at a position and velocity, `(joints,)`, with all else at rest."""
    effects = tuple(effect.initial_state() for effect in loop.effects)
    return State(q, v, effects, loop.controller.initial_state(read(loop, q, v)))


def settle(
    loop: ClosedLoop,
    t: Float[Array, ""],
    state: State,
    reference: Reference,
    label: Int[Array, ""],
) -> State:
    """The state with the effects' own parts as the first command finds them: none ramps up."""
    seen = read(loop, state.q, state.v)
    mass = loop.arm.mass_matrix(state.q)
    tau = loop.controller.command(seen, reference, state.controller, mass)
    motion = Motion(t, state.q, state.v, jnp.zeros_like(state.q), tau, jnp.zeros(0), label)
    settled = []
    for effect in loop.effects:
        own = effect.settled(motion)
        settled.append(own)
        motion = dataclasses.replace(
            motion, tau=effect.command(dataclasses.replace(motion, state=own))
        )
    return dataclasses.replace(state, effects=tuple(settled))


def _sensor(loop: ClosedLoop, q: Float[Array, " joints"]) -> Float[Array, " joints"]:
    """What sensors without steps report, `(joints,)`."""
    for effect in loop.effects:
        q = effect.read(q)
    return q


def read(loop: ClosedLoop, q: Float[Array, " joints"], v: Float[Array, " joints"]) -> Reading:
    """What the sensors report at a position and velocity, `(joints,)`."""
    seen, rate = jax.jvp(lambda position: _sensor(loop, position), (q,), (v,))
    if loop.resolution is not None:
        step = jnp.asarray(loop.resolution)
        # Rounding has no slope; sensitivities go through as if the encoder were ideal.
        seen = seen + jax.lax.stop_gradient(step * jnp.round(seen / step) - seen)
    return Reading(seen, rate)


def behind(
    loop: ClosedLoop, q: Float[Array, " joints"], v: Float[Array, " joints"]
) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
    """Position and velocity at which the sensors report these, `(joints,)` each."""
    if all(type(effect).read is AbstractEffect.read for effect in loop.effects):
        return q, v

    def position(reading: Float[Array, " joints"]) -> Float[Array, " joints"]:
        guess = reading
        # Errors of sensors are some hundredths of what they read: each turn gains two digits.
        for _ in range(6):
            guess = guess + reading - _sensor(loop, guess)
        return guess

    return jax.jvp(position, (q,), (v,))


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solves a small positive-definite system, unrolled: LAPACK's call costs more than the sums."""
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


class Outside(eqx.Module):
    """What comes from outside the loop at one instant; vectors are `(joints,)`.

    `push` is torque on the drives, `pull` on the links (the same where nothing gives way between
    them and nothing depends on the load), `noise` is added to what the sensors read.
    """

    push: Float[Array, " joints"]
    pull: Float[Array, " joints"]
    noise: Reading


class Instant(eqx.Module):
    """Everything about one instant of the loop; vectors are `(joints,)`.

    `command` is what the controller asks for and what gets recorded, `tau` what the drives
    deliver, `a` the acceleration of the drives.
    """

    reading: Reading
    command: Float[Array, " joints"]
    tau: Float[Array, " joints"]
    a: Float[Array, " joints"]
    derivative: State


def effect_loads(
    loop: ClosedLoop,
    motion: Motion,
    states: tuple[Float[Array, " _"], ...],
    links: Motion | None = None,
    *,
    push: Float[Array, " joints"] | float = 0.0,
    curves: bool = True,
    inertia: bool = True,
) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
    """Torque that all effects together ask of the drives, and that of the links, `(joints,)` each.

    Effects of the load come last, since they are given what the others leave of the torque; what
    is proportional to acceleration, which is solved for, is not taken off it.

    **Arguments:**

    - `motion`: of the drives. `states`: the effects' own. `links`: their motion, where they part
      from the drives.
    - `push`: torque on the drives from outside, which effects of the load see.
    - `curves`: False to leave out what needs an acceleration that is not known yet.
    - `inertia`: False to leave out what is proportional to acceleration.
    """
    drive = link = ahead = jnp.zeros_like(motion.v)
    behind = motion if links is None else links
    own = [
        (effect, state)
        for effect, state in zip(loop.effects, states, strict=True)
        if curves or not effect.needs_acceleration
    ]
    for effect, state in own:
        if effect.loaded:
            continue
        seen = dataclasses.replace(behind if effect.on_link else motion, state=state)
        if effect.inertial and not inertia:
            seen = dataclasses.replace(seen, a=jnp.zeros_like(seen.a))
        torque = effect.torque(seen)
        if effect.on_link:
            link = link + torque
            continue
        drive = drive + torque
        if effect.inertial:
            torque = effect.torque(dataclasses.replace(seen, a=jnp.zeros_like(seen.a)))
        ahead = ahead + torque
    left = dataclasses.replace(motion, tau=motion.tau - ahead + push)
    for effect, state in own:
        if effect.loaded:
            drive = drive + effect.torque(dataclasses.replace(left, state=state))
    return drive, link


def inverse(
    loop: ClosedLoop, motion: Motion, states: tuple[Float[Array, " _"], ...]
) -> Float[Array, " joints"]:
    """Torque at the joints that a motion takes (the inverse dynamic model), `(joints,)`."""
    rigid = loop.arm.mass_matrix(motion.q) @ motion.a + loop.arm.bias(motion.q, motion.v)
    drive, link = effect_loads(loop, motion, states)
    return rigid + drive + link


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
    """The closed loop at one instant: what is read, commanded and delivered, and what follows.

    **Arguments:**

    - `t`: time, s.
    - `state`: of the loop.
    - `reference`: what the controller is asked for.
    - `outside`: what acts on it.
    - `label`: which recording.
    """
    seen = read(loop, state.q, state.v)
    seen = Reading(seen.q + outside.noise.q, seen.v + outside.noise.v)
    mass = loop.arm.mass_matrix(state.q)
    command = loop.controller.command(seen, reference, state.controller, mass)
    tau = loop.controller.acting(command, state.controller)
    motion = Motion(t, state.q, state.v, jnp.zeros_like(state.q), tau, jnp.zeros(0), label)
    # An effect's own states see what arrives at it, so that lags in a row compose.
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


def _accelerations(
    loop: ClosedLoop, motion: Motion, state: State, outside: Outside
) -> tuple[Float[Array, " joints"], dict[int, Float[Array, ""]]]:
    """Accelerations of the drives, and of the twist of each transmission by its place."""
    added = _added_inertia(loop, motion, state.effects)
    matrix = loop.arm.mass_matrix(state.q) + added
    bias = loop.arm.bias(state.q, state.v)
    own = state.effects
    if any(effect.needs_acceleration for effect in loop.effects):
        drive, link = effect_loads(loop, motion, own, push=outside.push, curves=False)
        without = motion.tau - drive - link + outside.push + outside.pull
        motion = dataclasses.replace(motion, a=solve_positive(matrix, without - bias))
    transmissions = [
        (k, e) for k, e in enumerate(loop.effects) if isinstance(e, AbstractTransmission)
    ]
    if transmissions:
        return _through_transmissions(loop, motion, state, transmissions, outside, added)
    # What is proportional to acceleration is on the left-hand side already.
    drive, link = effect_loads(loop, motion, own, push=outside.push, inertia=False)
    torque = motion.tau - drive - link + outside.push + outside.pull
    return solve_positive(matrix, torque - bias), {}


def _through_transmissions(
    loop: ClosedLoop,
    motion: Motion,
    state: State,
    transmissions: list[tuple[int, AbstractTransmission]],
    outside: Outside,
    added: Float[Array, "joints joints"],
) -> tuple[Float[Array, " joints"], dict[int, Float[Array, ""]]]:
    """Rotors on the drive's side, the rest of the inertia on the link's (Spong 1987)."""
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
    drive, held = effect_loads(loop, motion, state.effects, links, push=outside.push, inertia=False)
    available = motion.tau - drive + outside.push
    on_link = jnp.where(apart, passed, available)
    matrix = loop.arm.mass_matrix(q) + added - jnp.diag(rotors)
    reaching = on_link - held + outside.pull
    link = solve_positive(matrix, reaching - loop.arm.bias(q, v))
    a, twisting = link, {}
    for k, transmission in transmissions:
        j, there = transmission.joint - 1, transmission.present()
        turned = (available[j] - on_link[j]) / transmission.rotor
        a = a.at[j].set(jnp.where(there, turned, link[j]))
        twisting[k] = jnp.where(there, link[j] - turned, 0.0)
    return a, twisting


def sizes(loop: ClosedLoop) -> list[int]:
    """Lengths of the parts of a state: q, v, each effect's, the controller's."""
    zeros = jnp.zeros(loop.joints)
    parts = jax.eval_shape(lambda: rest(loop, zeros, zeros))
    return [math.prod(leaf.shape) for leaf in jax.tree.leaves(parts)]
