"""What is compared of the responses to effects that are inputs of the linear system."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..effects.placed import Placed
from ..simulation.batch import Batch
from ..simulation.loop import ClosedLoop
from ..simulation.sharing import at_once, taken
from .forces import OwnForces, left_for_links, misreads, own_forces
from .linear import Linearised, Place, at_samples, respond, series_at_samples
from .table import OutputSeries

# Largest number of forces, in single precision, that are computed at once for one recording. Those
# of all hypotheses along a minute at 500 Hz need 5 GB for an arm of seven joints. What is compared
# of them needs a tenth.
_ROOM = 1 << 27


class Stack(eqx.Module):
    """Stacked effects of one structure, and the numbers of their columns."""

    placed: Placed
    columns: Int[np.ndarray, "effects columns"]

    def some(self, which: slice) -> "Stack":
        """The stack of some of the effects."""
        placed = jax.tree.map(lambda x: x[which] if eqx.is_array_like(x) else x, self.placed)
        return Stack(placed, self.columns[which])


class _Portion(eqx.Module):
    """Stacks whose responses are computed at once.

    - `place`: where their torque acts. `reading`: whether they act on the reading as well.
    - `own`: response of each output to the torque at its own joint, at the beginning and the end of
      an interval; None if torque has other effects on the output.
    """

    stacks: tuple[Stack, ...]
    place: Place = eqx.field(static=True)
    reading: bool = eqx.field(static=True)
    own: Float[np.ndarray, "recordings points 2 joints"] | None


class _Run(eqx.Module):
    """One recording, with axes of length one for the recordings."""

    linear: Linearised
    batch: Batch
    left: Float[Any, "one points joints"]


def responses(
    loop: ClosedLoop, batch: Batch, linear: Linearised, stacks: Sequence[Stack]
) -> list[OutputSeries]:
    """What is compared of responses to effects that are inputs of the linear system."""
    left = left_for_links(loop, linear.motion)
    portions = _portions(linear, stacks)
    runs = [_Run(*taken((linear, batch, left), np.array([k]))) for k in range(len(left))]
    # Portions in the inner loop: two threads then compile the programs of different ones.
    tasks = [(k, portion) for k in range(len(runs)) for portion in portions]
    found = at_once(lambda task: _response(task[1], runs[task[0]], task[0]), tasks)
    return [
        OutputSeries(
            np.concatenate([s.values for s in found[n :: len(portions)]]), one.output, one.column
        )
        for n, one in enumerate(found[: len(portions)])
    ]


def _response(portion: _Portion, run: _Run, recording: int) -> OutputSeries:
    """What is compared of the response of one recording."""
    stacks, joints = portion.stacks, run.left.shape[2]
    forces = at_once(lambda s: own_forces(s.placed, run.linear.motion, run.left), stacks)
    if portion.own is not None:
        (stack,), (own,) = stacks, forces
        return _at_own_joints(stack, own, portion.own[recording], run.batch)

    def through(place: Place, values: Sequence[Any]) -> np.ndarray:
        wide = [_at_all_joints(s, x, joints) for s, x in zip(stacks, values, strict=True)]
        return np.asarray(respond(run.linear, place, np.concatenate(wide, axis=-1)))

    table = through(portion.place, [f.push for f in forces])
    if portion.reading:
        table = table + through("noise", [f.noise for f in forces])
        table = table + through("rate", [f.rate for f in forces])
    numbers = np.concatenate([s.columns.ravel() for s in stacks])
    return OutputSeries.of(at_samples(run.batch, table), numbers)


def _at_own_joints(
    stack: Stack,
    forces: OwnForces,
    own: Float[np.ndarray, "points 2 joints"],
    batch: Batch,
) -> OutputSeries:
    """The response where each output depends on the torque at its own joint, at the same time."""
    push, joint = np.asarray(forces.push)[0], np.asarray(stack.placed.own)
    here, then = (own[:, end][:, joint][..., None].astype(push.dtype) for end in range(2))
    shown = here * push
    shown[:-1] += then[:-1] * push[1:]
    shown[-1] += then[-1] * push[-1]
    output = np.broadcast_to(joint[..., None], push.shape[1:]).ravel()
    column = np.broadcast_to(stack.columns[:, None], push.shape[1:]).ravel()
    shown = shown.reshape(1, len(shown), len(output))
    return OutputSeries(series_at_samples(batch, output, shown), output, column)


def _at_all_joints(
    stack: Stack, forces: Float[Any, "one points effects own columns"], joints: int
) -> Float[np.ndarray, "one points joints _"]:
    """Forces on all joints of the arm, which are zero on others than the effects' own."""
    own, joint = np.asarray(forces), np.asarray(stack.placed.own)
    one, points, effects, _, width = own.shape
    found = np.zeros((one, points, joints, effects, width), own.dtype)
    found[:, :, joint, np.arange(effects)[:, None]] = own
    return found.reshape(one, points, joints, effects * width)


def _portions(linear: Linearised, stacks: Sequence[Stack]) -> list[_Portion]:
    """Stacks, divided so that a portion has few forces; at least one effect each."""
    groups: dict[tuple[Place, bool], list[Stack]] = {}
    for stack in stacks:
        effect = stack.placed.effect
        place = "pull" if effect.on_link and "pull" in linear.places else "push"
        groups.setdefault((place, misreads(effect)), []).append(stack)
    points, joints = linear.motion.q.shape[1:]
    portions = []
    for (place, reading), group in groups.items():
        own = None if reading else _own_response(linear, place)
        if own is None:
            divided = _divided(group, lambda s: points * joints * s.columns.shape[1])
        else:
            alone = [
                _divided([s], lambda s: points * s.placed.own.shape[1] * s.columns.shape[1])
                for s in group
            ]
            divided = [parts for found in alone for parts in found]
        portions += [_Portion(tuple(parts), place, reading, own) for parts in divided]
    return portions


def _own_response(
    linear: Linearised, place: Place
) -> Float[np.ndarray, "recordings points 2 joints"] | None:
    """Response of each output to its own joint; None if it depends on others or on the past."""
    d = np.asarray(linear.D[..., linear.inputs(place)])
    outputs = d.shape[2]
    both = d.reshape(*d.shape[:3], 2, outputs)
    other = ~np.eye(outputs, dtype=bool)
    if not linear.direct or np.moveaxis(both, 3, 2)[..., other].any():
        return None
    return np.diagonal(both, axis1=2, axis2=4)


def _divided(stacks: Sequence[Stack], size: Any) -> list[list[Stack]]:
    """Portions of stacks with at most `_ROOM` forces.

    **Arguments:**

    - `size`: number of forces of an effect of a stack.
    """
    found: list[list[Stack]] = [[]]
    room = _ROOM
    for stack in stacks:
        count, first = len(stack.columns), 0
        while first < count:
            fits = room // size(stack)
            if fits < 1 and found[-1]:
                found.append([])
                room = _ROOM
                continue
            last = min(count, first + max(1, fits))
            found[-1].append(stack.some(slice(first, last)))
            room, first = room - size(stack) * (last - first), last
    return found
