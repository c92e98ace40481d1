"""Compared signals, windows of recordings, and start weights."""

from collections.abc import Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ..control import OpenLoop
from ..errors import FitError
from ..recording import Recording, Recordings
from ..simulation.batch import Batch, at_rest
from ..simulation.loop import ClosedLoop

Output = Literal["torque", "position", "both"]


@runtime_checkable
class OutputErrorSettings(Protocol):
    """Settings of all methods that minimise a simulation's error; see `OEM`."""

    output: Output | None
    initial: Literal["auto", "rest", "free"]
    window: float | None
    tolerance: float
    max_steps: int
    solver: Any
    mesh: Mesh | None


def pieces_of(recordings: Recordings, window: float | None) -> tuple[Recording, ...]:
    """The recordings cut into windows that share their end samples; unchanged if None."""
    if window is None:
        return tuple(recordings)
    pieces = []
    for r in recordings:
        step = round(window * r.rate)
        if step < 8:
            raise FitError(
                f"a window of {window:g} s is only {step} samples of {r.name}: make it longer"
            )
        for first in range(0, r.samples - 2, step):
            last = min(first + step, r.samples - 1)
            if last - first >= 8:
                end = r.time[last + 1] if last + 1 < r.samples else None
                pieces.append(r.slice(float(r.time[first]), end if end is None else float(end)))
    if not pieces:
        raise FitError(f"a window of {window:g} s is shorter than a few samples: make it longer")
    return tuple(pieces)


def rejoined(recordings, pieces, measured, errors):
    """Windows joined again by recording; shared samples are kept once."""
    if len(pieces) == len(recordings):
        return measured, errors

    def together(values, name):
        own = [x for x, piece in zip(values, pieces, strict=True) if piece.name == name]
        return np.concatenate([own[0], *(x[1:] for x in own[1:])])

    return [[together(values, r.name) for r in recordings] for values in (measured, errors)]


def compared_signals(method: OutputErrorSettings, loop: ClosedLoop) -> tuple[str, ...]:
    """The outputs of a method, of `"tau"` and `"q"`.

    **Raises:** `FitError` if the recorded torque drives the loop and is to be compared.
    """
    output = method.output or loop.controller.judged
    if output != "position" and isinstance(loop.controller, OpenLoop):
        raise FitError(
            "the recorded torque is the input of this loop and cannot be compared: use "
            "OEM(output='position')"
        )
    return {"torque": ("tau",), "position": ("q",), "both": ("tau", "q")}[output]


def estimated_starts(
    method: OutputErrorSettings, pieces: Sequence[Recording], batch: Batch
) -> Float[np.ndarray, " recordings"]:
    """One for pieces whose initial state is estimated, else zero."""
    if method.initial == "rest" or (method.initial == "auto" and batch.band is not None):
        return np.zeros(len(pieces))
    if method.initial == "free" or method.window is not None:
        return np.ones(len(pieces))
    return np.array([0.0 if at_rest(piece) else 1.0 for piece in pieces])


def first_weights(
    loop: ClosedLoop, pieces: Sequence[Recording], signals: tuple[str, ...]
) -> Float[np.ndarray, " outputs"]:
    """Inverse of a tenth of each output's size, the start weights before residuals are known."""
    sizes = []
    for signal in signals:
        values = np.concatenate([getattr(piece, signal) for piece in pieces])
        sizes.append(np.std(values, axis=0))
    size = np.concatenate(sizes)
    return 10 / np.where(size > 0, size, 1.0)
