"""Base class of controllers, and their inputs."""

import abc
from collections.abc import Iterable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import ModelError
from ..recording import Recording


class Reading(eqx.Module):
    """Readings of the sensors: position and velocity, `(joints,)`, rad or m and per s."""

    q: Float[Array, " joints"]
    v: Float[Array, " joints"]


class Reference(eqx.Module):
    """The reference of the controller; every vector is `(joints,)`.

    `q`, `v`, `a`: the reference motion. `tau`: known torque added to the output, N·m or N. `held`:
    commands and supply of the drives at the last sample, by the names in `Recording` (`kp`, ...).
    """

    q: Float[Array, " joints"]
    v: Float[Array, " joints"]
    a: Float[Array, " joints"]
    tau: Float[Array, " joints"]
    held: dict[str, Float[Array, " joints"]] = eqx.field(default_factory=dict)


class Signals(eqx.Module):
    """Inputs of a controller from a recording, at its sample times, `(samples, joints)`.

    `hold`: whether they are constant until the next sample, even if the loop interpolates
    references.
    """

    q: Float[np.ndarray, "samples joints"]
    tau: Float[np.ndarray, "samples joints"]
    hold: bool = eqx.field(static=True, default=False)


class AbstractController(eqx.Module):
    """A control law. One with a `period` computes its command at its ticks and holds it."""

    @property
    def period(self) -> float | None:
        """Time between two ticks, s; None for a continuous law."""
        return None

    @property
    def lag(self) -> float:
        """Mean time between a sample and the action of the torque recorded there, s."""
        return (self.period or 0.0) / 2

    @property
    def late(self) -> Float[Array, ""]:
        """Time by which torque acts later than recorded, s; only a virtual law has one."""
        return jnp.zeros(())

    def initial_state(self, reading: Reading) -> Float[Array, " states"]:
        """States of the law before the first tick; none by default."""
        return jnp.zeros(0)

    def running(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """The states at the start of a recording, `(states,)`, if the law ran before.

        `state` by default, which is the initial one with the integrals of the recording.
        """
        return state

    def derivative(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """Time derivative of the states of a continuous law, per s."""
        return jnp.zeros_like(state)

    def tick(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """New states at a tick of a sampled law."""
        return state

    @abc.abstractmethod
    def command(
        self,
        reading: Reading,
        reference: Reference,
        state: Float[Array, " states"],
        mass: Float[Array, "joints joints"],
    ) -> Float[Array, " joints"]:
        """Commanded torque, `(joints,)`, N·m or N; `mass` is the model's mass matrix."""

    def acting(
        self, command: Float[Array, " joints"], state: Float[Array, " states"]
    ) -> Float[Array, " joints"]:
        """The torque that acts now, `(joints,)`; the command unless the law has a delay."""
        return command

    @property
    def judged(self) -> Literal["torque", "position"]:
        """The signal by which a model under this law is judged; torque by default.

        Position, if the signal recorded as torque follows from the position alone.
        """
        return "torque"

    @property
    def pace(self) -> float:
        """Bandwidth of a virtual law, 1/s, which integration must resolve; zero for others."""
        return 0.0

    @property
    def imposes(self) -> bool:
        """Whether the motion is imposed: the motion is the reference, torque is inverse dynamics.

        Only a virtual law can impose it.
        """
        return False

    def comparable(self, recording: Recording) -> float | None:
        """Frequency up to which measured and simulated torque may be compared, Hz; None for all.

        If there is one, the same low-pass is applied to both, the ends of a recording are left out,
        and the loop starts on its reference.
        """
        return None

    def likely(self, period: float) -> dict[str, float]:
        """Standard deviations of its values around zero before any recording, by field.

        Values that are not named may have any size; none is named by default.

        **Arguments:**

        - `period`: time between recorded samples, s.
        """
        return {}

    def settled(self, recordings: Iterable[Recording]) -> "AbstractController":
        """The controller with settings taken from the fitted recordings, for use on others."""
        return self

    def smoothed(
        self, recording: Recording, q: Float[np.ndarray, "samples joints"]
    ) -> Float[np.ndarray, "samples joints"]:
        """Positions as the law takes them from a recording, rad or m; unchanged by default."""
        return q

    def signals(self, recording: Recording) -> Signals:
        """Reference and known torque, taken from a recording.

        **Raises:** `ModelError` if the recording has no reference.
        """
        if recording.q_ref is None:
            raise ModelError(
                f"{recording.name} has no reference q_ref, which {type(self).__name__} tracks: "
                "name its columns, or use OpenLoop() or Tracking() as controller"
            )
        tau = np.zeros_like(recording.tau) if recording.tau_ff is None else recording.tau_ff
        return Signals(recording.q_ref, tau)
