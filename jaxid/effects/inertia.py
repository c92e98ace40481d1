"""Inertia that is not part of the base parameters."""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, Vector, as_float64, parameter
from ._base import AbstractEffect, Motion, on_joint, recording_label
from ._scene import Scene


class RotorInertia(AbstractEffect):
    """Inertia of a drive behind its gear: J a; joint 2 and further."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    inertia: Scalar = parameter(0.0, symbol="Ia", unit="kg·m²", lower=0.0, scale=0.05)
    inertial = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["RotorInertia"]:
        """Joints from 2 on, as joint 1's rotor is part of its base inertia; all if that is held."""
        return [cls(joint=j) for j in scene.joints if j > 1 or scene.drawn]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """J a on the joint, `(joints,)`."""
        return on_joint(self.joint, self.inertia * motion.a[self.joint - 1], motion)


class Payload(AbstractEffect):
    """A point mass on the last link, on all or on named recordings.

    `lengths` are those of the links before the last (m), `reach` is the mass's distance along the
    last link, `g` is gravity in the plane, with angles from hanging down (m/s²). On a sliding joint
    it is a mass on the carriage.
    """

    mass: Scalar = parameter(0.0, symbol="payload", unit="kg", lower=0.0, scale=0.1)
    reach: Scalar = parameter(0.3, symbol="reach", unit="m", lower=0.0, scale=0.1, linear=False)
    recordings: tuple[str, ...] = eqx.field(static=True, default=())
    lengths: Vector = eqx.field(converter=as_float64, default=(0.5,))
    g: Scalar = eqx.field(converter=as_float64, default=0.0)
    slides: bool = eqx.field(static=True, default=False)
    inertial = True
    on_link = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["Payload"]:
        """One recording at a time: on all of them it is the same as the link's own mass.

        For turning joints the link lengths must be known; arms with both kinds of joints give none.
        """
        slides = all(scene.slides)
        known = slides or len(scene.lengths) == len(scene.slides) - 1
        if (
            len(scene.recordings) < 2
            or not scene.planar
            or not known
            or any(scene.slides) != slides
        ):
            return []
        reaches = (0.0,) if slides else (0.1, 0.2, 0.35, 0.5)
        return [
            cls(recordings=(name,), reach=reach, lengths=scene.lengths, g=scene.g, slides=slides)
            for name in scene.recordings
            for reach in reaches
        ]

    def torque(self, motion: Motion) -> Float[Array, " joints"]:
        """Torque that moves the mass, `(joints,)`."""
        if self.slides:
            asked = self.mass * motion.a
        else:
            asked = self.mass * self._jacobian(motion.q).T @ self._lift(motion)
        if not self.recordings:
            return asked
        labels = [recording_label(name) for name in self.recordings]
        carried = jnp.any(motion.label == jnp.asarray(labels))
        return jnp.where(carried, asked, 0.0)

    def _place(self, q: Float[Array, " joints"]) -> Float[Array, " two"]:
        angle = jnp.cumsum(q)
        lengths = jnp.append(self.lengths, self.reach)
        return jnp.stack([lengths @ jnp.sin(angle), -lengths @ jnp.cos(angle)])

    def _jacobian(self, q: Float[Array, " joints"]) -> Float[Array, "two joints"]:
        return jax.jacfwd(self._place)(q)

    def _lift(self, motion: Motion) -> Float[Array, " two"]:
        """Acceleration of the mass minus gravity."""

        def velocity(q: Float[Array, " joints"]) -> Float[Array, " two"]:
            return jax.jvp(self._place, (q,), (motion.v,))[1]

        turning = jax.jvp(velocity, (motion.q,), (motion.v,))[1]
        up = jnp.stack([jnp.zeros(()), self.g])
        return self._jacobian(motion.q) @ motion.a + turning + up
