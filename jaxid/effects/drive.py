"""Effects between commanded torque and joint: gain, lag, delay, saturation."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parameters import Scalar, parameter
from ._base import AbstractEffect, Motion
from ._scene import Scene


class DriveGain(AbstractEffect):
    """Wrong torque constant of one drive, which delivers (1 + g) times the command."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    gain: Scalar = parameter(0.0, symbol="gain", unit="1", lower=-0.9, scale=0.1)

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """The command with one joint's torque scaled, `(joints,)`."""
        return motion.tau.at[self.joint - 1].multiply(1 + self.gain)


class ActuatorLag(AbstractEffect):
    """A first-order current loop: T tau' + tau = command."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    time_constant: Scalar = parameter(
        0.0, symbol="Tlag", unit="s", lower=0.0, scale=0.01, linear=False
    )

    @property
    def late(self) -> Float[Array, ""]:
        """Time by which slow torques follow their command, s."""
        return self.time_constant

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["ActuatorLag"]:
        """One small lag for each joint; its size is estimated in the refit."""
        return [cls(joint=j, time_constant=scene.period) for j in scene.joints]

    def scaled(self, factor: float) -> "ActuatorLag":
        """The time constant times a factor."""
        return dataclasses.replace(self, time_constant=self.time_constant * factor)

    def initial_state(self) -> Float[Array, " states"]:
        """Zero torque, `(1,)`."""
        return jnp.zeros(1)

    def settled(self, motion: Motion) -> Float[Array, " states"]:
        """The equilibrium at the first command, `(1,)`."""
        return motion.tau[self.joint - 1][None]

    def derivative(self, motion: Motion) -> Float[Array, " states"]:
        """Rate of the delivered torque, `(1,)`, N·m/s."""
        slow = jnp.where(self.time_constant > 0, self.time_constant, 1.0)
        return (motion.tau[self.joint - 1] - motion.state) / slow

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """The lagging torque on the joint, `(joints,)`."""
        j = self.joint - 1
        delivered = jnp.where(self.time_constant > 0, motion.state[0], motion.tau[j])
        return motion.tau.at[j].set(delivered)


class TimeDelay(AbstractEffect):
    """Dead time between command and torque, by Padé's approximant of orders 4 and 5.

    Its error is 2.2e-9 (2 pi frequency times delay)^10, 1e-4 at 15 Hz for 30 ms. No part of the
    command arrives without delay.
    """

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    delay: Scalar = parameter(0.0, symbol="delay", unit="s", lower=0.0, scale=0.01, linear=False)

    @property
    def late(self) -> Float[Array, ""]:
        """Time by which torques follow their command, s."""
        return self.delay

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["TimeDelay"]:
        """One small delay for each joint; its size is estimated in the refit."""
        return [cls(joint=j, delay=scene.period) for j in scene.joints]

    def scaled(self, factor: float) -> "TimeDelay":
        """The delay times a factor."""
        return dataclasses.replace(self, delay=self.delay * factor)

    def initial_state(self) -> Float[Array, " states"]:
        """Zero torque in transit, `(5,)`."""
        return jnp.zeros(5)

    def settled(self, motion: Motion) -> Float[Array, " states"]:
        """The equilibrium at the first command, `(5,)`."""
        return jnp.zeros(5).at[0].set(motion.tau[self.joint - 1])

    def derivative(self, motion: Motion) -> Float[Array, " states"]:
        """Rate of a low-passed command and its derivatives in units of delay / 7, `(5,)`."""
        late, slopes = motion.state[0], motion.state[1:]
        # The magnitude of all poles is about 7; in these units no state is large.
        below = jnp.array([8400 / 7**4, 2100 / 7**3, 300 / 7**2, 25 / 7])
        last = 15120 / 7**5 * (motion.tau[self.joint - 1] - late) - below @ slopes
        pace = 7 / jnp.where(self.delay > 0, self.delay, 1.0)
        return pace * jnp.append(slopes, last)

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """The delayed torque on the joint, `(joints,)`."""
        j = self.joint - 1
        late = jnp.array([1, -7 * 4 / 9, 7**2 / 12, -(7**3) / 126, 7**4 / 3024]) @ motion.state
        return motion.tau.at[j].set(jnp.where(self.delay > 0, late, motion.tau[j]))


class TorqueSaturation(AbstractEffect):
    """Torque limit of the drive; larger commands are cut off."""

    joint_fields = ("joint",)
    joint: int = eqx.field(static=True)
    limit: Scalar = parameter(
        jnp.inf, symbol="limit", unit="N·m", lower=0.0, scale=1.0, linear=False
    )
    finite = True
    local = True

    @classmethod
    def screened(cls, scene: Scene) -> Iterable["TorqueSaturation"]:
        """Limits from just below the largest torque down to half of it.

        With a lower limit the simulated motion differs so much that a refit does not converge.
        """
        return [
            cls(joint=j, limit=share * scene.torque[j - 1])
            for j in scene.joints
            for share in (0.98, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5)
        ]

    def command(self, motion: Motion) -> Float[Array, " joints"]:
        """The torque within its limits, `(joints,)`."""
        j = self.joint - 1
        return motion.tau.at[j].set(jnp.clip(motion.tau[j], -self.limit, self.limit))
