"""Regressions of a residual on the motion, which share no formula with the models."""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..noise import ARFilter

# Largest number of rows that a regression is trained on.
_ROWS = 20_000

# Position, velocity, acceleration and direction of joints, in this order.
Motion = Float[np.ndarray, "_rows joints signals"]
Series = Float[np.ndarray, " _rows"]


class AbstractRegression(eqx.Module):
    """A regression that is trained on the residual of some recordings."""

    # What the prediction depends on, as it is printed.
    on: ClassVar[str]

    @abc.abstractmethod
    def predicted(
        self,
        motion: Sequence[Motion],
        residual: Sequence[Series],
        others: Sequence[Motion],
        filt: ARFilter,
    ) -> list[Series]:
        """The residual of other recordings as a function of their motion.

        **Arguments:**

        - `motion`, `residual`: of the recordings that it is trained on; the residual is zero at
          rows that are not compared.
        - `others`: motion of the other recordings, of the same joints.
        - `filt`: noise filter of the residual.
        """


class Trees(AbstractRegression):
    """Randomised trees (Geurts, Ernst and Wehenkel 2006): any function of the motion at one time.

    They describe steps of friction at reversals, and do not extrapolate.

    **Arguments:**

    - `trees`: their number. `leaf`: smallest number of rows in a leaf.
    """

    trees: int = eqx.field(static=True, default=50)
    leaf: int = eqx.field(static=True, default=5)
    on: ClassVar[str] = "the motion"

    def predicted(
        self,
        motion: Sequence[Motion],
        residual: Sequence[Series],
        others: Sequence[Motion],
        filt: ARFilter,
    ) -> list[Series]:
        from sklearn.ensemble import ExtraTreesRegressor

        rest, there = np.concatenate(residual), _trained_on(residual)
        if len(there) <= self.leaf:
            return [np.zeros(len(x)) for x in others]
        trees = ExtraTreesRegressor(self.trees, min_samples_leaf=self.leaf, random_state=0)
        trees.fit(np.concatenate([_wide(x) for x in motion])[there], rest[there])
        return [trees.predict(_wide(x)) for x in others]


class DistributedLags(AbstractRegression):
    """Ridge regression on the motion at rows before and after: any linear filter of its signals.

    It describes what has a memory, such as a resonance. The rows before and after are both needed
    because the compared signals are low-passed without delay.

    **Arguments:**

    - `lags`: number of rows before, and of rows after.
    """

    lags: int = eqx.field(static=True, default=12)
    on: ClassVar[str] = "the motion before and after"

    def predicted(
        self,
        motion: Sequence[Motion],
        residual: Sequence[Series],
        others: Sequence[Motion],
        filt: ARFilter,
    ) -> list[Series]:
        from sklearn.linear_model import RidgeCV

        signals = [self._lagged(x) for x in motion]
        scale = np.concatenate(signals).std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        # Rows of whitened columns are independent, as cross-validation of single rows assumes.
        pairs = [(x / scale, r) for x, r in zip(signals, residual, strict=True)]
        columns = np.concatenate([filt.innovations(x, r != 0) for x, r in pairs])
        white = np.concatenate([filt.innovations(r, r != 0) for r in residual])
        there = _trained_on(residual)
        if len(there) < 2:
            return [np.zeros(len(x)) for x in others]
        level = np.mean(np.sum(columns[there] ** 2, axis=0))
        ridge = RidgeCV(level * np.logspace(-5, 1, 13), fit_intercept=False)
        ridge.fit(columns[there], white[there])
        return [ridge.predict(self._lagged(x) / scale) for x in others]

    def _lagged(self, motion: Motion) -> Float[np.ndarray, "_rows columns"]:
        """Velocity, acceleration and direction at the rows around each row.

        The position is left out: a filter of it is also one of the velocity, but for a constant.
        """
        shifts = np.arange(-self.lags, self.lags + 1)
        rows = np.clip(np.arange(len(motion))[:, None] + shifts, 0, len(motion) - 1)
        return motion[:, :, 1:][rows].reshape(len(motion), -1)


def _trained_on(residual: Sequence[Series]) -> Int[np.ndarray, " used"]:
    """Numbers of the compared rows of all recordings, or of evenly spaced ones if they are many."""
    there = np.flatnonzero(np.concatenate(residual))
    return there[:: max(1, -(-len(there) // _ROWS))]


def _wide(motion: Motion) -> Float[np.ndarray, "_rows columns"]:
    return motion.reshape(len(motion), -1)


# Functions of the motion at one time, and those with a memory.
AT_ONCE: tuple[AbstractRegression, ...] = (Trees(),)
WITH_MEMORY: tuple[AbstractRegression, ...] = (DistributedLags(),)
REGRESSIONS = AT_ONCE + WITH_MEMORY
