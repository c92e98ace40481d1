"""Hypotheses: effects and settings that may be missing."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects import (
    AbstractEffect,
    Curve,
    Motion,
    PeriodicDisturbance,
    RotorInertia,
    Scene,
    check_declared,
)
from ..effects import catalogue as known
from ..effects.curve import curve_over
from ..errors import FitError, ModelError
from ..parameters import Parameter, list_parameters, write_values
from ..recording import Recordings
from ..simulation.inertia import mass_matrices
from ..simulation.loop import ClosedLoop
from .signs import shapes_of_signs

# Share of a joint's highest speed above which it moves.
_MOVES = 0.05


class Hypothesis(eqx.Module):
    """One effect at one setting, with its columns in the table of signatures.

    `lower` and `upper` bound the amplitudes; `tests` is the number of settings from which the data
    selected this one.
    """

    effect: AbstractEffect
    columns: tuple[int, ...] = eqx.field(static=True)
    lower: tuple[float, ...] = eqx.field(static=True)
    upper: tuple[float, ...] = eqx.field(static=True)
    tests: float = eqx.field(static=True, default=1.0)

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.effect_name()

    @property
    def joint(self) -> int | None:
        """Its joint, counted from 1; None for effects of the whole arm."""
        return getattr(self.effect, "joint", None)


def amplitudes(effect: AbstractEffect) -> tuple[Parameter, ...]:
    """The parameters in which the effect is linear; none if it is screened by simulations."""
    if effect.finite:
        return ()
    return tuple(p for p in free_of(effect) if p.declaration.linear)


# A setting that is screened by simulations is changed by a factor between these: its signature is
# that of one size, and says little of a much smaller or larger one.
_FACTORS = 0.05, 20.0


def sized(effect: AbstractEffect, amplitude: Float[np.ndarray, " columns"]) -> AbstractEffect:
    """The effect with the amplitudes of its signatures, or scaled if its setting is simulated."""
    linear = amplitudes(effect)
    if not linear:
        return effect.scaled(float(np.clip(amplitude[0], *_FACTORS)))
    return write_values(effect, linear, amplitude)


def amplitude_names(loop: ClosedLoop, effect: AbstractEffect) -> list[tuple[str, str]]:
    """Name and unit of each amplitude; none if the effect is screened by simulations."""
    return [x for p in amplitudes(effect) for x in zip(p.names, loop.units(p), strict=True)]


def free_of(effect: AbstractEffect) -> tuple[Parameter, ...]:
    """The parameters of an effect that a fit estimates unless told otherwise."""
    return tuple(p for p in list_parameters(effect) if p.declaration.free)


def effect_on(name: str, joint: int | None) -> str:
    """An effect's name and its joint, if it has one, in words."""
    return name + ("" if joint is None else f" on joint {joint}")


def on_recordings(effect: AbstractEffect) -> str:
    """The recordings that have an effect, as part of a sentence; empty if all have it."""
    named = getattr(effect, "recordings", ())
    return f" in {' and '.join(named)}" if named else ""


def survey(
    loop: ClosedLoop,
    recordings: Recordings,
    motion: Motion,
    tones: Sequence[Sequence[float]],
) -> Scene:
    """Properties of the recordings and the nominal motion that screening uses.

    **Raises:** `FitError` if the arm has no inertia.
    """
    q = np.asarray(motion.q).reshape(-1, loop.joints)
    low, high = q.min(axis=0), q.max(axis=0)
    speed = np.abs(np.asarray(motion.v)).reshape(-1, loop.joints).max(axis=0)
    return Scene(
        low,
        # A joint at rest gets a small travel, because shapes are shares of it.
        np.maximum(high, low + 1e-6),
        np.maximum(speed, 1e-6),
        np.abs(np.asarray(motion.tau)).reshape(-1, loop.joints).max(axis=0),
        _inertia(loop, q),
        *shapes_of_signs(loop),
        float(np.median([r.period for r in recordings])),
        float(max(r.duration for r in recordings)),
        tuple(recordings.names),
        tuple(tuple(float(f) for f in row) for row in tones),
        tuple(float(x) for x in loop.arm.link_lengths()),
        float(loop.arm.gravity()),
        tuple(loop.arm.prismatic()),
        tuple(loop.arm.first_moments()),
        loop.arm.planar(),
        tuple(loop.arm.couplings()),
        loop.arm.in_space(),
        not any(p.place[0] == "arm" for p in loop.free_parameters),
        _returned(motion, speed),
    )


def _returned(motion: Motion, speed: Float[np.ndarray, " joints"]) -> tuple[float, ...]:
    """Time by which each joint has moved in both directions in some recording, s; zero if never."""
    v, t = np.asarray(motion.v), np.asarray(motion.t)
    v, t = v.reshape(-1, *v.shape[-2:]), t.reshape(-1, t.shape[-1])
    # First times of each recording in each direction.
    first = [
        np.where(s * v > _MOVES * speed, (t - t[:, :1])[..., None], np.inf).min(axis=1)
        for s in (1, -1)
    ]
    both = np.maximum(*first).min(axis=0)
    return tuple(np.where(np.isfinite(both), both, 0.0).tolist())


def _inertia(loop: ClosedLoop, q: Float[np.ndarray, "positions joints"]) -> Float[np.ndarray, "_"]:
    """Inertia of each joint while the others are free to move, averaged over positions."""
    mass = mass_matrices(loop.arm, q)
    rotors = np.zeros(loop.joints)
    for effect in loop.effects:
        if isinstance(effect, RotorInertia):
            rotors[effect.joint - 1] += float(effect.inertia)
    # A wrist with drawn bodies and no rotor may have almost no inertia.
    least = 1e-6 * np.trace(mass, axis1=1, axis2=2)[:, None, None]
    mass = mass + (rotors + least) * np.eye(loop.joints)
    try:
        freed = np.linalg.inv(mass)
    except np.linalg.LinAlgError as error:
        raise FitError(
            f"the fitted {loop.name} has no inertia: check that tau is the recorded torque, and "
            "its unit"
        ) from error
    return 1 / np.mean(np.diagonal(freed, axis1=1, axis2=2), axis=0)


def curves(scene: Scene, motion: Motion, knots: int = 12) -> list[Curve]:
    """A curve over every coordinate, plain and with the sign of velocity, on every joint."""
    over: list[tuple[Any, int, np.ndarray]] = [("t", 1, np.asarray(motion.t).ravel())]
    for name in ("q", "v", "a", "tau"):
        values = np.asarray(getattr(motion, name)).reshape(-1, len(scene.q_low))
        over += [(name, j, values[:, j - 1]) for j in scene.joints]
    made = []
    for coordinate, of, values in over:
        low, high = curve_over(values)
        for joint in scene.joints:
            for signed in (False, True):
                made.append(
                    Curve(
                        joint=joint,
                        coordinate=coordinate,
                        of=of,
                        low=low,
                        high=high,
                        signed=signed,
                        coefficients=jnp.zeros(knots),
                        **scene.sign(joint),
                    )
                )
    return made


def candidates(
    catalogue: Sequence[Any], scene: Scene, trials: float
) -> list[tuple[AbstractEffect, float]]:
    """Every instance that a catalogue proposes, with the number of settings that it represents.

    **Arguments:**

    - `catalogue`: effect classes, effects, or functions from a `Scene` to effects.
    - `trials`: number of frequencies from which the tones of the scene were selected.

    **Raises:** `ModelError` for an entry that is none of these.
    """
    made: list[AbstractEffect] = []
    for entry in catalogue:
        if isinstance(entry, AbstractEffect):
            made.append(entry)
        elif isinstance(entry, type) and issubclass(entry, AbstractEffect):
            made.extend(entry.screened(scene))
        elif callable(entry):
            given: Any = entry(scene)
            made.extend([given] if isinstance(given, AbstractEffect) else list(given))
        else:
            raise ModelError(
                f"{entry!r} cannot be screened: a catalogue consists of effect classes, effects, "
                "or functions from a scene to effects"
            )
    for one in {type(e): e for e in made if type(e) not in known}.values():
        check_declared(one, len(scene.slides))
    picked = max(1, sum(len(row) for row in scene.tones))
    return [(e, trials / picked if isinstance(e, PeriodicDisturbance) else 1.0) for e in made]
