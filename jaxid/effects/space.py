"""Gravity and inertia loads of a spatial arm: a tilted base, and a body carried at the tip."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import BODY, BODY_UNITS, Chain, moved_body
from ..parameters import KNOWN, Scalar, Vector, as_float64, parameter
from ._base import NOBODY, AbstractEffect, Motion, recording_label
from ._scene import Scene

MASS = BODY.index("M")


class BaseTilt(AbstractEffect):
    """A base that is not level: gravity is tilted from its direction in the model.

    The magnitude of gravity is known, so two slopes determine it: its direction is
    g + |g| (x e1 + y e2), with e1 and e2 perpendicular to g. For a base modelled upright, e1 is its
    x axis and e2 its y axis. The weight of each link loads the joints before it by its mass and
    first moment (Khalil, Dombre 2002).

    **Arguments:**

    - `chain`: joints of the arm, with gravity as modelled.
    - `bodies`: `BODY` of each link, SI units, `(joints, 10)`. They are not estimated, even if the
      arm's base parameters are: they keep the values of the time at which the effect was made.
    - `x`, `y`: tangents of the angles by which gravity is tilted; None for one that affects no
      torque.
    """

    chain: Chain = eqx.field(metadata=KNOWN)
    bodies: Float[Array, "joints 10"] = eqx.field(converter=as_float64)
    # Torque is linear in the slopes up to terms of second order in the angle.
    x: Scalar | None = parameter(0.0, symbol="tiltx", unit="1", scale=0.02)
    y: Scalar | None = parameter(0.0, symbol="tilty", unit="1", scale=0.02)
    on_link = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["BaseTilt"]:
        """One instance for spatial arms under gravity, with the slopes that affect torque."""
        if scene.space is None or not np.any(scene.space.chain.gravity):
            return []
        made = cls(scene.space.chain, scene.space.bodies)
        rng = np.random.default_rng(0)
        q = rng.uniform(scene.q_low, scene.q_high, (16, len(scene.q_low)))
        columns = np.asarray(_slopes(made, jnp.asarray(q)))
        size = np.linalg.norm(columns, axis=0)
        largest = int(size.argmax())
        weight = float(np.linalg.norm(scene.space.chain.gravity) * np.sum(scene.space.bodies[:, 9]))
        if size[largest] <= 1e-9 * weight:
            return []
        if np.linalg.svd(columns, compute_uv=False)[-1] > 1e-6 * size[largest]:
            return [made]
        return [dataclasses.replace(made, **{"yx"[largest]: None})]

    def gravity(self) -> Float[Array, "3"]:
        """The tilted gravity in the base's frame, m/s²."""
        drawn = self.chain.gravity
        size = jnp.sqrt(drawn @ drawn)
        down = drawn / size
        # Perpendicular to gravity: from the base's x axis, or its z axis if gravity is along x.
        axis = jnp.where(jnp.abs(down[0]) < 0.9, jnp.eye(3)[0], jnp.eye(3)[2])
        first = axis - (axis @ down) * down
        first = first / jnp.sqrt(first @ first)
        second = jnp.cross(first, down)
        x, y = (0.0 if slope is None else slope for slope in (self.x, self.y))
        leaning = down + x * first + y * second
        return size * leaning / jnp.sqrt(leaning @ leaning)

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque of the links' weight beyond that on a level base, `(joints,)`."""
        change = dataclasses.replace(self.chain, gravity=self.gravity() - self.chain.gravity)
        rest = jnp.zeros_like(motion.v)
        return change.inverse(self.bodies, motion.q, rest, rest)


@eqx.filter_jit
def _slopes(effect: BaseTilt, q: Float[Array, "poses joints"]) -> Float[Array, "rows two"]:
    """Derivative of torque by both slopes at poses at rest, one row for each joint."""
    rest, none = jnp.zeros_like(q[0]), jnp.zeros(0)

    def torque(slopes: Float[Array, " two"], at: Float[Array, " joints"]):
        leaning = dataclasses.replace(effect, x=slopes[0], y=slopes[1])
        here = Motion(jnp.zeros(()), at, rest, rest, rest, none, jnp.asarray(NOBODY))
        return leaning.torque(here)

    return jax.vmap(jax.jacfwd(torque), (None, 0))(jnp.zeros(2), q).reshape(-1, 2)


class CarriedBody(AbstractEffect):
    """A body at the tip of a spatial arm, on all or on named recordings.

    Torque is linear in its ten parameters about the tip (Khalil, Dombre 2002). If it is on all
    recordings, it can be identified only if the parameters of the last link are held.

    **Arguments:**

    - `chain`: joints of the arm, and its tip.
    - `mass`: kg. `rest`: its other parameters about the tip, along the axes of the last link's
      frame, kg·m² and kg·m, in the order of `shown`.
    - `recordings`: names of the recordings that have it; all if none is named.
    - `shown`: indices of `rest` in `BODY`; an arm of few joints does not identify all, and the
      others are zero.
    """

    chain: Chain = eqx.field(metadata=KNOWN)
    mass: Scalar = parameter(0.0, symbol="payload", unit="kg", lower=0.0, scale=0.5)
    rest: Vector = parameter((0.0,) * 9, symbol="payload_rest", unit="", scale=0.05)
    recordings: tuple[str, ...] = eqx.field(static=True, default=())
    shown: tuple[int, ...] = eqx.field(static=True, default=tuple(range(9)))
    inertial = True
    on_link = True

    @classmethod
    def effect_name(cls) -> str:
        """The name of a payload; this is its form for spatial arms."""
        return "payload"

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["CarriedBody"]:
        """On each of several recordings in turn, and on all if the last link is held."""
        if scene.space is None or MASS not in scene.space.carried:
            return []
        named = [(name,) for name in scene.recordings] if len(scene.recordings) > 1 else []
        whole = [()] if scene.drawn else []
        shown = tuple(sorted(k for k in scene.space.carried if k != MASS))
        zeros = (0.0,) * len(shown)
        chain = scene.space.chain
        return [cls(chain, 0.0, zeros, names, shown) for names in (*whole, *named)]

    @property
    def rest_names(self) -> tuple[str, ...]:
        """Names of the other parameters, with their recordings."""
        where = f"({','.join(self.recordings)})" if self.recordings else ""
        return tuple(f"payload_{BODY[k]}{where}" for k in self.shown)

    @property
    def rest_units(self) -> tuple[str, ...]:
        """Units of the other parameters."""
        return tuple(BODY_UNITS[k] for k in self.shown)

    def about_tip(self) -> Float[Array, "10"]:
        """Its parameters in the order of `BODY` about the tip, SI units."""
        # Number by number: an array operation would break up the kernel of a simulation's loop.
        given = {**dict(zip(self.shown, self.rest, strict=True)), MASS: self.mass}
        return jnp.stack([jnp.asarray(given.get(k, 0.0)) for k in range(10)])

    def centre(self) -> Float[Array, "3"]:
        """Position of its centre of mass in the last link's frame, m."""
        return self.chain.tip + self.about_tip()[6:9] / self.mass

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque needed to move the body, `(joints,)`."""
        last = moved_body(self.about_tip(), self.chain.tip)
        bodies = jnp.zeros((self.chain.joints, 10)).at[-1].set(last)
        asked = self.chain.inverse(bodies, motion.q, motion.v, motion.a)
        if not self.recordings:
            return asked
        labels = [recording_label(name) for name in self.recordings]
        return jnp.where(jnp.any(motion.label == jnp.asarray(labels)), asked, 0.0)
