"""Base classes of effects: what an effect may change, and where in the loop."""

import dataclasses
import math
import re
import zlib
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array, Bool, Float, Int

from ..errors import ModelError
from ..parameters import Scalar, list_parameters, read_values, write_values
from ._scene import Scene

# No recording: effects that act on named recordings do not act.
NOBODY = 0
# Added to a smoothing, rad/s or m/s: avoids division by zero at standstill, and keeps the
# derivative with respect to the smoothing useful at zero, its bound.
_SHARP = 1e-30
# Argument at which a hyperbolic tangent is 1/2.
_HALF = math.atanh(0.5)
# Slope of x / (1 + x⁸)^(1/8) at which it is 1/2 at x = 1.
_CORNER = 255**-0.125


def recording_label(name: str) -> int:
    """The number that stands for a recording's name in `Motion.label`."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


class Motion(eqx.Module):
    """State of the arm at one instant, the input of an effect; every vector is `(joints,)`.

    `t` is in s; `q`, `v`, `a` are in rad or m and their derivatives; `tau` is the torque that the
    drives deliver, N·m or N. `a` is zero unless the effect is `inertial` or `needs_acceleration`.
    For a `loaded` effect, `tau` is the torque that remains after all other effects on the drives,
    without that which accelerates rotors if the effect is `geared`, and `load` is the torque that
    the links need without accelerating (None for other effects). `state` contains the effect's own
    states. `label` identifies the recording (`recording_label`). `held` has the recording's signals
    that are constant from sample to sample, by name (`on`, `supply`). `imposed` is true if the
    motion does not follow from the torque (unknown law); `a` is then the acceleration, for every
    effect.
    """

    t: Float[Array, ""]
    q: Float[Array, " joints"]
    v: Float[Array, " joints"]
    a: Float[Array, " joints"]
    tau: Float[Array, " joints"]
    state: Float[Array, " states"]
    label: Int[Array, ""]
    held: dict[str, Float[Array, " joints"]] = eqx.field(default_factory=dict)
    load: Float[Array, " joints"] | None = None
    imposed: bool = eqx.field(static=True, default=False)


class AbstractEffect(eqx.Module):
    """A physical effect. Override the methods that describe it; zero amplitude must mean absent.

    `command` changes the torque on its way through the drive, `torque` acts at the joint, `read`
    changes the sensor's reading. Effects between drive and link are `AbstractTransmission`s.

    Class attributes, False by default:

    - `inertial`: `torque` depends on acceleration and is affine in it.
    - `needs_acceleration`: `torque` depends on acceleration in another way; `a` is then the
      acceleration of the arm without the effect.
    - `loaded`: `torque` depends on the torque of the drive. `geared`: it depends on the part of it
      that passes the gear and does not accelerate the rotor.
    - `finite`: it has no derivative at zero amplitude, or one that does not predict its effect, so
      it is screened by simulations with a finite amplitude.
    - `on_link`: `torque` acts on the link, beyond an elastic transmission.
    - `joint_fields`: names of the fields that are joint numbers, for an effect that depends and
      acts on no other joints; one compiled program then serves all joints (none by default).
    - `several`: how many of this effect a joint may have, such as a stop at each end; 1 by default.
      More of them approximate a different effect.
    - `contact`: parts separate and touch again. A fit with a wrong stiffness then converges to a
      wrong minimum, so the stiffness is estimated as well.
    - `local`: it acts only in a part of the motion, such as a stop or a limit. That part may occur
      once, and other stretches of the recordings then do not determine the effect.
    - `optional`: groups of amplitudes that may be zero while others are not, such as the second
      harmonic of a wave. A group that explains less than its price is left out of the final fit.
    """

    inertial: ClassVar[bool] = False
    needs_acceleration: ClassVar[bool] = False
    loaded: ClassVar[bool] = False
    geared: ClassVar[bool] = False
    finite: ClassVar[bool] = False
    on_link: ClassVar[bool] = False
    joint_fields: ClassVar[tuple[str, ...]] = ()
    several: ClassVar[int] = 1
    contact: ClassVar[bool] = False
    local: ClassVar[bool] = False
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()

    @classmethod
    def effect_name(cls) -> str:
        """Name in tables: the class name in lower case with underscores."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()

    @classmethod
    def spoken(cls) -> str:
        """Name in a sentence."""
        return cls.effect_name().replace("_", " ")

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["AbstractEffect"]:
        """Instances to screen, at zero amplitude: every joint, and a grid of shapes if it has any.

        Effects without a linear parameter give instances at a small finite setting.
        """
        fields = {field.name for field in dataclasses.fields(cls)}
        if "joint" not in fields:
            return [cls()]
        return [cls(joint=j) for j in scene.joints]  # type: ignore[call-arg]

    @classmethod
    def fields_of_format(cls, fields: dict[str, Any], written: int) -> dict[str, Any]:
        """Converts fields of an older file format, which stored the inverse of a smoothing."""
        if written > 2 or "gamma" not in fields:
            return fields
        kept = {name: value for name, value in fields.items() if name != "gamma"}
        return {**kept, "smoothing": 1 / fields["gamma"]}

    def scaled(self, factor: float) -> "AbstractEffect":
        """The effect scaled by a factor, for effects screened at a finite setting.

        By default scales the parameters in which torque is linear.
        """
        linear = [p for p in list_parameters(self) if p.declaration.free and p.declaration.linear]
        return write_values(self, linear, factor * read_values(self, linear)) if linear else self

    def genuine(self, scene: Scene, beside: Sequence["AbstractEffect"]) -> bool:
        """Whether its values are those of this effect, not of another one that it approximates.

        A search does not add an effect for which this is false. True by default.

        **Arguments:**

        - `scene`: the recorded motion. `beside`: the other effects of the model.
        """
        return True

    def likely(self, torque: Float[np.ndarray, " joints"]) -> dict[str, float]:
        """Standard deviations of its values around zero before any recording, by field.

        Values that are not named may have any size; none is named by default.

        **Arguments:**

        - `torque`: root mean square of the recorded torque, `(joints,)`, N·m or N.
        """
        return {}

    def initial_state(self) -> Float[Array, " states"]:
        """States of the effect at rest; none by default."""
        return jnp.zeros(0)

    def settled(self, motion: Motion) -> Float[Array, " states"]:
        """States at the start of a recording; those at rest by default."""
        return self.initial_state()

    def derivative(self, motion: Motion) -> Float[Array, " states"]:
        """Time derivative of the effect's states, per s."""
        return jnp.zeros_like(motion.state)

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """The drive's torque `motion.tau` as changed by the effect, `(joints,)`."""
        return motion.tau

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque needed in addition to the rigid arm's, `(joints,)`; friction has the sign of v."""
        return jnp.zeros_like(motion.v)

    def read(self, q: Float[Array, " joints"]) -> Float[Array, " joints"]:
        """Reading of the sensor at position q, `(joints,)`."""
        return q


class AbstractTransmission(AbstractEffect):
    """Base class of compliance between drive and link of one joint (Spong 1987).

    The drive has the inertia `rotor`; sensor and friction are on the drive's side. The states are
    the twist (link minus drive) and its rate.
    """

    joint: eqx.AbstractVar[int]
    rotor: eqx.AbstractVar[Scalar]
    finite = True
    local = True

    def initial_state(self) -> Float[Array, " states"]:
        """No twist, at rest."""
        return jnp.zeros(2)

    def settled(self, motion: Motion) -> Float[Array, " states"]:
        """The twist under the torque `motion.tau` that holds the links, and no rate, `(2,)`."""
        return jnp.stack([self.twisted(motion.tau[self.joint - 1]), jnp.zeros(())])

    def twisted(self, torque: Float[Array, ""]) -> Float[Array, ""]:
        """Twist at rest (rad or m) with this torque (N·m or N); zero if it is not known."""
        return jnp.zeros_like(torque)

    def after(self, other: "AbstractTransmission", load: float) -> "AbstractTransmission | None":
        """The effect at values similar to another fitted transmission; None if there are none.

        **Arguments:**

        - `load`: typical torque on the joint, N·m or N.
        """
        return None

    def present(self) -> Bool[Array, ""]:
        """Whether it is compliant; otherwise drive and link move together."""
        return jnp.asarray(True)

    def through(self, twist: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Torque from drive to link at this twist (rad) and rate (rad/s)."""
        raise NotImplementedError


def check_declared(effect: AbstractEffect, joints: int) -> None:
    """Raises `ModelError` if the torque of an effect cannot be computed as the effect declares it.

    **Arguments:**

    - `effect`: any effect. `joints`: number of joints of its arm.
    """
    arrays, rest = eqx.partition(effect, eqx.is_array)
    shapes = jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), arrays)
    leaves, structure = jax.tree.flatten(shapes, is_leaf=lambda leaf: isinstance(leaf, tuple))
    try:
        shape, accelerated = _traced_torque(structure, tuple(leaves), rest, joints)
    except jax.errors.TracerArrayConversionError as error:
        raise ModelError(
            f"{effect.effect_name()} passes a JAX array to numpy: use the functions of jax.numpy "
            "in its torque"
        ) from error
    if shape != (joints,):
        raise ModelError(
            f"the torque of {effect.effect_name()} has shape {shape}, but the arm has {joints} "
            f"joints: return one torque per joint, of shape ({joints},); "
            "jaxid.effects.on_joint(joint, value, motion) makes it from one value"
        )
    if accelerated and not (effect.inertial or effect.needs_acceleration):
        raise ModelError(
            f"{effect.effect_name()} uses motion.a, which is zero for it: write `inertial = True` "
            "into its class if its torque is proportional to acceleration, or "
            "`needs_acceleration = True`"
        )


@lru_cache(maxsize=1024)
def _traced_torque(
    structure: Any, shapes: tuple[tuple[tuple[int, ...], str], ...], rest: Any, joints: int
) -> tuple[tuple[int, ...], bool]:
    """Shape of a torque, and whether it depends on motion.a; traced once for each class of effect.

    Without the type checks of tests, a torque may have any shape.
    """

    def torque(leaves: list[Array], a: Float[Array, " joints"]) -> Float[Array, "..."]:
        effect = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
        zeros, now = jnp.zeros(joints), jnp.zeros(())
        state = effect.initial_state()
        label = jnp.asarray(0)
        return effect.torque(Motion(now, zeros, zeros, a, zeros, state, label, {}, zeros))

    leaves = [jax.ShapeDtypeStruct(shape, kind) for shape, kind in shapes]
    traced = jax.make_jaxpr(torque)(leaves, jax.ShapeDtypeStruct((joints,), float)).jaxpr
    _, used = dce_jaxpr(traced, [True] * len(traced.outvars))
    return traced.outvars[0].aval.shape, any(used[len(leaves) :])


def on_joint(joint: int, value: Float[Array, ""], motion: Motion) -> Float[Array, " joints"]:
    """A torque on one joint (counted from 1) and none on the others, `(joints,)`."""
    return jnp.zeros_like(motion.v).at[joint - 1].set(value)


def smooth_sign(
    v: Float[Array, "..."],
    smoothing: Float[Array, "..."],
    form: Float[Array, "..."] | None = None,
) -> Float[Array, "..."]:
    """A differentiable sign of a velocity: 2/pi · arctan(v / smoothing).

    **Arguments:**

    - `v`: rad/s or m/s. `smoothing`: the speed at which the result is 1/2, which is 1/gamma of
      Brunot et al. 2016; zero gives the sign itself.
    - `form`: shape of the function, which is 1/2 at the same speed for all: 0 for the arctan, 1/2
      for x / sqrt(3 + x²), 1 for the hyperbolic tangent, 3/2 for a ramp with rounded corners, and
      cubic interpolation between these, which exceeds one by at most 0.004.
    """
    x = v / (smoothing + _SHARP)
    slow = 2 / jnp.pi * jnp.arctan(x)
    if form is None:
        return slow
    root = x / jnp.sqrt(3 + x**2)
    ramp = _CORNER * x
    ramp = ramp / jnp.sqrt(jnp.sqrt(jnp.sqrt(1 + ramp**8)))
    n = 2 * form
    shares = (
        (1 - n) * (2 - n) * (3 - n) / 6,
        n * (2 - n) * (3 - n) / 2,
        n * (n - 1) * (3 - n) / 2,
        n * (n - 1) * (n - 2) / 6,
    )
    forms = slow, root, jnp.tanh(_HALF * x), ramp
    return sum((s * f for s, f in zip(shares, forms, strict=True)), jnp.zeros(()))
