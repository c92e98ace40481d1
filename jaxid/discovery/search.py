"""The search for missing effects: prediction in the linear system, verification by full fits."""

from collections import Counter
from collections.abc import Sequence
from itertools import islice

import numpy as np

from ..errors import FitError, ModelError
from ..estimate import Fit
from ..noise import ARFilter
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from .diagnosis import over_recordings, share_left
from .explore import DECISIVE, Candidate, explore, key_of, largest_first
from .landscape import Landscape
from .last_tries import ATTEMPTS
from .likelihood import price
from .loose import undetermined, with_fewer, without_loose
from .models import LIKELY, Model, Named, listed
from .predict import Predictor
from .release import released
from .relevance import loses, matches_curve, matters
from .started import Started
from .support import unsupported
from .system import System
from .verdict import Outcome
from .verify import needed
from .watched import ROUND

# Largest number of sets that are refitted in one round, and the relative error of predicted
# decreases of the score.
_VERIFIED, _INEXACT = 3, 0.08
# Largest number of predicted sets among which those are searched.
_EXAMINED = 12
# Largest number of effects in a predicted set. What sets of two explain is predicted to a few per
# cent; larger sets are searched from the next fit.
_AHEAD = 2


class Search(Started):
    """A search, with the examined models and the current one.

    **Arguments:** those of `Examined`.
    """

    # Effects that were added and later removed.
    removed: tuple[Named, ...] = ()
    # Sets of the last prediction of which an effect does not explain stretches that were left out.
    without_support: frozenset[tuple] = frozenset()
    # Those of which a fit determines no value of an effect, or finds values of another effect.
    loose: frozenset[tuple] = frozenset()
    # The model before the last release, its linear system, and the sets that were predicted there.
    unreleased: tuple[Model, tuple[Fit, Predictor], Sequence[Candidate], float] | None = None

    def run(self, loop: ClosedLoop) -> tuple[Outcome, bool]:
        """Predicts and verifies in rounds, until no model has a lower score.

        **Returns:** the verdict before the tests of the final model, and whether `most` stopped the
        search although a better set was predicted.
        """
        at = self.start(loop)
        assert at.fit is not None
        if at.fit.mistake:
            self.at = at
            return "undetermined", False
        while True:
            candidates, nothing = self._predicted(at)
            better = self._instead_of_release(at, candidates, nothing)
            if better is None:
                better = self._released(at, candidates, nothing)
            if better is None:
                better = self._verified(at, candidates, nothing)
            if better is None and (better := self._without_one(at)) is not None:
                gone = [n for n in at.names if n not in better.names]
                self.removed = (*self.removed, *gone)
            for attempt in ATTEMPTS:
                better = attempt(self, at) if better is None else better
            if better is None:
                break
            at = better
            if (again := self.restarted(at)) is not None:
                at, self.removed = again, ()
        self.at = at
        outcome = self._verdict(candidates, nothing)
        if self.at.key not in self.diagnoses:
            # A model of an earlier round, from which the search did not continue.
            assert self.at.fit is not None
            self.screened(self.at.fit, self.at.effects)
        return outcome

    def stopped(self) -> bool:
        """Selects the best fitted model as the final one; False if there is none."""
        fitted = self.visited.ranked(lambda m: m.fit is not None)
        if fitted:
            self.at = fitted[0]
        return bool(fitted)

    def _predicted(self, at: Model) -> tuple[list[Candidate], float]:
        """Sets of additional effects, best first, and the score of the empty set."""
        assert at.fit is not None
        # The tables are large, so only those of the starting model are stored.
        screened, diagnosis = self.latest or self.screened(at.fit, at.effects)
        self.latest = None
        landscape = Landscape.of(screened, diagnosis)
        # At the limit `most` one more effect is searched, to report whether a better set exists.
        left = min(max(self.asked.most - len(at.effects), 1), _AHEAD)
        self.watched.begin("look", "sets of effects in the linear system")
        candidates = explore(landscape, left, self.watched.say)
        self.seen = at.fit, landscape.predictor
        plain = next(c for c in candidates if not c.effects and c.curve is None)
        worth = self.asked.worth
        kept = [
            c
            for c in candidates
            if c is plain or (not self.small.intersection(c.key) and matters(at, c, plain, worth))
        ]
        return kept, plain.score

    def _released(self, at: Model, candidates: Sequence[Candidate], nothing: float) -> Model | None:
        """The model with released values, if that lowers its score; otherwise None.

        Released values are tried before effects. If a law is simulated, each release compiles a
        program, so a single effect that explains more is tried first. Along an imposed motion,
        values are released until none explains its price, before signatures are computed again.
        """
        fit, predictor = self.seen
        along, noise = imposed(fit.loop), candidates[0].noise
        single = [c.score for c in candidates if c.size == 1]
        effect = 0.0 if along else max(nothing - min(single, default=np.inf), 0.0)
        found = at
        while (better := self._release(found, predictor, noise, effect)) is not None:
            found = better
            if not along:
                break
            assert found.fit is not None
            predictor = Predictor.of(System.of(found.fit), noise, predictor.data.level)
        if found is at:
            return None
        self.unreleased = (at, self.seen, candidates, nothing) if along else None
        return found

    def _instead_of_release(
        self, at: Model, candidates: Sequence[Candidate], nothing: float
    ) -> Model | None:
        """The fit of a set of effects that the last release hides, if it is better.

        Free values of a sign can absorb most of a friction that the model lacks. The friction then
        explains little beside them, although it explains more in their place. Along an imposed
        motion, where values are released before effects are added, the set is therefore fitted to
        the model before the release if it was predicted to be better there than it is now.
        """
        had, self.unreleased = self.unreleased, None
        if had is None:
            return None
        before, seen, sets, unchanged = had
        plain = [c for c in sets if c.effects and c.curve is None and c.score < unchanged]
        best = _hidden(plain, before.score - unchanged, candidates, at.score - nothing)
        if best is None:
            return None
        now, self.seen = self.seen, seen
        found = None
        if self._supported(best):
            found = self._fitted(before, best, plain, unchanged - best.score)
        self.seen = now
        return found if found is not None and found.score < at.score - DECISIVE else None

    def _release(
        self, at: Model, predictor: Predictor, noise: Sequence[ARFilter], effect: float
    ) -> Model | None:
        """The model with the values free that explain most, if that lowers its score.

        **Arguments:**

        - `predictor`: the linear system of the model. `noise`: the filters of the fit.
        - `effect`: decrease of the score by the best single effect.
        """
        value = np.log(predictor.data.compared.sum())
        release = released(predictor, value + DECISIVE)
        if release is None or release.gain < effect:
            return None
        self.watched.begin("fit", f"fit with {release.said}", ROUND)
        found = self.fits.with_released(at.effects, release, noise)
        if not found.status.simulated or self.not_genuine(found):
            return None
        model = self.judged(self.added(found), found)
        least = DECISIVE if release.again else max(effect - DECISIVE, 0.0)
        if model.score > at.score - least:
            return None
        self.visited.add(model)
        return model

    def _verified(self, at: Model, candidates: Sequence[Candidate], nothing: float) -> Model | None:
        """The best refit of the best predicted sets; None if none is better than the model."""
        plain = [c for c in candidates if c.effects and c.curve is None and c.score < nothing]
        full = len(at.effects) >= self.asked.most
        self.without_support = self.loose = frozenset()
        found = [] if full else self._best_fitted(at, plain, nothing)
        # Effects that explain much less than one curve only approximate the curve.
        alone = [c for c in candidates if c.curve is not None and not c.effects]
        curve = min(alone, key=lambda c: c.score, default=None)
        gain = nothing - (np.inf if curve is None else curve.score)
        limit = at.score - max(gain - max(DECISIVE, _INEXACT * gain), LIKELY)
        by_curve = None if curve is None else self._left_by(curve)
        joint = 1 if curve is None or curve.curve is None else curve.curve.joint
        floor = self.diagnoses[at.key].floor_percent()
        better = [
            pair
            for pair in found
            if pair[0].score < limit
            or (
                pair[0].score < at.score - LIKELY
                and matches_curve(at.left, pair[0].left, by_curve, floor, joint)
            )
        ]
        best = min(better, key=lambda pair: pair[0].score, default=None)
        anchor = at.score - nothing if best is None else best[0].score - best[1].score
        # A set without support or without determined values is no rival of the chosen one, nor is
        # one whose effects only approximate others.
        excluded, own = self.without_support | self.loose, self.seen[0].loop.effects
        rivals = [
            c
            for c in candidates
            if key_of(c.effects) not in excluded
            and not self.approximations(c.effects, (*own, *c.effects))
        ]
        self.visited.add_predicted(rivals, at, anchor, self._left_by)
        return None if best is None else best[0]

    def _best_fitted(
        self, at: Model, plain: Sequence[Candidate], nothing: float
    ) -> list[tuple[Model, Candidate]]:
        """Refits of the best supported set, and of those that may be better after a fit.

        If a set cannot be fitted, or if its fit does not converge and is worse than the model
        without it, the next best one is in its place.

        **Arguments:**

        - `plain`: sets without a curve, best first. `nothing`: score of the empty set.
        """
        found: list[tuple[Model, Candidate]] = []
        seen: list[Counter] = []
        reach, failed = np.inf, 0
        for c in islice(plain, _EXAMINED):
            if max(len(found), failed) == _VERIFIED or c.score > reach:
                break
            key = Counter(c.key)
            # A set that contains a better one is left out: the smaller one is fitted first.
            if not any(x < key for x in seen) and self._supported(c):
                model = self._fitted(at, c, plain, nothing - c.score)
                if model is None or _lost(model, at):
                    failed += 1
                    continue
                if not found:
                    reach = c.score + max(DECISIVE, _INEXACT * (nothing - c.score))
                found.append((model, c))
            seen.append(key)
        return found

    def _supported(self, c: Candidate) -> bool:
        """Whether each effect explains left-out stretches; a note names those that do not."""
        fit, predictor = self.seen
        lacking = unsupported(predictor, c) if imposed(fit.loop) else ()
        if lacking:
            self.without_support |= {c.key}
            self.note(
                f"{listed(lacking)}: does not explain stretches that were left out of its estimate"
            )
        return not lacking

    def _fitted(
        self, at: Model, asked: Candidate, examined: Sequence[Candidate], promised: float
    ) -> Model | None:
        """A full refit with those additional effects that it determines; None if it fails."""
        assert at.fit is not None
        more = largest_first(asked.effects, examined)
        if (had := self.had(at, (*at.effects, *more))) is not None:
            return had
        self.watched.begin("fit", f"fit with {listed(more)}", ROUND)
        try:
            fit = self.fits.with_effects(at.fit, at.effects, more, asked.noise, promised)
        except (ModelError, FitError) as error:
            # The candidate cannot be simulated at the predicted values.
            self.note(f"no fit with {listed(more)}: {error}")
            return None
        if not fit.status.simulated:
            return None
        loose = undetermined(fit, len(more))
        if loose:
            self.note(f"{listed(more)}: the fit determines no value of {listed(loose)}")
        else:
            loose = self.not_genuine(fit)
        if not loose:
            return self.visit(self.added(fit), fit)
        self.loose |= {asked.key}
        return with_fewer(self, at, fit, loose)

    def _without_one(self, at: Model) -> Model | None:
        """The model without one of its effects; None if all are needed.

        An effect is removed if the score is not higher by odds of 20 to 1 without it, or if its
        change of the torque is below the smallest relevant change.
        """
        if not at.effects:
            return None
        assert at.fit is not None
        found, size = [], len(at.effects)
        saved = price(size, self.forms) - price(size - 1, self.forms)
        for gone in at.effects:
            if needed(at.fit, gone, saved):
                continue
            less = tuple(e for e in at.effects if e is not gone)
            had = self.had(at, less)
            if had is None or had.score > at.score + LIKELY:
                # An earlier fit may be at another minimum.
                again = self.refitted(at, less)
                had = min(again, had or again, key=lambda m: m.score)
            if had.fit is None or not self.not_genuine(had.fit):
                found.append(had)
        best = min(found, key=lambda m: m.score, default=at)
        if best is not at and best.score < at.score + LIKELY:
            return best
        small = [m for m in found if not loses(m, at, self.asked.worth)]
        best = min(small, key=lambda m: m.score, default=None)
        if best is not None:
            # The removed effect is too small to matter, also in other sets. A prediction that is
            # too large must not add it again.
            self.small |= (Counter(at.key) - Counter(best.key)).keys()
            self.visited.forget(set(at.key) - set(best.key))
        return best

    def _left_by(self, c: Candidate) -> np.ndarray:
        """Relative error by joint of a set that was predicted in the last round, %."""
        fit, predictor = self.seen
        left = share_left(fit, predictor.data, c.rest)
        return over_recordings(fit.error_percent.to_numpy() * left)

    def _verdict(self, candidates: Sequence[Candidate], nothing: float) -> tuple[Outcome, bool]:
        if (less := without_loose(self, self.at)) is not None:
            self.at = less
            return "outside_catalogue", False
        unfinished = len(self.at.effects) >= self.asked.most
        curved = [c for c in candidates if c.curve is not None and c.score < nothing]
        mine = set(self.at.key)
        # Curves with only a part of the effects of this model: if one of them has a lower score,
        # the other effects only approximate the curve. Curves with the same effects are judged by
        # the last round, because earlier predictions of them are less precise.
        rivals = self.visited.ranked(
            lambda m: m.curve is not None and set(key_of(m.effects)) < mine
        )
        if rivals and rivals[0].score < self.at.score - DECISIVE:
            part = self.part(self.at, rivals[0].effects)
            floor = self.diagnoses[self.at.key].floor_percent()
            curve = rivals[0].curve
            assert curve is not None
            if not matches_curve(part.left, self.at.left, rivals[0].left, floor, curve.joint):
                self.at = part
                return "outside_catalogue", False
        # Sets whose effects have no determined value only approximate a curve.
        loose = [Counter(key) for key in self.loose]
        plain = [c for c in candidates if c.curve is None]
        sets = [c for c in plain if not any(x <= Counter(c.key) for x in loose)]
        if curved and curved[0].score <= min(c.score for c in sets):
            return "outside_catalogue", False
        # A further effect counts if it would be added: by odds of 20 to 1, and with support.
        better = [c for c in sets if c.effects and c.score < nothing - LIKELY]
        unfinished = unfinished and any(map(self._supported, better[:_EXAMINED]))
        return ("explained" if self.at.effects else "adequate"), unfinished


def _hidden(
    instead: Sequence[Candidate],
    had: float,
    beside: Sequence[Candidate],
    now: float,
) -> Candidate | None:
    """The best set that is predicted to be better in the place of released values than beside them.

    **Arguments:**

    - `instead`: sets of effects in the model before the release. `beside`: those after it.
    - `had`, `now`: differences between scores of fits and of predictions, before and after it.
    """
    for c in sorted(instead, key=lambda c: c.score):
        key = Counter(c.key)
        parts = [x.score for x in beside if x.curve is None and Counter(x.key) <= key]
        if had + c.score < now + min(parts) - DECISIVE:
            return c
    return None


def _lost(model: Model, at: Model) -> bool:
    """Whether a fit with more effects than another one has not found its minimum."""
    assert model.fit is not None
    return not model.fit.succeeded and model.score > at.score
