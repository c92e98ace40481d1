"""What an effect may do, and where on the signal's way it may do it."""

import dataclasses
import math
import re
import zlib
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array, Bool, Float, Int

from ..errors import ModelError
from ..parameters import Scalar, list_parameters, read_values, write_values
from ._scene import Scene

# Of no recording: effects that act on some by name do not act.
NOBODY = 0
# Added to a smoothing, rad/s or m/s: no division by zero at standstill, and at zero, its bound, the
# derivative by it still says in which direction it does better.
_SHARP = 1e-30
# Where a hyperbolic tangent is a half.
_HALF = math.atanh(0.5)


def recording_label(name: str) -> int:
    """The number by which effects know a recording of that name (`Motion.label`)."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


class Motion(eqx.Module):
    """What an effect sees of the arm at one instant; every vector is `(joints,)`.

    `t` in s; `q`, `v`, `a` in rad or m and their derivatives; `tau` what the drives deliver, N·m
    or N. `a` is zero where an effect neither is `inertial` nor `needs_acceleration`. For an effect
    that is `loaded`, `tau` is what the other effects on the drives leave for the links. `state` is
    the effect's own. `label` tells recordings apart (`recording_label`).
    """

    t: Float[Array, ""]
    q: Float[Array, " joints"]
    v: Float[Array, " joints"]
    a: Float[Array, " joints"]
    tau: Float[Array, " joints"]
    state: Float[Array, " states"]
    label: Int[Array, ""]


class AbstractEffect(eqx.Module):
    """One physical phenomenon. Override what it does; zero amplitude must be exactly absent.

    `command` acts on the torque on its way through the drive, `torque` at the joint, `read` on
    what the sensor reports. What lies between drive and link is an `AbstractTransmission`.

    Class attributes, all False by default:

    - `inertial`: `torque` depends on acceleration and is affine in it.
    - `needs_acceleration`: `torque` depends on acceleration in another way; it is given the
      acceleration that there would be without it.
    - `loaded`: `torque` depends on the torque that reaches the link.
    - `finite`: it has no derivative at nothing, or one that says little of what it does: screened
      by simulations with it.
    - `on_link`: `torque` acts on the link, beyond what gives way between it and its drive.
    - `joint_fields`: names of the fields that number joints, of an effect that depends on no other
      joints and acts on no others: one program then serves all joints (none by default).
    - `several`: one joint may have more than one of it, as it has two ends of its travel. Other
      effects that are found twice on a joint come close to something else, and are no answer.
    - `contact`: it parts and meets again, so that a shape held at a wrong value (how stiff it is)
      leaves a fit in a wrong valley.
    """

    inertial: ClassVar[bool] = False
    needs_acceleration: ClassVar[bool] = False
    loaded: ClassVar[bool] = False
    finite: ClassVar[bool] = False
    on_link: ClassVar[bool] = False
    joint_fields: ClassVar[tuple[str, ...]] = ()
    several: ClassVar[bool] = False
    contact: ClassVar[bool] = False

    @classmethod
    def effect_name(cls) -> str:
        """Its name in tables: the class's in lower case with underscores."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()

    @classmethod
    def spoken(cls) -> str:
        """Its name in a sentence: that in tables, in words."""
        return cls.effect_name().replace("_", " ")

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["AbstractEffect"]:
        """Instances to screen, at zero amplitude: every joint, and a grid of shapes if it has any.

        Of effects in whose parameters nothing is linear: instances at a small finite setting.
        """
        fields = {field.name for field in dataclasses.fields(cls)}
        if "joint" not in fields:
            return [cls()]
        return [cls(joint=j) for j in scene.joints]  # type: ignore[call-arg]

    @classmethod
    def fields_of_format(cls, fields: dict[str, Any], written: int) -> dict[str, Any]:
        """Fields of a saved effect of an older format: a smoothing was given by one over it."""
        if written > 2 or "gamma" not in fields:
            return fields
        kept = {name: value for name, value in fields.items() if name != "gamma"}
        return {**kept, "smoothing": 1 / fields["gamma"]}

    def scaled(self, factor: float) -> "AbstractEffect":
        """The effect at another size, where a finite setting was screened.

        By default what it is linear in, times the factor.
        """
        linear = [p for p in list_parameters(self) if p.declaration.free and p.declaration.linear]
        return write_values(self, linear, factor * read_values(self, linear)) if linear else self

    def initial_state(self) -> Float[Array, " states"]:
        """Its own states at rest; none by default."""
        return jnp.zeros(0)

    def settled(self, motion: Motion) -> Float[Array, " states"]:
        """Its own states when a recording starts; at rest unless the first torque says more."""
        return self.initial_state()

    def derivative(self, motion: Motion) -> Float[Array, " states"]:
        """Rate of its own states, per s."""
        return jnp.zeros_like(motion.state)

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """What becomes of the drive's torque `motion.tau`, `(joints,)`."""
        return motion.tau

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """What it asks of the drives on top of the rigid arm, `(joints,)`; friction opposes."""
        return jnp.zeros_like(motion.v)

    def read(self, q: Float[Array, " joints"]) -> Float[Array, " joints"]:
        """What the sensor reports at position q, `(joints,)`."""
        return q


class AbstractTransmission(AbstractEffect):
    """Something that gives way between drive and link of one joint (Spong 1987).

    The drive keeps the inertia `rotor`; the sensor and the friction sit on the drive. The twist
    (link minus drive) and its rate are the effect's states.
    """

    joint: eqx.AbstractVar[int]
    rotor: eqx.AbstractVar[Scalar]
    finite = True

    def initial_state(self) -> Float[Array, " states"]:
        """No twist, at rest."""
        return jnp.zeros(2)

    def after(self, other: "AbstractTransmission", load: float) -> "AbstractTransmission | None":
        """At values that come close to another that was fitted; None where it knows of none.

        **Arguments:**

        - `load`: typical torque on the joint, N·m or N.
        """
        return None

    def present(self) -> Bool[Array, ""]:
        """Whether it gives way at all; where not, drive and link move as one."""
        return jnp.asarray(True)

    def through(self, twist: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Torque that the drive passes on to the link at this twist (rad) and rate (rad/s)."""
        raise NotImplementedError


def check_declared(effect: AbstractEffect, joints: int) -> None:
    """Raises `ModelError` where a torque uses an acceleration that it would not be given.

    **Arguments:**

    - `effect`: any. `joints`: of the arm that it is on.
    """
    if effect.inertial or effect.needs_acceleration:
        return
    arrays, rest = eqx.partition(effect, eqx.is_array)
    shapes = jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), arrays)
    leaves, structure = jax.tree.flatten(shapes, is_leaf=lambda leaf: isinstance(leaf, tuple))
    if _uses_acceleration(structure, tuple(leaves), rest, joints):
        raise ModelError(
            f"{effect.effect_name()} uses motion.a, which is zero for it: write `inertial = True` "
            "into its class if its torque is proportional to acceleration, or "
            "`needs_acceleration = True`"
        )


@lru_cache(maxsize=1024)
def _uses_acceleration(
    structure: Any, shapes: tuple[tuple[tuple[int, ...], str], ...], rest: Any, joints: int
) -> bool:
    """Whether a torque depends on motion.a: traced once for all effects of a kind."""

    def torque(leaves: list[Array], a: Float[Array, " joints"]) -> Float[Array, " joints"]:
        effect = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
        zeros, now = jnp.zeros(joints), jnp.zeros(())
        state = effect.initial_state()
        return effect.torque(Motion(now, zeros, zeros, a, zeros, state, jnp.asarray(0)))

    leaves = [jax.ShapeDtypeStruct(shape, kind) for shape, kind in shapes]
    traced = jax.make_jaxpr(torque)(leaves, jax.ShapeDtypeStruct((joints,), float)).jaxpr
    _, used = dce_jaxpr(traced, [True] * len(traced.outvars))
    return any(used[len(leaves) :])


def on_joint(joint: int, value: Float[Array, ""], motion: Motion) -> Float[Array, " joints"]:
    """A torque on one joint (counted from 1) and none on the others, `(joints,)`."""
    return jnp.zeros_like(motion.v).at[joint - 1].set(value)


def smooth_sign(
    v: Float[Array, "..."],
    smoothing: Float[Array, "..."],
    form: Float[Array, "..."] | None = None,
) -> Float[Array, "..."]:
    """The sign of a velocity made differentiable: 2/pi · arctan(v / smoothing).

    **Arguments:**

    - `v`: rad/s or m/s. `smoothing`: the speed at which it is a half, 1/gamma of Brunot et al.
      2016; at zero it is the sign itself.
    - `form`: how soon it comes near the sign beyond that speed: 0 for the arctan, 1/2 for
      x / sqrt(3 + x²), 1 for a hyperbolic tangent, each a half at the same speed, and between these
      their parabola, which is above one by two thousandths at the most.
    """
    x = v / (smoothing + _SHARP)
    slow = 2 / jnp.pi * jnp.arctan(x)
    if form is None:
        return slow
    root = x / jnp.sqrt(3 + x**2)
    shares = (1 - form) * (1 - 2 * form), 4 * form * (1 - form), form * (2 * form - 1)
    return shares[0] * slow + shares[1] * root + shares[2] * jnp.tanh(_HALF * x)
