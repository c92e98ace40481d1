"""Checks of a loop before it is simulated."""

import jax
import jax.numpy as jnp

from ..control import AbstractController, Reading, Reference
from ..errors import JaxidError, ModelError, RecordingError
from ..recording import Recording
from .loop import ClosedLoop


def check_joints(loop: ClosedLoop, recording: Recording) -> None:
    """Raises `RecordingError` if a recording's number of joints differs from the loop's."""
    if recording.joints != loop.joints:
        raise RecordingError(
            f"{recording.name} has {recording.joints} joints, but the robot {loop.name} has "
            f"{loop.joints}: choose another robot, or name the columns of its joints"
        )


def check_law(loop: ClosedLoop) -> None:
    """Raises `ModelError` for a law without one torque per joint, or whose states never change."""
    n, law = loop.joints, loop.controller

    def command(zeros):
        reading = Reading(zeros, zeros)
        reference = Reference(zeros, zeros, zeros, zeros)
        state = law.initial_state(reading)
        return law.command(reading, reference, state, jnp.outer(zeros, zeros)), state

    who = f"{type(law).__name__} of {loop.name}"
    try:
        torque, state = jax.eval_shape(command, jnp.zeros(n))
    except JaxidError:
        raise
    except (TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ModelError(
            f"{who} gives no torque for {n} joints, set all gains: {reason}"
        ) from error
    if torque.shape != (n,):
        raise ModelError(f"{who} gives torques of shape {torque.shape}, but there are {n} joints")
    changes = "derivative" if law.period is None else "tick"
    own = sum(leaf.size for leaf in jax.tree.leaves(state))
    if own and getattr(type(law), changes) is getattr(AbstractController, changes):
        kind = "no period" if law.period is None else f"a period of {law.period:.3g} s"
        raise ModelError(
            f"{who} has {own} states and {kind}, but no method `{changes}`, so its states never "
            f"change: write `{changes}`"
        )
