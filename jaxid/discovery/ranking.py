"""Ranking of hypotheses by the share of the whitened residual that their signatures explain."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import Curve, Scene
from ..errors import FitError
from ..estimate import Fit
from ..noise import ARFilter
from .bounded import within_bounds
from .comparison import Comparison
from .data import Data
from .diagnosis import Diagnosis, Verdict, share_left
from .floor import floor_of
from .hypotheses import Hypothesis
from .likelihood import score
from .linear import at_rows
from .motion_noise import Changes, changes, corrected_by
from .score import Gram, Whitened, chance, corrected, effective_tests
from .separate import columns_of, estimate_noise, leftover
from .system import System

# Largest number of rows from which noise is estimated (a minute of two joints at 400 Hz). More rows
# do not improve the estimate.
_ENOUGH = 50_000

# Largest number of times that noise is separated from the significant hypotheses.
_TURNS = 4
# A hypothesis that explains less than this share after the correction explains mostly noise of the
# recorded motion.
_OWN = 0.5


class Screened(eqx.Module):
    """The linear system of a fit, the hypotheses about it, and their signatures."""

    system: System
    hypotheses: tuple[Hypothesis, ...]
    data: Data
    scene: Scene


def judge(
    fit: Fit | Comparison,
    screened: Screened,
    significance: float,
    say: Callable[[str], None],
) -> Diagnosis:
    """The diagnosis: noise filters are estimated, and the hypotheses are ranked.

    **Raises:** `FitError` if the residual is too large for the computation.
    """
    try:
        return _judged(fit, screened, significance, say)
    except np.linalg.LinAlgError as error:
        raise FitError(
            f"the residual of {fit.loop.name} on these recordings is too large to be analysed: "
            "check the units of the recordings and the loop's gains"
        ) from error


class _Scored(eqx.Module):
    """The products of a problem with its noise filters, and what each hypothesis explains.

    - `chosen`: hypotheses that the noise was separated from.
    - `wider`: variance of each score over that which the products give.
    """

    data: Data
    noise: tuple[ARFilter, ...]
    chosen: list[int]
    white: Whitened
    gram: Gram
    tests: float
    wider: Float[np.ndarray, " hypotheses"]

    @classmethod
    def of(cls, screened: Screened, apart_from: Sequence[int], windows: bool) -> "_Scored":
        """The products, with noise that is separated from some of the hypotheses."""
        data, blocks = screened.data, [h.columns for h in screened.hypotheses]
        some = [blocks[k] for k in apart_from]
        apart = estimate_noise(data.middle(_ENOUGH), some, alike=windows)
        data = dataclasses.replace(data, level=apart.data.level)
        white = Whitened.of(data, apart.noise)
        gram = Gram.of_whitened(white)
        tests = effective_tests(gram, white.noise(), blocks)
        chosen = [apart_from[k] for k in apart.chosen]
        return cls(data, apart.noise, chosen, white, gram, tests, np.ones(len(blocks)))

    def corrected(self, changed: Changes, hypotheses: Sequence[Hypothesis]) -> "_Scored":
        """The same with scores that are corrected for the noise of the recorded motion."""
        found = corrected_by(changed, self.data, self.noise, self.white, self.gram, hypotheses)
        return dataclasses.replace(self, gram=found.gram, wider=found.wider)

    def explained(self, hypotheses: Sequence[Hypothesis]) -> Float[np.ndarray, " hypotheses"]:
        """What each hypothesis explains of the residual."""
        return self.gram.explained([h.columns for h in hypotheses])[0]

    def p_values(self, hypotheses: Sequence[Hypothesis]) -> list[float]:
        """The corrected p-value of each hypothesis."""
        found = zip(*self.gram.explained([h.columns for h in hypotheses]), strict=True)
        return [
            _p_value(h, value / wide, int(freedom), self.tests)
            for h, wide, (value, freedom) in zip(hypotheses, self.wider, found, strict=True)
        ]


def _scored(
    fit: Fit | Comparison, screened: Screened, significance: float, say: Callable[[str], None]
) -> _Scored:
    """The scores, corrected for the noise of the recorded motion if the motion is imposed.

    Signatures with high derivatives of the position explain its noise, and torque noise that is
    separated from them is too small. It is estimated again, separated from those hypotheses only
    that are significant after the correction; first without those that explain mostly noise of the
    motion.
    """
    hypotheses, windows = screened.hypotheses, len(screened.data.residual) != len(fit.recordings)
    every = list(range(len(hypotheses)))
    found = _Scored.of(screened, every, windows)
    p_values, explained = found.p_values(hypotheses), found.explained(hypotheses)
    changed = changes(fit, found.data, hypotheses, p_values, screened.system.row, say)
    if changed is None:
        return found
    found, apart_from = found.corrected(changed, hypotheses), every
    # With noise that is separated from them, these would stay significant.
    noise_of_motion = found.explained(hypotheses) < _OWN * explained
    for turn in range(_TURNS):
        before, p_values = apart_from, found.p_values(hypotheses)
        apart_from = [
            k for k in every if p_values[k] < significance and (turn or not noise_of_motion[k])
        ]
        if apart_from == before:
            break
        found = _Scored.of(screened, apart_from, windows).corrected(changed, hypotheses)
    return found


def _judged(
    fit: Fit | Comparison, screened: Screened, significance: float, say: Callable[[str], None]
) -> Diagnosis:
    hypotheses = list(screened.hypotheses)
    motion = at_rows(screened.system.batch, screened.system.linear.motion)
    blocks = [h.columns for h in hypotheses]
    scored = _scored(fit, screened, significance, say)
    data, noise, gram, tests = scored.data, scored.noise, scored.gram, scored.tests
    ranking: dict[tuple[Any, ...], Verdict] = {}
    forms: dict[tuple[Any, ...], Verdict] = {}
    where: dict[tuple[Any, ...], Verdict] = {}
    found = zip(hypotheses, *gram.explained(blocks), scored.wider, strict=True)
    for hypothesis, explained, freedom, wider in found:
        verdict = _verdict(gram, hypothesis, float(explained), int(freedom), tests, float(wider))
        effect = hypothesis.effect
        if isinstance(effect, Curve):
            where[(effect.label, effect.joint, effect.signed)] = verdict
            continue
        _keep_better(ranking, verdict.key, verdict)
        _keep_better(forms, (*verdict.key, type(effect)), verdict)
    columns = columns_of(blocks, scored.chosen)
    rich = leftover(data, noise, columns)
    absorbed = data.base.shape[-1]
    # Candidates are counted by setting, because shapes are chosen from the grid and not estimated.
    plain = score(data, data.residual, absorbed, 0, len(blocks))
    with_all = score(data, rich, absorbed + len(columns), len(scored.chosen), len(blocks))
    return Diagnosis(
        fit=fit,
        ranking=tuple(sorted(ranking.values(), key=_order, reverse=True)),
        forms=tuple(sorted(forms.values(), key=_order, reverse=True)),
        where=tuple(sorted(where.values(), key=_order, reverse=True)),
        noise=noise,
        data=data,
        gram=gram,
        scene=screened.scene,
        motion=motion,
        floor=_floor(fit, data, rich, len(columns)),
        tests=tests,
        significance=significance,
        unexplained=plain.value - with_all.value,
        measured=floor_of(fit.loop, fit.recordings),
    )


def _keep_better(found: dict[tuple[Any, ...], Verdict], key: tuple[Any, ...], new: Verdict) -> None:
    """Keeps the better of two settings; a physical one is better than one that is not."""
    old = found.get(key)
    if old is None or (new.possible, new.evidence) > (old.possible, old.evidence):
        found[key] = new


def _order(verdict: Verdict) -> float:
    return verdict.evidence


def _p_value(hypothesis: Hypothesis, explained: float, freedom: int, tests: float) -> float:
    return corrected(min(1.0, chance(explained, freedom) * hypothesis.tests), tests)


def _verdict(
    gram: Gram,
    hypothesis: Hypothesis,
    explained: float,
    freedom: int,
    tests: float,
    wider: float = 1.0,
) -> Verdict:
    within = within_bounds(gram, hypothesis)[1] if freedom > 0 else 0.0
    # An impossible hypothesis is ranked by what it would explain without bounds.
    explained = (within or explained) / wider
    p = _p_value(hypothesis, explained, freedom, tests)
    price = freedom * np.log(gram.count) + 2 * np.log(hypothesis.tests)
    return Verdict(
        hypothesis=hypothesis,
        evidence=explained - float(price),
        explained=explained,
        freedom=freedom,
        p_value=p,
        possible=within > 0.0 and math.isfinite(wider),
        wider=wider,
    )


def _floor(
    fit: Fit | Comparison, data: Data, rest: np.ndarray, lost: int
) -> Float[np.ndarray, "recordings joints"]:
    """Relative error due to noise alone, by recording and joint, %.

    Estimated parameters absorb a part of the noise. The result is corrected for this part.
    """
    freedom = 1 - (data.base.shape[-1] + lost) / data.compared.sum()
    # The rich model has the smaller whitened residual. Its residual itself may be the larger one.
    share = np.minimum(share_left(fit, data, rest), 1) / np.sqrt(max(freedom, 0.1))
    return fit.error_percent.to_numpy() * share
