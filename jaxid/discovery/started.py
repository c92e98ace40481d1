"""How a search begins: the starting model in its loop, or along the recorded motion."""

import dataclasses
from collections.abc import Sequence

from ..effects import AbstractEffect
from ..estimate import Fit
from ..estimate.mistakes import doubtful_law
from ..simulation.loop import ClosedLoop
from .alongside import (
    DELAYS,
    late_drives,
    sampled,
    simulated_continuously,
    slow_or_wrong,
    without_law,
)
from .diagnosis import Diagnosis
from .examined import Examined
from .explore import key_of
from .landscape import forms_of
from .models import Model
from .ranking import Screened, judge
from .screening import carried, screen


class Started(Examined):
    """The start of a search, and its new start if the law is refuted later.

    **Arguments:** those of `Examined`.
    """

    # The starting model.
    given: ClosedLoop
    # Why the law is doubtful; empty if it is not.
    refuted: str = ""
    # Why the search went on along the recorded motion; empty if it did not.
    why: str = ""
    # Linear system and diagnosis of the current fit, until a prediction has used them.
    latest: tuple[Screened, Diagnosis] | None = None

    def start(self, loop: ClosedLoop) -> Model:
        """The starting model, fitted with noise filters."""
        self.given = loop
        self.watched.begin("fit", "fit of the starting model")
        first = self.fits.start(loop)
        self.refuted = doubtful_law(first)
        first = self._along(first, slow_or_wrong(first, self.refuted))
        screened, diagnosis = self.screened(first, ())
        again = self._along(first, "" if first.mistake else sampled(diagnosis, screened))
        if again is not first:
            first, self.forms = again, 0
            screened, diagnosis = self.screened(first, ())
        if first.mistake:
            # Effects would only approximate the mistake.
            return self.visit((), first)
        return self.visit((), self._filtered(first, screened, diagnosis))

    def _filtered(self, first: Fit, screened: Screened, diagnosis: Diagnosis) -> Fit:
        """The fit of the starting model with noise filters."""
        # If noise is strongly coloured, plain output error is imprecise. A filter that is estimated
        # from the residual itself would model a missing effect as noise, so that of the diagnosis
        # is used.
        self.watched.begin("fit", "fit of the starting model with noise filters")
        again = self.fits.start_filtered(first, diagnosis.noise)
        again = dataclasses.replace(again, notes=(*first.notes, *again.notes))
        fit = again if again.succeeded else first
        if fit is first:
            self.latest = screened, diagnosis
        else:
            self.latest = self.screened(fit, (), carried(screened, first, fit))
        return fit

    def restarted(self, at: Model) -> Model | None:
        """The starting model along the recorded motion if added effects refute the law, else None.

        Models that were compared in the simulated loop are forgotten.
        """
        start = self.visited.fitted(())
        assert start is not None
        assert start.fit is not None
        why = late_drives(self.given, at.effects, self.asked.recordings.common_period())
        why = why or self._late_beside(at)
        first = self._along(start.fit, why)
        if first is start.fit:
            return None
        self.forms, self.fits = 0, self.fits.renamed("along the recorded motion, ")
        fit = self._filtered(first, *self.screened(first, ()))
        self.forget()
        self.note(self.why)
        return self.visit((), fit)

    def _late_beside(self, at: Model) -> str:
        """Why the law seems to be sampled beside the added effects; empty if it does not.

        A missing effect can hide that all drives are late. The search then adds the delay of one
        drive with the effect, and further effects for what the other drives lack. So the delays are
        estimated again beside the added effects, without those of a drive.
        """
        others = tuple(e for e in at.effects if not isinstance(e, DELAYS))
        known = len(others) in (0, len(at.effects))
        if known or self.given.joints == 1 or not simulated_continuously(self.given):
            return ""
        less = self.had(at, others) or self.refitted(at, others)
        assert less.fit is not None
        if not less.fit.status.simulated:
            return ""
        screened, diagnosis = self.screened(less.fit, others)
        return sampled(diagnosis, screened)

    def _along(self, first: Fit, why: str) -> Fit:
        """The fit of the starting model along the recorded motion if there is a reason for it."""
        along = without_law(first.loop)
        if not why or along is first.loop:
            return first
        self.why = f"{why} sets of effects are compared along the recorded motion, without the law"
        self.note(self.why)
        self.given = dataclasses.replace(self.given, controller=along.controller)
        return self.fits.start(self.given, "start along the recorded motion")

    def screened(
        self, fit: Fit, effects: Sequence[AbstractEffect], known: Screened | None = None
    ) -> tuple[Screened, Diagnosis]:
        """The linear system at a fit with its signatures, and the diagnosis, which is stored."""
        self.watched.begin("screen", "where the model fails")
        screened = known or screen(fit, self.asked.catalogue, self.watched.say)
        diagnosis = judge(fit, screened, self.asked.significance, self.watched.say)
        self.forms = max(self.forms, forms_of(screened.hypotheses))
        self.diagnoses[key_of(effects)] = diagnosis.light()
        return screened, diagnosis
