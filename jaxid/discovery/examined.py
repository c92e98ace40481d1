"""The models that a search has examined, and full fits of further ones."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from ..effects import AbstractEffect
from ..estimate import Fit
from ..storage.campaign import Campaign
from .asked import Asked
from .diagnosis import Diagnosis, over_recordings
from .fits import Fits, released_names
from .landscape import form
from .likelihood import score_of
from .models import Model, Visited, listed
from .offsets import held_offsets
from .predict import Predictor
from .verify import Refits
from .watched import Watched


class Examined:
    """The models that a search has examined, with what is known of them.

    **Arguments:**

    - `asked`: the arguments of the discovery.
    - `campaign`: saved steps.
    - `say`: function that reports an activity. `draw`: function that draws a figure.
    - `prefix`: of the names of saved steps.
    """

    # Fit and linear system of the last prediction.
    seen: tuple[Fit, Predictor]

    def __init__(
        self,
        asked: Asked,
        campaign: Campaign,
        say: Callable[..., None],
        draw: Callable[[Callable[[], Any]], None] = lambda make: None,
        prefix: str = "",
    ) -> None:
        self.asked, self.watched = asked, Watched(say, draw)
        self.fits = Fits(Refits(asked.recordings, asked.method), campaign, prefix)
        self.visited = Visited()
        self.forms = 0
        self.small: set[tuple] = set()
        self.failures: tuple[str, ...] = ()
        self.offsets: dict[str, AbstractEffect] = {}
        self.diagnoses: dict[tuple, Diagnosis] = {}

    def forget(self) -> None:
        """Forgets all models and notes, except the diagnosis of the starting model."""
        self.visited, self.small, self.offsets, self.failures = Visited(), set(), {}, ()
        self.diagnoses = {key: found for key, found in self.diagnoses.items() if not key}

    def note(self, said: str) -> None:
        """Stores a note for the result, once."""
        self.failures = tuple(dict.fromkeys((*self.failures, said)))

    def visit(self, effects: tuple[AbstractEffect, ...], fit: Fit) -> Model:
        """A fitted model with its score, which is stored and drawn.

        A model with an effect that only approximates another one is not stored: it has no weight.
        """
        model = self.judged(effects, fit)
        if not (effects and self.not_genuine(fit)):
            self.visited.add(model)
        self.watched.fitted(model)
        return model

    def judged(self, effects: tuple[AbstractEffect, ...], fit: Fit) -> Model:
        """A fitted model with its score, which is not stored.

        An effect in the place of an offset of the starting model is not a further effect.
        """
        size = max(len(effects) - self._left_out(fit), 0)
        judged = score_of(fit, size, self.forms)
        left = over_recordings(fit.error_percent.to_numpy())
        return Model(effects, judged.value, fit=fit, noise=judged.noise, left=left)

    def _left_out(self, fit: Fit) -> int:
        """The number of offsets of the starting model that a fit leaves out."""
        start = self.visited.fitted(())
        if start is None or start.fit is None:
            return 0
        return len(set(held_offsets(fit.loop)) - set(held_offsets(start.fit.loop)))

    def added(self, fit: Fit) -> tuple[AbstractEffect, ...]:
        """The effects of a fit that the starting model lacks; these are its last effects."""
        start = self.visited.fitted(())
        assert start is not None
        assert start.fit is not None
        return fit.loop.effects[len(start.fit.loop.effects) :]

    def not_genuine(self, fit: Fit) -> tuple[AbstractEffect, ...]:
        """The added effects of a fit that only approximate another effect; a note names them."""
        # The recorded motion is not known before the first diagnosis.
        found = self.approximations(self.added(fit), fit.loop.effects) if self.diagnoses else ()
        if found:
            self.note(f"{listed(found)}: the fitted values are those of another effect")
        return found

    def approximations(
        self, effects: Sequence[AbstractEffect], among: Sequence[AbstractEffect]
    ) -> tuple[AbstractEffect, ...]:
        """Those effects that only approximate another effect, among all effects of their model."""
        # All diagnoses describe the same motion.
        scene = next(iter(self.diagnoses.values())).scene
        return tuple(e for e in effects if not e.genuine(scene, [x for x in among if x is not e]))

    def had(self, at: Model, effects: Sequence[AbstractEffect]) -> Model | None:
        """An earlier refit of a set with the same values released; None if there is none."""
        had = self.visited.fitted(effects)
        if had is None or had.fit is None or at.fit is None:
            return None
        alike = released_names(had.fit.loop) == released_names(at.fit.loop)
        return had if alike else None

    def refitted(self, at: Model, effects: Sequence[AbstractEffect]) -> Model:
        """A fitted model with only some of its effects, fitted again from their current values."""
        assert at.fit is not None
        self.watched.begin("fit", f"fit with {listed(effects) or 'nothing'} alone")
        fit = self.fits.exchanged(at.fit.loop, at.effects, effects, at.noise)
        return self.visit(self.added(fit), fit)

    def part(self, at: Model, effects: Sequence[AbstractEffect]) -> Model:
        """The fit of a part of a model's effects, which may have other values here."""
        fitted = self.visited.fitted(effects)
        if fitted is not None:
            return fitted
        left = Counter(map(form, effects))
        part = []
        for effect in at.effects:
            if left[form(effect)] > 0:
                left[form(effect)] -= 1
                part.append(effect)
        return self.refitted(at, part)
