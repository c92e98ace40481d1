"""Scores of hypotheses, corrected for the noise of the recorded motion.

Along a recorded motion the noise of the encoders is in the signatures, in the derivatives of the
model and in the residual. Their products then have a mean that is not zero, most of all those of
signatures with high derivatives of the position: an elastic joint seems to explain noise. Noise of
the same strength is added again, and the products of the changes are subtracted (simulation
extrapolation: Cook and Stefanski 1994).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..estimate import Fit
from ..estimate.oem import oem_of
from ..estimate.pieces import pieces_of
from ..noise import ARFilter
from ..signals.encoder import position_noise
from ..simulation.dynamics import imposed
from .comparison import Comparison
from .data import Data
from .hypotheses import Hypothesis
from .score import WEAK, Gram, Whitened
from .signatures import signatures
from .system import System

# Largest p-value of a hypothesis whose score is corrected.
_POSSIBLE = 0.5
# Number of times that noise is added. The mean product is then known to 0.6 of the deviation of
# one, and the variance of products of different draws to a third.
_DRAWS = 3
# Relative error of the variance of the noise. That of the spectrum is a twentieth, and the steps of
# an encoder are only approximately white.
_LEVEL = 0.1


class Changes(eqx.Module):
    """Changes by noise that is added to the recorded motion, for each draw.

    - `residual`, `base`, `table`: as in `Data`; the table has the columns of some hypotheses.
    - `columns`: their numbers in the table of all hypotheses.
    """

    residual: Float[np.ndarray, "draws recordings samples outputs"]
    base: Float[np.ndarray, "draws recordings samples outputs absorbed"]
    table: Float[np.ndarray, "draws recordings samples outputs some"]
    columns: tuple[int, ...] = eqx.field(static=True)


def changes(
    fit: Fit | Comparison,
    data: Data,
    hypotheses: Sequence[Hypothesis],
    p_values: Sequence[float],
    row: int,
    say: Callable[[str], None],
) -> Changes | None:
    """The changes by added noise; None if the motion is not imposed or has no noise.

    **Arguments:**

    - `fit`: the fit of the linear system. `data`: its residual, base and signatures.
    - `hypotheses`: all of the table, in its order. `p_values`: those without a correction.
    - `row`: index of the compared signal in `SIGNALS`.
    """
    wanted = [p < _POSSIBLE for p in p_values]
    if not imposed(fit.loop) or not any(wanted):
        return None
    pieces = pieces_of(fit.recordings, oem_of(fit).window)
    levels = [position_noise(r) for r in pieces]
    if not any(np.any(level > 0) for level in levels):
        return None
    # All signatures by response share one program.
    offered = [h for h in hypotheses if not h.effect.finite]
    if any(h.effect.finite for h, there in zip(hypotheses, wanted, strict=True) if there):
        offered += _leading(hypotheses, p_values)
    proposed, kept = [(h.effect, h.tests) for h in offered], set(map(id, offered))
    asked = [h for h, there in zip(hypotheses, wanted, strict=True) if there and id(h) in kept]
    rng = np.random.default_rng(0)
    residual, base, tables = [], [], []
    for draw in range(1, _DRAWS + 1):
        say(f"noise of the recorded motion, draw {draw} of {_DRAWS}")
        errors = [
            level * rng.standard_normal(r.q.shape) for r, level in zip(pieces, levels, strict=True)
        ]
        system = System.of(fit, errors)
        moved, table = signatures(
            system.loop, system.batch, system.linear, proposed, row, lambda _: None
        )
        residual.append(system.residual)
        base.append(system.base)
        own = {id(h.effect): list(h.columns) for h in moved}
        # Only these columns are kept: the table of an arm of six joints has thousands.
        tables.append({id(h): table[..., own[id(h.effect)]] for h in asked if id(h.effect) in own})
    # A simulation that diverges with the added noise has no signature.
    asked = [h for h in asked if all(id(h) in some for some in tables)]
    if not asked:
        return None
    columns = tuple(c for h in asked for c in h.columns)
    moved_by = [np.concatenate([some[id(h)] for h in asked], axis=-1) for some in tables]
    return Changes(
        np.stack(residual) - data.residual,
        np.stack(base) - data.base,
        np.stack(moved_by) - data.columns(columns),
        columns,
    )


def _leading(hypotheses: Sequence[Hypothesis], p_values: Sequence[float]) -> list[Hypothesis]:
    """The best simulated setting of each effect on each joint, in the order of the table.

    A simulation takes longer than all responses.
    """
    best: dict[Any, int] = {}
    for k, h in enumerate(hypotheses):
        if h.effect.finite:
            key = type(h.effect), h.joint
            if key not in best or p_values[k] < p_values[best[key]]:
                best[key] = k
    return [hypotheses[k] for k in sorted(best.values())]


class Corrected(eqx.Module):
    """Scores without what the noise of the recorded motion adds to them.

    - `gram`: with the corrected scores.
    - `wider`: variance of the score of each hypothesis over that which the products give; infinite
      for simulated settings that are not the best of their effect and joint.
    """

    gram: Gram
    wider: Float[np.ndarray, " hypotheses"]


def corrected_by(
    changed: Changes,
    data: Data,
    noise: Sequence[ARFilter],
    white: Whitened,
    gram: Gram,
    hypotheses: Sequence[Hypothesis],
) -> Corrected:
    """The scores after subtraction of the mean products of the changes.

    **Arguments:**

    - `changed`: by added noise. `data`, `noise`, `white`, `gram`: the problem and its products.
    - `hypotheses`: all of the table, in its order.
    """
    products = _products(changed, data, noise, white) / gram.size[list(changed.columns)]
    draws = len(products)
    mean = products[np.arange(draws), np.arange(draws)].mean(axis=0)
    apart = products[~np.eye(draws, dtype=bool)]
    score = gram.score.copy()
    score[list(changed.columns)] -= mean
    place = {c: k for k, c in enumerate(changed.columns)}
    wider = np.ones(len(hypotheses))
    simulated = any(h.effect.finite and h.columns[0] in place for h in hypotheses)
    for k, h in enumerate(hypotheses):
        if simulated and h.effect.finite and h.columns[0] not in place:
            wider[k] = np.inf
        if all(c in place for c in h.columns):
            own = [place[c] for c in h.columns]
            values, vectors = np.linalg.eigh(gram.gram[np.ix_(h.columns, h.columns)])
            strong = values > WEAK
            if strong.any():
                turn = vectors[:, strong] / np.sqrt(values[strong])
                wider[k] = _wider(mean[own] @ turn, apart[:, own] @ turn)
    return Corrected(dataclasses.replace(gram, score=score), wider)


def _wider(mean: Float[np.ndarray, " strong"], apart: Float[np.ndarray, "pairs strong"]) -> float:
    """Variance of a corrected score in units of the uncorrected one.

    The variance of products of independent draws is a part of the uncorrected one. A product of
    changes by the same noise has twice this variance, and the mean of the draws its own.
    """
    one = float(np.mean(apart**2))
    return 1 + one * (1 + 2 / _DRAWS) + float(np.mean((_LEVEL * mean) ** 2))


def _products(
    changed: Changes, data: Data, noise: Sequence[ARFilter], white: Whitened
) -> Float[np.ndarray, "draws draws some"]:
    """Products of the changes of signatures in one draw with those of the residual in another."""
    base = data.white_columns(data.base, noise, slice(None))
    size = np.linalg.norm(base, axis=0)
    size[size == 0] = 1.0
    table = data.white_columns(data.columns(changed.columns).astype(float), noise)
    # What the base absorbs of a signature changes as well.
    taken = np.linalg.lstsq(base / size, table, rcond=1e-9)[0] / size[:, None]

    def projected(x: np.ndarray) -> np.ndarray:
        rows = data.white(x, noise).reshape(-1, x.shape[-1])
        rows = np.pad(rows, ((0, len(base) - len(rows)), (0, 0)))
        return rows - white.basis @ (white.basis.T @ rows)

    left = [projected(t - b @ taken) for t, b in zip(changed.table, changed.base, strict=True)]
    right = [projected(r[..., None])[:, 0] for r in changed.residual]
    return np.array([[one.T @ other for other in right] for one in left])
