"""Ranking of hypotheses by the share of the whitened residual that their signatures explain."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import Curve, Scene
from ..errors import FitError
from ..estimate import Fit
from .bounded import bounded_amplitudes
from .comparison import Comparison
from .data import Data
from .diagnosis import Diagnosis, Verdict, share_left
from .floor import floor_of
from .hypotheses import Hypothesis
from .likelihood import score
from .linear import at_rows
from .score import Gram, Whitened, chance, corrected, effective_tests
from .separate import columns_of, estimate_noise, leftover
from .system import System

# Largest number of rows from which noise is estimated (a minute of two joints at 400 Hz). More rows
# do not improve the estimate.
_ENOUGH = 50_000


class Screened(eqx.Module):
    """The linear system of a fit, the hypotheses about it, and their signatures."""

    system: System
    hypotheses: tuple[Hypothesis, ...]
    data: Data
    scene: Scene


def judge(fit: Fit | Comparison, screened: Screened, significance: float) -> Diagnosis:
    """The diagnosis: noise filters are estimated, and the hypotheses are ranked.

    **Raises:** `FitError` if the residual is too large for the computation.
    """
    try:
        return _judged(fit, screened, significance)
    except np.linalg.LinAlgError as error:
        raise FitError(
            f"the residual of {fit.loop.name} on these recordings is too large to be analysed: "
            "check the units of the recordings and the loop's gains"
        ) from error


def _judged(fit: Fit | Comparison, screened: Screened, significance: float) -> Diagnosis:
    data, hypotheses = screened.data, list(screened.hypotheses)
    motion = at_rows(screened.system.batch, screened.system.linear.motion)
    blocks = [h.columns for h in hypotheses]
    windows = len(data.residual) != len(fit.recordings)
    apart = estimate_noise(data.middle(_ENOUGH), blocks, alike=windows)
    data, noise = dataclasses.replace(data, level=apart.data.level), apart.noise
    white = Whitened.of(data, noise)
    gram = Gram.of_whitened(white)
    tests = effective_tests(gram, white.noise(), blocks)
    ranking: dict[tuple[Any, ...], Verdict] = {}
    forms: dict[tuple[Any, ...], Verdict] = {}
    where: dict[tuple[Any, ...], Verdict] = {}
    for hypothesis, explained, freedom in zip(hypotheses, *gram.explained(blocks), strict=True):
        verdict = _verdict(gram, hypothesis, float(explained), int(freedom), tests)
        effect = hypothesis.effect
        if isinstance(effect, Curve):
            where[(effect.label, effect.joint, effect.signed)] = verdict
            continue
        _keep_better(ranking, verdict.key, verdict)
        _keep_better(forms, (*verdict.key, type(effect)), verdict)
    columns = columns_of(blocks, apart.chosen)
    rich = leftover(data, noise, columns)
    absorbed = data.base.shape[-1]
    plain = score(data, data.residual, absorbed, 0, len(blocks))
    with_all = score(data, rich, absorbed + len(columns), len(apart.chosen), len(blocks))
    best = tuple(sorted(ranking.values(), key=_order, reverse=True))
    curves = tuple(sorted(where.values(), key=_order, reverse=True))
    return Diagnosis(
        fit=fit,
        ranking=best,
        forms=tuple(sorted(forms.values(), key=_order, reverse=True)),
        where=curves,
        pair=_pair(gram, hypotheses, best, curves, tests),
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


def _pair(
    gram: Gram,
    hypotheses: list[Hypothesis],
    ranking: tuple[Verdict, ...],
    where: tuple[Verdict, ...],
    tests: float,
) -> tuple[Verdict, ...]:
    """Two effects that together explain more than the best curve; empty if there are none.

    Each of the leading entries is combined with every other effect. No pair is searched if one
    effect explains more than the best curve.
    """
    if not where or not ranking or where[0].evidence < ranking[0].evidence:
        return ()
    effects = [h for h in hypotheses if not isinstance(h.effect, Curve)]
    best, most = (), where[0].evidence
    for first in ranking[:8]:
        rest = gram.without(first.hypothesis.columns)
        explained, freedom = rest.explained([h.columns for h in effects])
        own = [h.name == first.key[0] and h.joint == first.key[1] for h in effects]
        evidence = np.where(own, -np.inf, explained - freedom * np.log(gram.count))
        k = int(np.argmax(evidence))
        if first.evidence + evidence[k] > most:
            most = first.evidence + evidence[k]
            value, count = gram.explained([effects[k].columns])
            second = _verdict(gram, effects[k], float(value[0]), int(count[0]), tests)
            best = (first, second)
    return best


def _keep_better(found: dict[tuple[Any, ...], Verdict], key: tuple[Any, ...], new: Verdict) -> None:
    """Keeps the better of two settings; a physical one is better than one that is not."""
    old = found.get(key)
    if old is None or (new.possible, new.evidence) > (old.possible, old.evidence):
        found[key] = new


def _order(verdict: Verdict) -> float:
    return verdict.evidence


def _verdict(
    gram: Gram, hypothesis: Hypothesis, explained: float, freedom: int, tests: float
) -> Verdict:
    within = _within_bounds(gram, hypothesis) if freedom > 0 else 0.0
    # An impossible hypothesis is ranked by what it would explain without bounds.
    explained = within or explained
    p = corrected(min(1.0, chance(explained, freedom) * hypothesis.tests), tests)
    price = freedom * np.log(gram.count) + 2 * np.log(hypothesis.tests)
    return Verdict(
        hypothesis=hypothesis,
        evidence=explained - float(price),
        explained=explained,
        freedom=freedom,
        p_value=p,
        possible=within > 0.0,
    )


def _within_bounds(gram: Gram, hypothesis: Hypothesis) -> float:
    """What a hypothesis explains within its bounds; zero if all amplitudes are at a bound.

    A negative drag, for example, is not possible.
    """
    at = list(hypothesis.columns)
    limits, inner = (hypothesis.lower, hypothesis.upper), gram.gram[np.ix_(at, at)]
    return bounded_amplitudes(inner, gram.score[at], gram.size[at], limits)[1]


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
