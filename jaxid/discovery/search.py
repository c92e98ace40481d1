"""The search for what a model lacks: predict in the linear system, verify by full fits."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..errors import FitError, ModelError
from ..estimate import Fit
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from ..storage.campaign import Campaign
from .asked import Asked
from .diagnosis import Diagnosis, over_recordings, share_left
from .explore import DECISIVE, Candidate, explore, key_of
from .landscape import Landscape, forms_of
from .likelihood import price, score_of
from .models import Model, Named, Visited, listed, piece_name
from .ranking import Screened, judge
from .release import released
from .screening import carried, screen
from .support import unsupported
from .verdict import Outcome
from .verify import Refits, is_there, needed
from .watched import ROUND, Watched

# Sets that are refitted in one round, and the share of what the best gains by which predictions
# are off.
_VERIFIED, _INEXACT = 3, 0.08
# Effects that a fitted model is short of at most: sets of two are predicted to a few per cent of
# what they explain, larger ones are looked for from the next fit.
_AHEAD = 2
# Share of what a model leaves that an effect must explain where the law is unknown: what filters on
# motion and torque, ticks and stiction leave is of that size in the best of recordings.
_BLURRED = 0.25


class Search:
    """A search under way: which models were looked at, and which is the best."""

    def __init__(
        self,
        asked: Asked,
        campaign: Campaign,
        say: Callable[..., None],
        draw: Callable[[Callable[[], Any]], None] = lambda make: None,
    ) -> None:
        self.asked, self.campaign, self.watched = asked, campaign, Watched(say, draw)
        self.refits = Refits(asked.recordings, asked.method)
        self.visited = Visited()
        self.forms = 0
        self.removed: tuple[Named, ...] = ()
        self.failures: tuple[str, ...] = ()
        self.latest: tuple[Screened, Diagnosis] | None = None
        self.diagnoses: dict[tuple, Diagnosis] = {}

    def run(self, loop: ClosedLoop) -> tuple[Outcome, bool]:
        """Rounds of predicting and verifying, until nothing is better; the verdict follows."""
        self.given = loop
        at = self._start(loop)
        while True:
            candidates, nothing = self._predicted(at)
            better = self._released(at, candidates, nothing)
            if better is None:
                better = self._verified(at, candidates, nothing)
            if better is None and (better := self._without_one(at)) is not None:
                gone = [n for n in at.names if n not in better.names]
                self.removed = (*self.removed, *gone)
            if better is None:
                break
            at = better
        self.at = at
        outcome = self._verdict(candidates, nothing)
        if self.at.key not in self.diagnoses:
            # A model of an earlier round, from which the search did not go on.
            assert self.at.fit is not None
            self._screened(self.at.fit, self.at.effects)
        return outcome

    def stopped(self) -> bool:
        """Ends with the best model that was fitted so far; False where there is none."""
        fitted = self.visited.ranked(lambda m: m.fit is not None)
        if fitted:
            self.at = fitted[0]
        return bool(fitted)

    def _start(self, loop: ClosedLoop) -> Model:
        """The starting model, fitted with the noise known."""
        self.watched.begin("fit", "fit of the starting model")
        first = self.campaign.piece("start", lambda: self.refits.first(loop))
        # A recording along which the first fit runs away is left out of all that follows.
        self.refits = dataclasses.replace(self.refits, recordings=first.recordings)
        screened, diagnosis = self._screened(first, ())
        # Where noise is strongly coloured, plain output error leaves the parameters far off. A
        # filter fitted to the residual itself would take what is missing for noise.
        self.watched.begin("fit", "fit of the starting model, with its noise known")
        again = self.campaign.piece(
            "start, filtered", lambda: self.refits.filtered(first.loop, diagnosis.noise)
        )
        again = dataclasses.replace(again, notes=(*first.notes, *again.notes))
        fit = again if again.succeeded else first
        if fit is first:
            self.latest = screened, diagnosis
        else:
            self.latest = self._screened(fit, (), carried(screened, first, fit))
        return self._visit((), fit)

    def _screened(
        self, fit: Fit, effects: Sequence[AbstractEffect], known: Screened | None = None
    ) -> tuple[Screened, Diagnosis]:
        """The linear system at a fit with its signatures, and the diagnosis, which is kept."""
        self.watched.begin("screen", "where the model fails")
        screened = known or screen(fit, self.asked.catalogue, self.watched.say)
        diagnosis = judge(fit, screened, self.asked.significance)
        self.forms = max(self.forms, forms_of(screened.hypotheses))
        self.diagnoses[key_of(effects)] = diagnosis.light()
        return screened, diagnosis

    def _predicted(self, at: Model) -> tuple[list[Candidate], float]:
        """Sets beside a fitted model, best first, and the score of adding nothing."""
        assert at.fit is not None
        # The tables are large, so that those of the starting model alone are there already.
        screened, diagnosis = self.latest or self._screened(at.fit, at.effects)
        self.latest = None
        data = dataclasses.replace(screened.data, level=diagnosis.data.level)
        landscape = Landscape.of(screened.system, data, screened.hypotheses, diagnosis.noise)
        # At the most that was asked, one more is looked for, to say whether something is left.
        left = min(max(self.asked.most - len(at.effects), 1), _AHEAD)
        self.watched.begin("look", "sets of effects in the linear system")
        candidates = explore(landscape, left, self.watched.say)
        self.seen = at.fit, landscape.predictor
        plain = next(c for c in candidates if not c.effects and c.curve is None)
        return [c for c in candidates if c is plain or self._matters(at, c, plain)], plain.score

    def _released(self, at: Model, candidates: Sequence[Candidate], nothing: float) -> Model | None:
        """The model with values estimated that its own effects held, before an effect is believed.

        None where they explain no more than they cost. Where a law is simulated each is a program
        of its own, so there one effect that explains more is tried first.
        """
        fit, predictor = self.seen
        value = np.log(predictor.data.mask.sum() * fit.loop.joints)
        release = released(predictor, value + DECISIVE)
        single = [c.score for c in candidates if c.size == 1]
        effect = 0.0 if imposed(fit.loop) else max(nothing - min(single, default=np.inf), 0.0)
        if release is None or release.gain < effect:
            return None
        self.watched.begin("fit", f"fit with {release.said}", ROUND)
        loop, noise = release.loop, candidates[0].noise
        name = f"{piece_name(at.effects)}, {release.said}"
        found = self.campaign.piece(name, lambda: self.refits.filtered(loop, noise))
        if not found.status.simulated:
            return None
        model = self._judged(self._added(found), found)
        cost = release.freedom * value
        model = dataclasses.replace(model, score=model.score + cost)
        least = DECISIVE if release.again else max(effect - DECISIVE, 0.0)
        if model.score > at.score - least:
            return None
        self.visited.add(model)
        return model

    def _verified(self, at: Model, candidates: Sequence[Candidate], nothing: float) -> Model | None:
        """The best refit of the sets that promise most; None where none is better."""
        plain = [c for c in candidates if c.effects and c.curve is None and c.score < nothing]
        tried: list[Candidate] = []
        if plain and len(at.effects) < self.asked.most:
            reach = max(DECISIVE, _INEXACT * (nothing - plain[0].score))
            near = [c for c in plain if c.score < plain[0].score + reach]
            # What does no better with more is looked at again from the fit with less.
            keys = [Counter(c.key) for c in near]
            tried = [c for k, c in enumerate(near) if not any(x < keys[k] for x in keys[:k])]
            tried = list(islice(filter(self._supported, tried), _VERIFIED))
        # Effects that come close to what one curve says better are no explanation.
        alone = [c.score for c in candidates if c.curve is not None and not c.effects]
        gain = nothing - min(alone, default=np.inf)
        limit = at.score - max(gain - max(DECISIVE, _INEXACT * gain), 0.0)
        found = [(m, c) for c in tried if (m := self._fitted(at, c, nothing - c.score)) is not None]
        better = [pair for pair in found if pair[0].score < limit]
        best = min(better, key=lambda pair: pair[0].score, default=None)
        anchor = at.score - nothing if best is None else best[0].score - best[1].score
        self.visited.add_predicted(candidates, at, anchor, self._left_by)
        return None if best is None else best[0]

    def _supported(self, c: Candidate) -> bool:
        """Whether each effect explains stretches that did not determine it; noted if not."""
        fit, predictor = self.seen
        lacking = unsupported(predictor, c) if imposed(fit.loop) else ()
        if lacking:
            said = f"{listed(lacking)}: explains only the stretches from which it is estimated"
            self.failures = tuple(dict.fromkeys((*self.failures, said)))
        return not lacking

    def _fitted(self, at: Model, asked: Candidate, promised: float) -> Model | None:
        """A set beside a fitted model, fitted in full; None where it does not show."""
        assert at.fit is not None
        before: Fit = at.fit
        together = (*at.effects, *asked.effects)
        had = self.had(at, together)
        if had is not None:
            return had
        self.watched.begin("fit", f"fit with {listed(asked.effects)}", ROUND)
        try:
            fit = self.campaign.piece(
                piece_name(together),
                lambda: self.refits.with_effects(before, asked.effects, asked.noise, promised),
            )
        except (ModelError, FitError) as error:
            # A candidate that cannot be simulated, at values that the linear system liked.
            self.failures = (*self.failures, f"no fit with {listed(asked.effects)}: {error}")
            return None
        if not fit.status.simulated or not is_there(fit, before):
            return None
        return self._visit(self._added(fit), fit)

    def had(self, at: Model, effects: Sequence[AbstractEffect]) -> Model | None:
        """The refit of a set, where values that the start held are free in it as they are here."""
        had = self.visited.fitted(effects)
        if had is None or had.fit is None or at.fit is None:
            return None
        one, other = had.fit.loop, at.fit.loop
        alike = bool(eqx.tree_equal(one.controller, other.controller))
        return had if alike and _released(one) == _released(other) else None

    def _without_one(self, at: Model) -> Model | None:
        """The model without one of its effects, where that is better, or nothing worth knowing."""
        if not at.effects:
            return None
        assert at.fit is not None
        found = []
        for gone in at.effects:
            if needed(at.fit, gone, price(len(at.effects), self.forms)):
                continue
            less = tuple(e for e in at.effects if e is not gone)
            found.append(self.had(at, less) or self.refitted(at, less))
        best = min(found, key=lambda m: m.score, default=at)
        if best.score < at.score:
            return best
        small = [m for m in found if not self._loses(m, at)]
        best = min(small, key=lambda m: m.score, default=None)
        if best is not None:
            # What it had more is not worth knowing, and not a rival in any company.
            self.visited.forget(set(at.key) - set(best.key))
        return best

    def _loses(self, less: Model, at: Model) -> bool:
        """Whether a model with less leaves more of some joint's torque by what is worth knowing."""
        assert less.left is not None
        assert at.left is not None
        lost = np.sqrt(np.maximum(less.left**2 - at.left**2, 0.0))
        return bool(np.any(lost > self._worth(at, at.left)))

    def refitted(self, at: Model, effects: Sequence[AbstractEffect]) -> Model:
        """A part of a fitted model's effects, fitted from where they are."""
        assert at.fit is not None
        loop, noise = at.fit.loop, at.noise
        kept = [e for e in loop.effects if not any(e is x for x in at.effects)]
        self.watched.begin("fit", f"fit with {listed(effects) or 'nothing'} alone")
        fit = self.campaign.piece(
            piece_name(effects),
            lambda: self.refits.filtered(loop.with_effects((*kept, *effects)), noise),
        )
        return self._visit(self._added(fit), fit)

    def _visit(self, effects: tuple[AbstractEffect, ...], fit: Fit) -> Model:
        """A fitted model, noted and drawn."""
        model = self._judged(effects, fit)
        self.visited.add(model)
        self.watched.fitted(model)
        return model

    def _judged(self, effects: tuple[AbstractEffect, ...], fit: Fit) -> Model:
        """A fitted model with its score."""
        judged = score_of(fit, len(effects), self.forms)
        left = over_recordings(fit.error_percent.to_numpy())
        return Model(effects, judged.value, fit=fit, noise=judged.noise, left=left)

    def _added(self, fit: Fit) -> tuple[AbstractEffect, ...]:
        """The effects that a fit has over the starting model; they stand last."""
        start = self.visited.fitted(())
        assert start is not None
        assert start.fit is not None
        return fit.loop.effects[len(start.fit.loop.effects) :]

    def _matters(self, at: Model, c: Candidate, plain: Candidate) -> bool:
        """Whether a set changes what is left of some joint's torque by what is worth knowing."""
        assert at.fit is not None
        if at.fit.error_percent.to_numpy().max() < 1e-3:
            # Recordings without noise: what is left is the integration's.
            return False
        # In units of what the fit leaves, whose relative error is known.
        left = np.linalg.norm(np.concatenate(at.fit.residuals), axis=0)
        changed = np.linalg.norm((c.rest - plain.rest).reshape(-1, c.rest.shape[-1]), axis=0)
        percent = over_recordings(at.fit.error_percent.to_numpy())
        return bool(np.any(changed * percent > self._worth(at, percent) * left))

    def _worth(
        self, at: Model, percent: Float[np.ndarray, " joints"]
    ) -> Float[np.ndarray, " joints"]:
        """Change of a joint's torque that is worth knowing, %.

        **Arguments:**

        - `percent`: what a model leaves of each joint's torque.
        """
        assert at.fit is not None
        least = _BLURRED if imposed(at.fit.loop) else 0.0
        return np.maximum(self.asked.worth, least * percent)

    def _left_by(self, c: Candidate) -> np.ndarray:
        """Relative error by joint that a set predicted in the last round leaves, %."""
        fit, predictor = self.seen
        left = share_left(fit, predictor.data, c.rest)
        return over_recordings(fit.error_percent.to_numpy() * left)

    def _verdict(self, candidates: Sequence[Candidate], nothing: float) -> tuple[Outcome, bool]:
        unfinished = len(self.at.effects) >= self.asked.most
        curved = [c for c in candidates if c.curve is not None and c.score < nothing]
        mine = set(self.at.key)
        # A curve beside fewer effects: those in a row came close to what it says with less. Beside
        # the same effects it makes up for what a prediction misses; the last round knows better.
        rivals = self.visited.ranked(
            lambda m: m.curve is not None and set(key_of(m.effects)) < mine
        )
        if rivals and rivals[0].score < self.at.score - DECISIVE:
            self.at = self.visited.fitted(rivals[0].effects) or self.at
            return "outside_catalogue", False
        if curved and curved[0].score == min(c.score for c in candidates):
            return "outside_catalogue", False
        left = [c for c in candidates if c.effects and c.curve is None and c.score < nothing]
        return ("explained" if self.at.effects else "adequate"), unfinished and bool(left)


def _released(loop: ClosedLoop) -> set[str]:
    """Names of free parameters that are held by declaration."""
    return {p.name for p in loop.free_parameters if not p.declaration.free}
