"""Other tools that find what a rigid model lacks, all on the same rows.

A tool reports the effects that it found, if it can name effects, and whether something is missing.
It predicts torque along another motion. Choices are made on every third second of the fitted
recordings, which is left out of the fit. The held-out recording is used only for tests.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import stepwise
from ._baseline_library import Candidate, library
from ._baseline_rows import Columns, Motion, Table, residual, rigid_columns, solved

# A tool reports that something is missing if it explains this share of the rows left out.
WORTH = 0.05
# A model with fewer terms is preferred if its residual is at most this factor larger.
AS_GOOD = 1.02
# An expression gets an effect's name if the effect's columns explain this share of it.
SAME = 0.8


@dataclass(frozen=True)
class Found:
    """The result of a tool.

    **Arguments:**

    - `named`: effects and joints (from 1), the most important first.
    - `missing`: whether it reports that the rigid model lacks something.
    - `predict`: torque along a motion, `(samples, joints)`.
    """

    named: tuple[tuple[str, int], ...]
    missing: bool
    predict: Callable[[Motion], np.ndarray]


Tool = Callable[[Table, tuple[bool, ...], int], Found]


def rigid(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """The rigid robot with friction, and nothing else."""
    return _with_blocks(table, [])


def stepwise_bic(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """Forward selection by BIC and F-test, as in a textbook."""
    candidates = library(table, slides)
    everything = np.ones(len(table.right), bool)
    entered = _forward(table, candidates, everything)
    return _with_blocks(table, [candidates[k] for k in entered])


def stepwise_validated(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """The same, stopped when the prediction of the rows left out does not improve."""
    candidates = library(table, slides)
    entered = _forward(table, candidates, ~table.left_out)
    blocks = [table.block(candidates[k].joint, candidates[k].columns) for k in entered]
    left = [_left(table, blocks[:count]) for count in range(len(blocks) + 1)]
    kept = _fewest(left, range(len(left)))
    return _with_blocks(table, [candidates[k] for k in entered[:kept]])


def pysindy_stlsq(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """pysindy's sequentially thresholded least squares over the library's columns.

    The rigid robot is projected out of library and torque first, so thresholds apply to the part
    that it cannot explain. The threshold is chosen by the rows left out.
    """
    import pysindy

    candidates = library(table, slides)
    blocks = [table.block(c.joint, c.columns) for c in candidates]
    owner = np.repeat(np.arange(len(blocks)), [b.shape[1] for b in blocks])
    kept = ~table.left_out
    columns = residual(table.base[kept], np.concatenate(blocks, axis=1)[kept])
    columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    right = residual(table.base[kept], table.right[kept])
    right /= np.linalg.norm(right)
    sets: list[tuple[int, ...]] = [()]
    for threshold in np.geomspace(0.05, 1.0, 12):
        optimizer = pysindy.STLSQ(threshold=float(threshold), alpha=1e-3, max_iter=50)
        with warnings.catch_warnings():
            # A threshold may remove all terms; this is a valid answer.
            warnings.simplefilter("ignore")
            optimizer.fit(columns, right[:, None])
        found = np.abs(np.asarray(optimizer.coef_)[0]) > 0
        sets.append(tuple(np.unique(owner[found]).tolist()))
    sets = list(dict.fromkeys(sets))
    left = [_left(table, [blocks[k] for k in chosen]) for chosen in sets]
    chosen = sets[_fewest(left, [len(s) for s in sets])]
    worth = {k: np.sum((right - residual(columns[:, owner == k], right)) ** 2) for k in chosen}
    return _with_blocks(table, [candidates[k] for k in sorted(chosen, key=lambda k: -worth[k])])


def gplearn_symbolic(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """gplearn's expressions for the rigid robot's residual torque of each joint.

    An expression gets the name of the effect whose columns explain the largest part of its values,
    if that part is large enough. It is kept if it improves the prediction of the rows left out.
    """
    from gplearn.functions import make_function
    from gplearn.genetic import SymbolicRegressor

    fade = make_function(function=_fade, name="fade", arity=1)
    rest = residual(table.base, table.right)
    terms: list[Candidate] = []
    candidates = library(table, slides)
    for j in range(table.joints):
        signals = _signals(table, j, table.motions)
        own, out = rest[table.joint == j], table.left_out[table.joint == j]
        x = table.features(signals, j)
        search = SymbolicRegressor(
            population_size=500,
            generations=12,
            function_set=("add", "sub", "mul", "sin", "cos", "abs", fade),
            metric="mse",
            const_range=(-10.0, 10.0),
            parsimony_coefficient=0.002,
            random_state=seed % 2**31,
        )
        search.fit(x[~out], own[~out] / own.std())

        def expression(m: Motion, search: Any = search, signals: Columns = signals) -> np.ndarray:
            return search.predict(signals(m))[:, None]

        if _explained(own[out] / own.std(), search.predict(x[out])) > WORTH:
            terms.append(Candidate("", j, expression))
    found = _with_blocks(table, terms)
    named = [_called(table, term, candidates) for term in terms]
    return Found(tuple(n for n in named if n is not None), bool(terms), found.predict)


def gaussian_process(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """scikit-learn's Gaussian process on the rigid robot's residual; it cannot name effects."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    def fitted(x: np.ndarray, y: np.ndarray) -> Any:
        few = np.random.default_rng(seed).permutation(len(x))[:300]
        kernel = ConstantKernel(0.5) * RBF(np.ones(x.shape[1]), (1e-2, 1e3)) + WhiteKernel(0.5)
        process = GaussianProcessRegressor(kernel, random_state=seed % 2**31)
        with warnings.catch_warnings():
            # A length at its bound belongs to an irrelevant signal.
            warnings.simplefilter("ignore")
            return process.fit(x[few], y[few])

    return _learned(table, fitted)


def network(table: Table, slides: tuple[bool, ...], seed: int) -> Found:
    """scikit-learn's two-layer network on the rigid robot's residual; it cannot name effects."""
    from sklearn.neural_network import MLPRegressor

    def fitted(x: np.ndarray, y: np.ndarray) -> Any:
        net = MLPRegressor(
            hidden_layer_sizes=(32, 32),
            early_stopping=True,
            max_iter=400,
            random_state=seed % 2**31,
        )
        return net.fit(x, y)

    return _learned(table, fitted)


TOOLS: dict[str, Tool] = {
    "rigid": rigid,
    "stepwise": stepwise_bic,
    "stepwise, validated": stepwise_validated,
    "pysindy": pysindy_stlsq,
    "gplearn": gplearn_symbolic,
    "Gaussian process": gaussian_process,
    "network": network,
}


def _fade(x: np.ndarray) -> np.ndarray:
    return np.exp(-np.abs(x))


def _forward(table: Table, candidates: Sequence[Candidate], kept: np.ndarray) -> list[int]:
    """Places of the candidates that are selected by the rows that are kept."""
    blocks = [table.block(c.joint, c.columns)[kept] for c in candidates]
    keys: list[stepwise.Key] = [(c.family, c.joint) for c in candidates]
    rows = stepwise.Rows(table.base[kept], blocks, keys, table.right[kept])
    return [entry.place for entry in stepwise.forward(rows)]


def _left(table: Table, blocks: Sequence[np.ndarray]) -> float:
    """The squared error of the rows left out of a fit."""
    columns, out = np.concatenate([table.base, *blocks], axis=1), table.left_out
    theta = solved(columns[~out], table.right[~out])
    return float(np.sum((table.right[out] - columns[out] @ theta) ** 2))


def _fewest(left: Sequence[float], sizes: Sequence[int]) -> int:
    """The place of the smallest model that is about as good as the best."""
    good = [k for k, x in enumerate(left) if x <= AS_GOOD * min(left)]
    return min(good, key=lambda k: (sizes[k], left[k]))


def _with_blocks(table: Table, chosen: Sequence[Candidate]) -> Found:
    """The rigid robot with some candidates, all fitted at once."""
    blocks = [table.block(c.joint, c.columns) for c in chosen]
    theta = solved(np.concatenate([table.base, *blocks], axis=1), table.right)

    def predict(motion: Motion) -> np.ndarray:
        rigid = rigid_columns(motion, table.widths)
        torque = rigid @ theta[: rigid.shape[-1]]
        at = rigid.shape[-1]
        for candidate in chosen:
            own = candidate.columns(motion)
            torque[:, candidate.joint] += own @ theta[at : at + own.shape[1]]
            at += own.shape[1]
        return torque

    named = tuple(dict.fromkeys((c.family, c.joint + 1) for c in chosen))
    return Found(named, bool(chosen), predict)


def _called(
    table: Table, term: Candidate, candidates: Sequence[Candidate]
) -> tuple[str, int] | None:
    """The effect whose columns explain an expression, after the rigid robot; None for none."""
    value = residual(table.base, table.block(term.joint, term.columns)[:, 0])
    best, share = None, SAME
    for candidate in (c for c in candidates if c.joint == term.joint):
        block = residual(table.base, table.block(candidate.joint, candidate.columns))
        explained = 1 - np.sum(residual(block, value) ** 2) / np.sum(value**2)
        if explained > share:
            best, share = (candidate.family, candidate.joint + 1), explained
    return best


def _signals(table: Table, joint: int, motions: Sequence[Motion]) -> Columns:
    """A learner's inputs along a motion, scaled to about one; angles in rad."""
    fastest = np.max([np.abs(m.v).max(axis=0) for m in motions], axis=0)
    hardest = max(float(np.abs(table.load(m)[:, joint]).max()) for m in motions)
    lasts = max(float(m.time[-1] - m.time[0]) for m in motions)

    def signals(m: Motion) -> np.ndarray:
        v = m.v / fastest
        own = np.stack(
            [
                np.tanh(m.v[:, joint] / table.widths[joint]),
                table.load(m)[:, joint] / hardest,
                (m.time - m.time[0]) / lasts,
            ],
            axis=-1,
        )
        return np.concatenate([m.q, v, own], axis=-1)

    return signals


def _explained(y: np.ndarray, predicted: np.ndarray) -> float:
    return float(1 - np.sum((y - predicted) ** 2) / np.sum(y**2))


def _learned(table: Table, fitted: Callable[[np.ndarray, np.ndarray], Any]) -> Found:
    """A learner for each joint on the rigid robot's residual, kept if it explains enough."""
    rest = residual(table.base, table.right)
    plain = _with_blocks(table, [])
    kept: list[tuple[int, Any, Columns]] = []
    for j in range(table.joints):
        signals = _signals(table, j, table.motions)
        x, y = table.features(signals, j), rest[table.joint == j]
        out, centre, spread = table.left_out[table.joint == j], x.mean(axis=0), x.std(axis=0)

        def scaled(
            m: Motion,
            signals: Columns = signals,
            centre: np.ndarray = centre,
            spread: np.ndarray = spread,
        ) -> np.ndarray:
            return (signals(m) - centre) / spread

        x = (x - centre) / spread
        learner = fitted(x[~out], y[~out])
        if _explained(y[out], learner.predict(x[out])) > WORTH:
            kept.append((j, learner, scaled))

    def predict(motion: Motion) -> np.ndarray:
        torque = plain.predict(motion)
        for j, learner, scaled in kept:
            torque[:, j] += table.scale[j] * learner.predict(scaled(motion))
        return torque

    return Found((), bool(kept), predict)
