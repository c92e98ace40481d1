"""Sets of effects fitted as full nonlinear models."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np

from ..effects import AbstractEffect, AbstractTransmission, Coulomb
from ..estimate import OEM, Fit, SeparablePEM, Status, fit
from ..noise import ARFilter
from ..parameters import Bounds, read_values, write_values
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from .hypotheses import free_of
from .likelihood import score_of

# How much too wide a gap is from which a refit begins: where a link flies longest, all that its
# contact has shows.
_WIDE = 10.0
# How many times what it saves an effect must explain, for no refit without it to be tried.
_CERTAIN = 3.0
# Gains that are so many times what was promised, or so many times less, are far from it.
_FAR = 2.0


class Refits(eqx.Module):
    """Refits on the same recordings by the same method, judged by the same score."""

    recordings: Recordings
    method: OEM

    def first(self, loop: ClosedLoop) -> Fit:
        """The fit of the starting model."""
        return fit(loop, self.recordings, quiet(self.method))

    def filtered(self, loop: ClosedLoop, noise: Sequence[ARFilter]) -> Fit:
        """A fit from where the loop is, efficient where noise is coloured."""
        method = SeparablePEM(self.given(), filters=tuple(noise))
        return fit(loop, self.recordings, method)

    def given(self) -> OEM:
        """The output error to refit with, from where the loop is."""
        return dataclasses.replace(quiet(self.method), start="given")

    def with_effects(
        self,
        before: Fit,
        effects: Sequence[AbstractEffect],
        noise: Sequence[ARFilter],
        promised: float = 0.0,
    ) -> Fit:
        """The best refit of a fitted model with more effects in it, from several starts if need be.

        Effects that part drive and link are far from what the linear system knows: noise filters
        may bar the way to the minimum, so one refit begins without; and a contact whose stiffness
        is held at a wrong value has many minima, so others begin with it free. What gains far from
        what was promised is refitted from where white noise would have it as well.

        **Arguments:**

        - `promised`: how much the score should fall.
        """
        loop = of_one_sign(before.loop.add(*map(_inside, effects)))
        starts = [loop]
        held: tuple[str, ...] = ()
        if any(e.finite for e in effects):
            starts.append(self.unfiltered(loop, noise).loop)
            held = held_shapes(loop, len(effects))
        if any(e.contact for e in effects):
            for factor in (1.0, _WIDE):
                scaled = [_inside(e.scaled(factor)) if e.contact else _inside(e) for e in effects]
                apart = of_one_sign(before.loop.add(*scaled)).free(*held)
                tried = self.unfiltered(apart, noise)
                if tried.status.simulated and tried.status is not Status.misfit:
                    starts.append(tried.loop)
        found = [self.filtered(start, noise) for start in starts]
        best = self.best(found)
        gained = score_of(before).value - score_of(best).value
        if len(starts) == 1 and not promised / _FAR < gained < promised * _FAR:
            best = self.best([best, self.filtered(self.unfiltered(loop, noise).loop, noise)])
        loose = [name for name in held if name not in best.loop.names]
        if loose:
            best = self.best([best, self.filtered(best.loop.free(*loose), noise)])
        return best

    def unfiltered(self, loop: ClosedLoop, noise: Sequence[ARFilter]) -> Fit:
        """The loop fitted as if noise were white: filters that knew nothing of an effect bar it.

        Output error, by the program that filters need anyway.
        """
        return self.filtered(loop, [ARFilter(np.zeros(0), f.variance * f.gain) for f in noise])

    def best(self, found: Sequence[Fit]) -> Fit:
        """The likeliest of several fits of one set of effects."""
        return min(found, key=lambda f: score_of(f).value)


def quiet(method: OEM) -> OEM:
    """The method without its lines of progress."""
    return dataclasses.replace(method, progress=False)


def held_shapes(loop: ClosedLoop, last: int) -> tuple[str, ...]:
    """Names of the last transmissions' parameters that no fit estimates unless told to.

    **Arguments:**

    - `last`: how many effects.
    """
    first = len(loop.effects) - last
    return tuple(
        p.name
        for p in loop.parameters
        if p.place[0] == "effects"
        and int(p.place[1]) >= first
        and isinstance(loop.effects[int(p.place[1])], AbstractTransmission)
        and not p.declaration.free
    )


def of_one_sign(loop: ClosedLoop) -> ClosedLoop:
    """The loop with one smoothed sign per joint, where that of its Coulomb friction is estimated.

    Effects are added with the smoothing it had then, which may come out another beside them.
    """
    estimated, held = {}, []
    for p in loop.parameters:
        if p.place[0] != "effects" or p.place[2:] != ("smoothing",):
            continue
        effect: Any = loop.effects[int(p.place[1])]
        if isinstance(effect, Coulomb) and p.name in loop.names:
            estimated[effect.joint] = float(effect.smoothing)
        elif p.name not in loop.names:
            held.append((p.name, getattr(effect, "joint", None)))
    return loop.with_values(**{name: estimated[j] for name, j in held if j in estimated})


def _inside(effect: AbstractEffect) -> AbstractEffect:
    """The effect with parameters that are on their bounds or beyond moved just inside."""
    chosen = free_of(effect)
    if not chosen:
        return effect
    values = Bounds.of(chosen).moved_inside(read_values(effect, chosen))
    return write_values(effect, chosen, values)


def needed(fit: Fit, effect: AbstractEffect, price: float) -> bool:
    """Whether amplitudes are so far from nothing that no refit without the effect can be better.

    **Arguments:**

    - `price`: what the search for effects costs in all.
    """
    place = next(k for k, e in enumerate(fit.loop.effects) if e is effect)
    at, own, count = 0, [], 0
    for p in fit.loop.free_parameters:
        if p.place[0] == "effects" and int(p.place[1]) == place:
            count += p.size
            own += range(at, at + p.size) if p.declaration.linear else []
        at += p.size
    covariance = fit.covariance[np.ix_(own, own)]
    if effect.finite or not own or not np.isfinite(covariance).all():
        return False
    values = fit.theta[own]
    # The squared error that would be left more (Wald), against what would be saved.
    lost = float(values @ np.linalg.pinv(covariance) @ values)
    saved = count * np.log(sum(r.size for r in fit.residuals)) + price
    return bool(lost > _CERTAIN * saved)


def is_there(found: Fit, before: Fit) -> bool:
    """Whether anything of the effects that a refit has added shows in the recordings."""
    new = [k for k, name in enumerate(found.names) if name not in before.names]
    return not new or bool(np.isfinite(found.std[new]).any())
