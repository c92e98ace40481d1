"""The full fits of a search, saved under names that identify their models."""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence

import numpy as np

from ..effects import AbstractEffect
from ..estimate import Fit
from ..noise import ARFilter
from ..simulation.loop import ClosedLoop
from ..storage.campaign import Campaign
from .diagnosis import over_recordings
from .models import piece_name
from .release import Release
from .verify import Refits

# Largest number of steps of a fit that only shows whether an effect explains something. One whose
# values are not determined takes all steps of a usual fit.
_FEW_STEPS = 25


class Fits:
    """Fits of models of one search, each read from a folder if it was saved.

    **Arguments:**

    - `refits`: recordings and method. `campaign`: saved steps. `prefix`: of their names.
    """

    def __init__(self, refits: Refits, campaign: Campaign, prefix: str = "") -> None:
        self._refits, self._campaign, self._prefix = refits, campaign, prefix

    def renamed(self, prefix: str) -> "Fits":
        """The same for further fits whose names begin with another prefix, too."""
        return Fits(self._refits, self._campaign, f"{self._prefix}{prefix}")

    def start(self, loop: ClosedLoop, name: str = "start") -> Fit:
        """The fit of the starting model.

        A recording along which it diverges is left out from here on.

        **Arguments:**

        - `name`: under which it is saved.
        """
        first = self._campaign.piece(f"{self._prefix}{name}", lambda: self._refits.first(loop))
        error = over_recordings(first.error_percent.to_numpy()) if first.status.simulated else None
        self._refits = dataclasses.replace(self._refits, recordings=first.recordings, before=error)
        return first

    def start_filtered(self, first: Fit, noise: Sequence[ARFilter]) -> Fit:
        """The fit of the starting model with noise filters."""
        return self._campaign.piece(
            f"{self._prefix}start, filtered", lambda: self._refits.filtered(first.loop, noise)
        )

    def with_released(
        self, effects: Sequence[AbstractEffect], release: Release, noise: Sequence[ARFilter]
    ) -> Fit:
        """The fit of a model with released values.

        **Arguments:**

        - `effects`: its effects over the starting model.
        """
        loop = release.loop
        name = f"{piece_name(effects)}, {release.said}"
        return self._saved(name, loop, lambda: self._refits.filtered(loop, noise))

    def with_shapes(
        self, effects: Sequence[AbstractEffect], start: ClosedLoop, noise: Sequence[ARFilter]
    ) -> Fit:
        """The fit of a model whose effects' shapes are free, from the values of a loop.

        **Arguments:**

        - `effects`: its effects over the starting model.
        """
        free = [p for p in start.free_parameters if not p.declaration.free]
        at = ", ".join(f"{p.name} {float(p.where(start)):.6g}" for p in free)
        name = f"{piece_name(effects)}, from {at}"
        return self._saved(name, start, lambda: self._refits.filtered(start, noise))

    def without_parts(
        self, effects: Sequence[AbstractEffect], start: ClosedLoop, noise: Sequence[ARFilter]
    ) -> Fit:
        """The fit of a model with held parts, from the values of a loop.

        **Arguments:**

        - `effects`: its effects over the starting model.
        """
        name = f"{piece_name(effects)}, without parts"
        return self._saved(name, start, lambda: self._refits.filtered(start, noise))

    def with_effects(
        self,
        before: Fit,
        had: Sequence[AbstractEffect],
        more: Sequence[AbstractEffect],
        noise: Sequence[ARFilter],
        promised: float,
    ) -> Fit:
        """The best refit of a fitted model with additional effects.

        **Arguments:**

        - `had`: effects of the fitted model over the starting model. `more`: additional ones.
        - `promised`: predicted decrease of the score.
        """
        return self._saved(
            piece_name((*had, *more)),
            before.loop,
            lambda: self._refits.with_effects(before, more, noise, promised),
        )

    def first_with(
        self,
        before: Fit,
        had: Sequence[AbstractEffect],
        effect: AbstractEffect,
        noise: Sequence[ARFilter],
    ) -> Fit:
        """The fit of a model with an additional effect from one start, assuming white noise.

        It ends after a few steps, converged or not.

        **Arguments:** those of `with_effects`.
        """
        name, method = f"{piece_name((*had, effect))}, first", self._refits.method
        few = dataclasses.replace(method, max_steps=min(method.max_steps, _FEW_STEPS))
        refits = dataclasses.replace(self._refits, method=few)
        return self._saved(name, before.loop, lambda: refits.with_one(before.loop, effect, noise))

    def exchanged(
        self,
        loop: ClosedLoop,
        had: Sequence[AbstractEffect],
        effects: Sequence[AbstractEffect],
        noise: Sequence[ARFilter],
    ) -> Fit:
        """The fit of a model with other effects, from their current values.

        If some of the effects are new, the better one of two fits, of which one starts from a fit
        without filters.

        **Arguments:**

        - `had`: effects of the loop over the starting model. `effects`: those in their place.
        """
        kept = [e for e in loop.effects if not any(e is x for x in had)]
        assert len(kept) == len(loop.effects) - len(had)
        start, refits = loop.with_effects((*kept, *effects)), self._refits
        new = not all(any(e is x for x in had) for e in effects)

        def better() -> Fit:
            plain = [refits.unfiltered(start, noise).loop] if new else []
            return refits.best([refits.filtered(x, noise) for x in (start, *plain)])

        # The same effects may be fitted again, from the values of another model.
        values = " ".join(f"{x:.6g}" for x in np.asarray(start.theta))
        mark = hashlib.sha256(values.encode()).hexdigest()[:12]
        name = f"{piece_name(effects)}, {'instead' if new else 'alone'}, from {mark}"
        return self._saved(name, loop, better)

    def _saved(self, name: str, loop: ClosedLoop, work: Callable[[], Fit]) -> Fit:
        """A fit under a name that contains the released and the held values of its loop.

        **Arguments:**

        - `loop`: the loop before the fit.
        """
        parts = [f"{x} free" for x in sorted(released_names(loop))]
        parts += [f"{x} held" for x in sorted(loop.held_names)]
        return self._campaign.piece(", ".join([f"{self._prefix}{name}", *parts]), work)


def released_names(loop: ClosedLoop) -> set[str]:
    """Names of free parameters that are held by declaration."""
    return {p.name for p in loop.free_parameters if not p.declaration.free}
