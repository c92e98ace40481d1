"""A continuous law in the form in which a drive computes it: sampled, with encoders and delay."""

import dataclasses
from collections.abc import Iterable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import ModelError
from ..recording import Recording
from ._base import AbstractController, Reading, Reference, Signals
from .pd import _vector


class Sampled(AbstractController):
    """Another law, computed every `every` seconds and held in between.

    The recorded torque is the command of the last tick; with a delay, an earlier one acts. States
    of the law, such as an integral, are integrated from tick to tick by Euler's method.

    **Arguments:**

    - `law`: a continuous controller, with or without states.
    - `every`: period, s.
    - `delay`: number of periods after which a command acts.
    - `resolution`: resolution of the encoders, rad or m, `(joints,)`; zero for exact readings.
      Simulations round the readings, fits do not: which way a reading is rounded depends on details
      of the motion that no model reproduces, so the rounding of the robot is noise of its torque,
      and that of a simulation would be further noise, which changes with every parameter.
    - `velocity`: `"measured"`, or the `"difference"` of readings `window` ticks apart.
    - `cutoff`: cutoff of a first-order low-pass on the velocity, Hz; None for no low-pass.
    - `limit`: largest torque, `(joints,)`, N·m or N. States of a joint whose torque is at the
      limit are held (conditional integration, Åström and Hägglund 2006).
    - `rounds`: whether simulations round the readings; false in fitted loops.
    """

    law: AbstractController
    every: float = eqx.field(static=True)
    delay: int = eqx.field(static=True, default=0)
    resolution: Float[Array, " joints"] = eqx.field(converter=_vector, default=0.0)
    velocity: Literal["measured", "difference"] = eqx.field(static=True, default="measured")
    window: int = eqx.field(static=True, default=1)
    cutoff: float | None = eqx.field(static=True, default=None)
    limit: Float[Array, " joints"] = eqx.field(converter=_vector, default=np.inf)
    rounds: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        if self.law.period is not None or self.law.pace > 0:
            raise ModelError(
                f"{type(self.law).__name__} cannot be the law of Sampled: give the continuous law "
                "that the drive computes, such as PD or PID"
            )
        if self.every <= 0 or self.delay < 0 or self.window < 1:
            raise ModelError(
                f"a law with a period of {self.every:g} s, a delay of {self.delay} periods and a "
                f"window of {self.window} ticks cannot be simulated: give a period above zero, a "
                "delay of 0 or more and a window of 1 or more"
            )

    @property
    def period(self) -> float:
        """Time between two ticks, s."""
        return self.every

    @property
    def lag(self) -> float:
        """Half a period, and the delay, s."""
        return (0.5 + self.delay) * self.every

    @property
    def judged(self) -> Literal["torque", "position"]:
        """The same as for the continuous law."""
        return self.law.judged

    def settled(self, recordings: Iterable[Recording]) -> "Sampled":
        """The law with exact readings, for fits."""
        return dataclasses.replace(self, law=self.law.settled(recordings), rounds=False)

    def signals(self, recording: Recording) -> Signals:
        """The inputs of the continuous law, `(samples, joints)`."""
        return self.law.signals(recording)

    def _past(self) -> int:
        return self.window if self.velocity == "difference" else 0

    def initial_state(self, reading: Reading) -> Float[Array, " states"]:
        """The law's states, zero torque, the last readings, newest first, and the velocity."""
        zero = jnp.zeros_like(reading.q)
        past = [reading.q - k * self.every * reading.v for k in range(1, self._past() + 1)]
        own = self.law.initial_state(reading)
        slow = [] if self.cutoff is None else [reading.v]
        return jnp.concatenate([own, *[zero] * (1 + self.delay), *past, *slow])

    def running(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """The states with the first command, N·m or N, in the place of zero torque before it."""
        n = reading.q.shape[0]
        own, *rest = self._parts(state, n)
        first = self.command(reading, reference, self.tick(reading, reference, state), jnp.eye(n))
        return jnp.concatenate([own, *[first] * (1 + self.delay), *rest[1 + self.delay :]])

    def _parts(self, state: Float[Array, " states"], joints: int) -> list[Float[Array, " _"]]:
        """The law's states, then the other states by joint."""
        others = 1 + self.delay + self._past() + (self.cutoff is not None)
        first = state.shape[0] - others * joints
        return jnp.split(state, [first + k * joints for k in range(others)])

    def _read(
        self, reading: Reading, past: list[Float[Array, " _"]], slow: list[Float[Array, " _"]]
    ) -> Reading:
        """Position and velocity as the drive computes them from its encoders."""
        q = reading.q
        if self.rounds:
            fine = jnp.broadcast_to(self.resolution, q.shape)
            step = jnp.where(fine > 0, fine, 1.0)
            rounded = jnp.where(fine > 0, step * jnp.round(q / step), q)
            # The derivative of the rounding is set to one.
            q = q + jax.lax.stop_gradient(rounded - q)
        v = (q - past[-1]) / (self.window * self.every) if past else reading.v
        if self.cutoff is not None:
            share = 1 - np.exp(-2 * np.pi * self.cutoff * self.every)
            v = slow[0] + share * (v - slow[0])
        return Reading(q, v)

    def tick(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """The law's states, the commands that act now and later, and the readings."""
        n = reading.q.shape[0]
        own, *rest = self._parts(state, n)
        held, rest = rest[: 1 + self.delay], rest[1 + self.delay :]
        past, slow = rest[: self._past()], rest[self._past() :]
        seen = self._read(reading, past, slow)
        identity, limit = jnp.eye(n), jnp.broadcast_to(self.limit, (n,))
        after = own + self.every * self.law.derivative(seen, reference, own)
        torque = self.law.command(seen, reference, after, identity)
        if own.shape[0]:
            full = jnp.abs(torque) > limit
            # A joint's states are held if it is at its limit, other states if any joint is.
            stay = jnp.tile(full, own.shape[0] // n) if own.shape[0] % n == 0 else jnp.any(full)
            after = jnp.where(stay, own, after)
            torque = self.law.command(seen, reference, after, identity)
        torque = jnp.clip(torque, -limit, limit)
        read = [seen.q, *past[:-1]] if past else []
        smooth = [seen.v] if slow else []
        return jnp.concatenate([after, torque, *held[:-1], *read, *smooth])

    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """The torque of the last tick, as recorded, `(joints,)`, N·m or N."""
        return self._parts(state, reading.q.shape[0])[1]

    def acting(
        self, command: Float[Array, " joints"], state: Float[Array, " states"]
    ) -> Float[Array, " joints"]:
        """The torque that acts, `(joints,)`, N·m or N."""
        return self._parts(state, command.shape[0])[1 + self.delay]
