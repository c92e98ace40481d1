"""Signatures: the change of the closed loop's output that an effect would cause."""

from collections.abc import Callable, Sequence

import numpy as np

from ..effects import AbstractEffect
from ..effects.placed import alike
from ..simulation.batch import Batch
from ..simulation.loop import ClosedLoop
from .finite import differences
from .hypotheses import Hypothesis, amplitudes
from .linear import Linearised, at_samples
from .responses import Stack, responses
from .table import OutputSeries, SignatureTable


def signatures(
    loop: ClosedLoop,
    batch: Batch,
    linear: Linearised,
    proposed: Sequence[tuple[AbstractEffect, float]],
    row: int,
    say: Callable[[str], None],
) -> tuple[list[Hypothesis], SignatureTable]:
    """Hypotheses and the compared part of their signatures, one column per amplitude.

    For effects at the joint, on the command or on the sensor, a signature is the response of the
    linear system. For transmissions and limits it is the difference between a simulation with the
    effect and the nominal one.
    """
    direct = [k for k, (effect, _) in enumerate(proposed) if not effect.finite]
    made: dict[int, Hypothesis] = {}
    series: list[OutputSeries] = []
    stacks, at = [], 0
    for placed, places in alike([proposed[k][0] for k in direct], loop.joints):
        low, high = _amplitude_bounds(proposed[direct[places[0]]][0])
        columns = at + np.arange(len(places) * len(low)).reshape(len(places), len(low))
        for own, place in zip(columns.tolist(), places, strict=True):
            effect, tests = proposed[direct[place]]
            made[direct[place]] = Hypothesis(effect, tuple(own), low, high, tests)
        stacks.append(Stack(placed, columns))
        at += columns.size
    if stacks:
        say(f"{len(direct)} signatures by linear response")
        series += responses(loop, batch, linear, stacks)
    rest = [k for k in range(len(proposed)) if k not in made]
    say(f"{len(rest)} signatures by simulation")
    nominal = linear.seen[:, :, row]
    changes = differences(loop, batch, [proposed[k][0] for k in rest], row, nominal)
    simulated, first = [], at
    for place, change in zip(rest, changes, strict=True):
        effect, tests = proposed[place]
        with np.errstate(over="ignore"):  # a diverging loop is left out
            column = change.astype(np.float32)
        if np.isfinite(column).all():
            simulated.append(column)
            made[place] = Hypothesis(effect, (at,), *_amplitude_bounds(effect), tests)
            at += 1
    if simulated:
        shown = at_samples(batch, np.stack(simulated, axis=-1))
        series.append(OutputSeries.of(shown, np.arange(first, at)))
    table = SignatureTable.of_series(series, loop.joints, at)
    return [made[k] for k in sorted(made)], table


def _amplitude_bounds(effect: AbstractEffect) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bounds of every amplitude; for a finite setting, of its multiple, which is positive."""
    linear = amplitudes(effect)
    if not linear:
        return (0.0,), (np.inf,)
    low = tuple(p.declaration.lower for p in linear for _ in range(p.size))
    return low, tuple(p.declaration.upper for p in linear for _ in range(p.size))
