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

from ..effects.placed import Placed, by_structure
from ..estimate import Fit
from ..estimate.oem import oem_of
from ..estimate.pieces import pieces_of
from ..noise import ARFilter
from ..signals.encoder import position_errors
from ..simulation.dynamics import imposed
from .comparison import Comparison
from .data import Data
from .hypotheses import Hypothesis
from .score import WEAK, Gram, Whitened
from .signatures import signatures
from .system import System
from .table import SignatureTable

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

    - `residual`, `base`: changes of those in `Data`.
    - `tables`: signatures of some hypotheses, with the noise.
    - `columns`: numbers of their columns in the table of all hypotheses.
    """

    residual: Float[np.ndarray, "draws recordings samples outputs"]
    base: Float[np.ndarray, "draws recordings samples outputs absorbed"]
    tables: tuple[SignatureTable, ...]
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
    drawn = position_errors(pieces, _DRAWS)
    if not drawn:
        return None
    offered = _together(hypotheses, wanted, fit.loop.joints)
    if any(h.effect.finite for h, there in zip(hypotheses, wanted, strict=True) if there):
        offered += _leading(hypotheses, p_values)
    proposed, kept = [(h.effect, h.tests) for h in offered], set(map(id, offered))
    asked = [h for h, there in zip(hypotheses, wanted, strict=True) if there and id(h) in kept]
    residual, base, tables = [], [], []
    for number, errors in enumerate(drawn, start=1):
        say(f"noise of the recorded motion, draw {number} of {_DRAWS}")
        system = System.of(fit, errors)
        moved, table = signatures(
            system.loop, system.batch, system.linear, proposed, row, lambda _: None
        )
        residual.append(system.residual)
        base.append(system.base)
        own = {id(h.effect): list(h.columns) for h in moved}
        tables.append((own, table))
    # A simulation that diverges with the added noise has no signature.
    asked = [h for h in asked if all(id(h.effect) in own for own, _ in tables)]
    if not asked:
        return None
    return Changes(
        np.stack(residual) - data.residual,
        np.stack(base) - data.base,
        tuple(table.only([c for h in asked for c in own[id(h.effect)]]) for own, table in tables),
        tuple(c for h in asked for c in h.columns),
    )


def _together(
    hypotheses: Sequence[Hypothesis], wanted: Sequence[bool], joints: int
) -> list[Hypothesis]:
    """Hypotheses by response whose structure has a wanted one; they share a compiled program."""
    direct = [k for k, h in enumerate(hypotheses) if not h.effect.finite]
    found = []
    for places in by_structure([Placed.of(hypotheses[k].effect, joints) for k in direct]):
        group = [direct[place] for place in places]
        if any(wanted[k] for k in group):
            found += group
    return [hypotheses[k] for k in sorted(found)]


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
    known = len(white.residual) - data.residual.size
    # What the base absorbs of a signature changes as well.
    base = data.white_columns(data.base, noise, slice(None))
    size = np.linalg.norm(base, axis=0)
    size[size == 0] = 1.0
    absorbed = np.linalg.lstsq(base / size, white.basis, rcond=1e-9)[0] / size[:, None]
    columns = list(changed.columns)
    taken = absorbed @ (white.across[:, columns] * white.size[columns])
    nominal = dataclasses.replace(data.only(columns), kept=None)
    tables = [dataclasses.replace(nominal, table=table) for table in changed.tables]

    def projected(x: np.ndarray) -> np.ndarray:
        rows = np.pad(data.white(x, noise).ravel(), (0, known))
        return (rows - white.basis @ (white.basis.T @ rows))[: x.size].reshape(x.shape)

    found = []
    right = np.stack([projected(r) for r in changed.residual], axis=-1)
    flat = right.reshape(-1, len(tables))
    first = nominal.white_products(noise, right)
    for moved, change in zip(tables, changed.base, strict=True):
        of_base = data.white(change, noise).reshape(len(flat), -1).T @ flat
        found.append(moved.white_products(noise, right) - first - taken.T @ of_base)
    return np.stack(found).transpose(0, 2, 1)
