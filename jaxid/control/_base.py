"""What a controller sees and gives."""

import abc
from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..errors import ModelError
from ..recording import Recording


class Reading(eqx.Module):
    """What the sensors report: position and velocity, `(joints,)`, rad or m and per s."""

    q: Float[Array, " joints"]
    v: Float[Array, " joints"]


class Reference(eqx.Module):
    """What the controller is asked for; every vector is `(joints,)`.

    `q`, `v`, `a`: the reference motion. `tau`: known torque added to the output, N·m or N.
    """

    q: Float[Array, " joints"]
    v: Float[Array, " joints"]
    a: Float[Array, " joints"]
    tau: Float[Array, " joints"]


class Signals(eqx.Module):
    """What a controller takes from a recording, sampled at its times, `(samples, joints)`."""

    q: Float[np.ndarray, "samples joints"]
    tau: Float[np.ndarray, "samples joints"]


class AbstractController(eqx.Module):
    """A control law. One with a `period` computes its command at its ticks and holds it."""

    @property
    def period(self) -> float | None:
        """Time between two ticks, s; None for a continuous law."""
        return None

    def initial_state(self, reading: Reading) -> Float[Array, " states"]:
        """Its own states before the first tick; none by default."""
        return jnp.zeros(0)

    def derivative(
        self, reading: Reading, reference: Reference, state: Float[Array, " states"]
    ) -> Float[Array, " states"]:
        """Rate of the states of a continuous law, per s."""
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
        """What of the command acts now, `(joints,)`; all of it unless the loop has a delay."""
        return command

    @property
    def pace(self) -> float:
        """How fast a law made up for the simulation is, 1/s, where steps must resolve it."""
        return 0.0

    @property
    def imposes(self) -> bool:
        """Whether the reference is the motion, and the command the torque that it takes.

        Only a law that is made up for a simulation can do so.
        """
        return False

    def comparable(self, recording: Recording) -> float | None:
        """Frequency up to which measured and simulated torque may be compared, Hz; None for all.

        Where it is given, both pass the same low-pass first, the ends of a recording do not count,
        and the loop starts on its reference.
        """
        return None

    def moving(
        self, recording: Recording, cutoff: float
    ) -> Bool[np.ndarray, "samples joints"] | None:
        """At which samples a joint's torque may be compared; None for all.

        **Arguments:**

        - `cutoff`: up to which measured and simulated torque are compared, Hz.
        """
        return None

    def settled(self, recordings: Iterable[Recording]) -> "AbstractController":
        """The same with what it takes from the recordings that it is fitted to, for all others."""
        return self

    def signals(self, recording: Recording) -> Signals:
        """Reference and known torque, taken from a recording.

        **Raises:** `ModelError` where the recording has no reference.
        """
        if recording.q_ref is None:
            raise ModelError(
                f"{recording.name} has no reference q_ref, which {type(self).__name__} tracks: "
                "name its columns, or use OpenLoop() or Tracking() as controller"
            )
        tau = np.zeros_like(recording.tau) if recording.tau_ff is None else recording.tau_ff
        return Signals(recording.q_ref, tau)
