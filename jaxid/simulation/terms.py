"""Drives in the parameters of a physics simulator: MuJoCo and those with the same parameters."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..control import PD, PID, AbstractController, Impedance, Reading, Reference, Sampled, Servo
from ..effects import (
    NOBODY,
    AbstractEffect,
    AbstractTransmission,
    Coulomb,
    DCMotor,
    DriveGain,
    GearFriction,
    LoadDependentFriction,
    Motion,
    RotorInertia,
    Stribeck,
    TimeDelay,
    TorqueSaturation,
    Viscous,
)
from .loop import ClosedLoop

SAID = (Viscous, Coulomb, RotorInertia, DCMotor, DriveGain, TimeDelay, TorqueSaturation)
LAWS = (PD, PID, Servo, Impedance)
# A position error at which every drive with a limit reaches it, rad or m.
_FAR = 1e6


class JointTerms(eqx.Module):
    """One joint's drive in a simulator's parameters, in SI units on the joint's side of the gear.

    The actuator's torque is kp (q_ref - q) - kd v within ±`forcerange`, delayed by `delay`. The
    joint has `armature`, `damping`, which includes the braking of a motor by its back-EMF, and
    `frictionloss`. `kp` and `kd` are None for a law of another form.
    """

    armature: float
    damping: float
    frictionloss: float
    kp: float | None
    kd: float | None
    forcerange: float
    delay: float


def joint_terms(
    loop: ClosedLoop, told: dict[str, Float[np.ndarray, " joints"]] | None = None
) -> tuple[JointTerms, ...]:
    """The drives of a loop in a simulator's parameters, as far as possible; one for each joint.

    **Arguments:**

    - `told`: properties of the drives in a recording (`kp`, `kd`, `supply`), by name, `(joints,)`.
    """
    law, late = loop.controller, np.zeros(loop.joints)
    limit = np.full(loop.joints, np.inf)
    if isinstance(law, Sampled):
        late = late + law.delay * law.every
        limit = np.broadcast_to(np.asarray(law.limit), limit.shape)
        law = law.law
    gains = _gains(loop, law, limit, told or {}) if isinstance(law, LAWS) else None
    braking = -np.diagonal(_delivered_slopes(loop))
    found = []
    for j in range(loop.joints):
        own = [e for e in loop.effects if getattr(e, "joint", None) == j + 1]
        delay = sum(float(e.delay) for e in own if isinstance(e, TimeDelay))
        found.append(
            JointTerms(
                armature=sum(float(e.inertia) for e in own if isinstance(e, RotorInertia)),
                damping=sum(float(e.coefficient) for e in own if isinstance(e, Viscous))
                + float(braking[j]),
                frictionloss=sum(float(e.level) for e in own if isinstance(e, Coulomb)),
                kp=None if gains is None else float(gains[0][j]),
                kd=None if gains is None else float(gains[1][j]),
                forcerange=math.inf if gains is None else float(gains[2][j]),
                delay=delay + float(late[j]),
            )
        )
    return tuple(found)


def unsaid(loop: ClosedLoop) -> dict[int, str]:
    """Parts of a loop that these parameters do not express, by the effect's index, -1 for others.

    Each part has its reason, as part of a sentence. Index -1 is for parts of the law and a motor's
    current limit, which cannot be left out like an effect.
    """
    found: dict[int, str] = {}
    rest: list[str] = []
    law = loop.controller.law if isinstance(loop.controller, Sampled) else loop.controller
    if not isinstance(law, LAWS):
        rest.append(f"the law {type(law).__name__} cannot be expressed by kp and kd")
    elif isinstance(law, PID) and np.any(np.asarray(law.Ki) != 0):
        rest.append("an integral cannot be expressed by kp and kd")
    elif isinstance(law, Servo) and np.any(np.asarray(law.deadband) != 0):
        rest.append("a deadband cannot be expressed by kp and kd")
    for k, effect in enumerate(loop.effects):
        if isinstance(effect, DCMotor) and math.isfinite(float(effect.limit)):
            rest.append("forcerange limits the command only, a current limit also limits braking")
        elif not isinstance(effect, SAID):
            found[k] = _reason(effect)
    return found | ({-1: "; ".join(rest)} if rest else {})


def _reason(effect: AbstractEffect) -> str:
    if isinstance(effect, Stribeck):
        return "frictionloss does not fall with speed"
    if isinstance(effect, GearFriction | LoadDependentFriction):
        return "frictionloss does not grow with the load"
    if isinstance(effect, AbstractTransmission):
        return "drive and link are one rigid joint"
    if effect.on_link:
        return "it acts on the link, not on its drive: add it to the bodies"
    return "the simulator has no such term"


def _delivered(
    loop: ClosedLoop,
    command: Float[Array, " joints"],
    v: Float[Array, " joints"],
) -> Float[Array, " joints"]:
    """Torque at a command and a speed of the drives that can be expressed, `(joints,)`."""
    still = jnp.zeros_like(v)
    for effect in loop.effects:
        if isinstance(effect, DCMotor | DriveGain | TorqueSaturation):
            label, zero = jnp.asarray(NOBODY), jnp.zeros(())
            motion = Motion(zero, still, v, still, command, effect.initial_state(), label)
            command = effect.command(motion)
    return command


def _delivered_slopes(loop: ClosedLoop) -> Float[np.ndarray, "joints joints"]:
    """Decrease of the drives' torque with speed at zero command."""
    still = jnp.zeros(loop.joints)
    return np.asarray(jax.jacfwd(lambda v: _delivered(loop, still, v))(still))


def _gains(
    loop: ClosedLoop,
    law: AbstractController,
    limit: Float[np.ndarray, " joints"],
    told: dict[str, Float[np.ndarray, " joints"]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """kp, kd and the limit of the torque, `(joints,)` each."""
    still = jnp.zeros(loop.joints)
    held = {name: jnp.asarray(x) for name, x in told.items() if name != "on"}

    def torque(error: Float[Array, " joints"], v: Float[Array, " joints"]):
        reading = Reading(-error, v)
        state = jnp.zeros_like(law.initial_state(reading))
        reference = Reference(still, still, still, still, held)
        mass = jnp.eye(loop.joints)
        command = jnp.clip(law.command(reading, reference, state, mass), -limit, limit)
        return _delivered(loop, command, still)

    # Slightly beyond the deadband, inside which all slopes are zero.
    near = still + 1e-9 + (law.deadband if isinstance(law, Servo) else 0.0)
    by_error, by_speed = jax.jacfwd(torque, argnums=(0, 1))(near, still)
    most = np.asarray(torque(still + _FAR, still))
    # Zero minus zero, because minus zero would be printed as -0.
    kp, kd = np.diagonal(np.asarray(by_error)), 0.0 - np.diagonal(np.asarray(by_speed))
    return kp, kd, np.where(most > 0.5 * _FAR * np.maximum(kp, 1e-30), np.inf, most)
