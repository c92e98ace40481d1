"""Separable prediction error: the output error through the inverse of an estimated noise filter."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Literal

import equinox as eqx
import numpy as np

from ..loop import ClosedLoop
from ..noise import ARFilter, fit_ar
from ..progress import working
from ..recording import Recordings
from ..simulate import with_substeps
from ._base import AbstractMethod, Fit, Status
from .oem import OEM, _converge, _Done, _report, start_values


class SeparablePEM(AbstractMethod):
    """Separable prediction error method, equation (11) of Brunot et al. 2016.

    Alternates a fit of the physical parameters on the filtered error and a fit of each joint's AR
    filter on the residuals, until the prediction error has converged.

    **Arguments:**

    - `oem`: output, start, initial states and bounds are those of this method.
    - `filters`: noise filters to use as given, one for each output; None to estimate them.
    - `criterion`: by which the order of the filters is chosen, up to `highest`.
    - `tolerance`: relative change of the prediction error's variance at which it stops.
    - `rounds`: largest number of alternations.
    """

    oem: OEM = OEM()
    filters: tuple[ARFilter, ...] | None = None
    criterion: Literal["aic", "aicc", "bic"] = eqx.field(static=True, default="aic")
    highest: int = eqx.field(static=True, default=50)
    tolerance: float = 1e-3
    rounds: int = eqx.field(static=True, default=10)

    def __repr__(self) -> str:
        return f"SeparablePEM({self.criterion})"

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the loop's free parameters; called by `jaxid.fit`."""
        started = time.perf_counter()
        with working(f"SeparablePEM of {loop.name}", self.oem.progress) as say:
            loop = with_substeps(start_values(loop, recordings, self.oem.start, say), recordings)
            deadline = started + self.oem.max_seconds
            done = self._alternate(loop, recordings, say, deadline)
        how = "equation (A.1) with the gradient of the filtered error"
        method = dataclasses.replace(self.oem, deviations="white")
        return _report(method, done, recordings, time.perf_counter() - started, self, how)

    def _alternate(
        self,
        loop: ClosedLoop,
        recordings: Recordings,
        say: Callable[[str], None],
        deadline: float,
    ) -> _Done:
        if self.filters is not None:
            return _converge(self.oem, loop, recordings, say, self.filters, deadline)
        done = _converge(self.oem, loop, recordings, say, deadline=deadline)
        before = np.inf
        for _ in range(self.rounds):
            if done.minimum.status in (Status.diverged, Status.max_seconds):
                break
            filters = noise_filters(done, self.criterion, self.highest)
            done = _converge(self.oem, done.loop, recordings, say, filters, deadline)
            spread = float(np.sum(np.log(1 / np.asarray(done.weights))))
            if abs(before - spread) < self.tolerance:
                break
            before = spread
        return done


def noise_filters(
    done: _Done, criterion: Literal["aic", "aicc", "bic"], highest: int
) -> Sequence[ARFilter]:
    """The AR filter of each output's residuals, over all recordings."""
    raw = np.asarray(done.minimum.point.found.raw) / np.asarray(done.weights)
    mask = np.asarray(done.batch.kept)
    filters = []
    for output in range(raw.shape[2]):
        series = [row[there, output] for row, there in zip(raw, mask, strict=True)]
        filters.append(fit_ar(series, criterion=criterion, highest=highest))
    return tuple(filters)
