"""Checks of a loop before it is simulated."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..control import AbstractController, Reading, Reference
from ..errors import JaxidError, ModelError, RecordingError
from ..recording import Recording
from .loop import ClosedLoop


def check_loop(loop: object) -> None:
    """Raises `ModelError` for a first argument that is not a loop."""
    if not isinstance(loop, ClosedLoop):
        raise ModelError(
            f"the first argument is a {type(loop).__name__}, not a loop: give the model first, "
            "such as jaxid.scara() or jaxid.serial(...), then the recordings"
        )


def check_joints(loop: ClosedLoop, recording: Recording) -> None:
    """Raises `RecordingError` if a recording's number of joints differs from the loop's."""
    if recording.joints != loop.joints:
        raise RecordingError(
            f"{recording.name} has {recording.joints} joints, but the robot {loop.name} has "
            f"{loop.joints}: choose another robot, or name the columns of its joints"
        )


def check_law(loop: ClosedLoop) -> None:
    """Raises `ModelError` for a law without one torque per joint, or with states of a wrong form.

    States must be one vector, which `derivative` or `tick` changes.
    """
    n, law = loop.joints, loop.controller
    changes = "derivative" if law.period is None else "tick"

    def command(zeros):
        reading = Reading(zeros, zeros)
        reference = Reference(zeros, zeros, zeros, zeros)
        state = law.initial_state(reading)
        after = getattr(law, changes)(reading, reference, state)
        return law.command(reading, reference, state, jnp.outer(zeros, zeros)), state, after

    who = f"{type(law).__name__} of {loop.name}"
    try:
        torque, state, after = jax.eval_shape(command, jnp.zeros(n))
    except JaxidError:
        raise
    except (TypeError, ValueError) as error:
        reason = _sizes(law, n) or str(error).splitlines()[0]
        raise ModelError(
            f"{who} gives no torque for {n} joints, set all gains: {reason}"
        ) from error
    if torque.shape != (n,):
        raise ModelError(f"{who} gives torques of shape {torque.shape}, but there are {n} joints")
    if not isinstance(state, jax.ShapeDtypeStruct) or state.ndim != 1:
        raise ModelError(f"{who} has states of another form than one vector: concatenate them")
    own = state.size
    if own and getattr(type(law), changes) is getattr(AbstractController, changes):
        kind = "no period" if law.period is None else f"a period of {law.period:.3g} s"
        raise ModelError(
            f"{who} has {own} states and {kind}, but no method `{changes}`, so its states never "
            f"change: write `{changes}`"
        )
    if getattr(after, "shape", None) != state.shape:
        raise ModelError(
            f"{who} has {own} states, but `{changes}` gives {getattr(after, 'shape', after)}: let "
            "it give one value for each state"
        )


def _sizes(law: AbstractController, joints: int) -> str:
    """The numbers of values of a law's arrays that are neither one nor the number of joints."""
    arrays = [*_arrays(law), *_arrays(getattr(law, "law", None))]
    wrong = [(name, x.size) for name, x in arrays if x.ndim == 1 and x.size not in (1, joints)]
    return ", ".join(f"{name} has {size} values" for name, size in wrong)


def _arrays(law: object) -> list[tuple[str, Array]]:
    """The arrays among the fields of a law, with their names."""
    if not isinstance(law, AbstractController):
        return []
    given = [(f.name, getattr(law, f.name)) for f in dataclasses.fields(law)]
    return [(name, value) for name, value in given if eqx.is_array(value)]
