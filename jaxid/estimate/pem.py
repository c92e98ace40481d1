"""Separable prediction error method: output error filtered by an estimated noise model."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np

from ..display.progress import working
from ..errors import NoiseError
from ..noise import (
    ARFilter,
    Criterion,
    Noise,
    VectorAR,
    check_series,
    fit_ar,
    fit_var,
    innovations,
    levels,
)
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from ..simulation.steps import with_substeps
from .converge import Converged, converge, residual_series
from .covariance import Deviations
from .oem import OEM
from .pieces import compared_signals
from .reporting import report
from .result import AbstractMethod, Fit, Status
from .start import start_values


class Order(NamedTuple):
    """How the orders of noise filters are chosen; see `SeparablePEM`."""

    criterion: Criterion
    highest: int
    white: float | None


class SeparablePEM(AbstractMethod):
    """Separable prediction error method, equation (11) of Brunot et al. 2016.

    Alternates a fit of the physical parameters on the filtered error and a fit of each joint's AR
    filter on the residuals, until the prediction error has converged.

    **Arguments:**

    - `oem`: output, start, initial states and bounds are those of this method.
    - `filters`: noise filters to use as given, one for each output; None to estimate them.
    - `criterion`: `"aic"`, `"aicc"` or `"bic"`, by which the orders are chosen over 0..`highest`.
    - `white`: significance of Ljung and Box's test, by which orders without white innovations are
      rejected (as in CAPTAIN's `aic`, Young 2011); None for the criterion alone.
    - `orders`: of the filters, one for each output, instead of a choice.
    - `coupled`: whether there is one filter for all joints, each of which depends on the past of
      all.
    - `first_step`: `"filtered"` for parameters from the filtered error; `"plain"` for the paper's
      variant, in which the parameters are those of output error.
    - `deviations`: `"white"` for (A.1), `"sandwich"`, `"newey_west"`, `"paper"`. By default
      `"newey_west"` if the law is unknown; else `"white"` if parameters come from the filtered
      error and all recordings are equally noisy, or `"sandwich"`.
    - `tolerance`: relative change of the prediction error's variance at which it stops.
    - `rounds`: largest number of alternations.

    **Raises:** `NoiseError` if the residuals allow no such filter; its `fit` is the fit so far.
    """

    oem: OEM = OEM()
    filters: tuple[ARFilter, ...] | VectorAR | None = None
    criterion: Criterion = eqx.field(static=True, default="aic")
    highest: int = eqx.field(static=True, default=50)
    white: float | None = eqx.field(static=True, default=0.05)
    orders: tuple[int, ...] | None = eqx.field(static=True, default=None)
    coupled: bool = eqx.field(static=True, default=False)
    first_step: Literal["filtered", "plain"] = eqx.field(static=True, default="filtered")
    deviations: Deviations | None = eqx.field(static=True, default=None)
    tolerance: float = 1e-3
    rounds: int = eqx.field(static=True, default=10)

    def __repr__(self) -> str:
        said = self.criterion if self.orders is None else f"orders={self.orders}"
        given = "filters given" if self.filters is not None else said
        more = ", coupled" if self.coupled else ""
        plain = ", first_step='plain'" if self.first_step == "plain" else ""
        return f"SeparablePEM({given}{more}{plain})"

    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the loop's free parameters; called by `jaxid.fit`."""
        started = time.perf_counter()
        recordings.common_period()
        with working(f"SeparablePEM of {loop.name}", self.oem.progress) as say:
            loop = with_substeps(start_values(loop, recordings, self.oem.start, say), recordings)
            deadline = started + self.oem.max_seconds
            done, noise, rounds = self._alternate(loop, recordings, say, deadline)
        kind = self.deviations or self._deviations(done, noise)
        seconds = time.perf_counter() - started
        return report(kind, done, recordings, seconds, self, noise, rounds)

    def _deviations(self, done: Converged, noise: Noise) -> Deviations:
        """(A.1), which assumes one noise level; the sandwich if levels differ significantly.

        Along a recorded motion the error of the motion is part of the residual.
        """
        if done.batch.band is not None and self.first_step == "filtered":
            return "newey_west"
        ratios = np.stack(levels([innovations(x, noise) for x in residual_series(done)]))
        uneven = np.any(ratios.max(axis=0) > 1.3 * ratios.min(axis=0))
        return "sandwich" if uneven or self.first_step == "plain" else "white"

    def _alternate(
        self,
        loop: ClosedLoop,
        recordings: Recordings,
        say: Callable[[str], None],
        deadline: float,
    ) -> tuple[Converged, Noise, int]:
        """The final fit and filters, and the number of alternations."""
        if self.filters is not None:
            outputs = len(compared_signals(self.oem, loop)) * loop.joints
            given = self.filters
            count = given.outputs if isinstance(given, VectorAR) else len(given)
            if count != outputs:
                raise NoiseError(f"filters are given for {count} outputs, but there are {outputs}")
            done = converge(self.oem, loop, recordings, say, self.filters, deadline)
            return done, self.filters, 0
        done = converge(self.oem, loop, recordings, say, deadline=deadline)
        noise: Noise = None
        before = np.inf
        for k in range(1, self.rounds + 1):
            if not done.minimum.status.simulated or done.minimum.status is Status.max_seconds:
                return done, noise, k - 1
            with keeping(done, self.oem, recordings):
                order = Order(self.criterion, self.highest, self.white)
                noise = noise_filters(done, order, self.orders, self.coupled)
            if self.first_step == "filtered":
                done = converge(self.oem, done.loop, recordings, say, noise, deadline)
            spread = prediction_spread(done, noise)
            if abs(before - spread) < self.tolerance:
                return done, noise, k
            before = spread
        return done, noise, self.rounds


@contextlib.contextmanager
def keeping(done: Converged, method: OEM, recordings: Recordings) -> Iterator[None]:
    """Attaches the fit so far to a `NoiseError`."""
    try:
        yield
    except NoiseError as error:
        error.fit = report(method.deviations, done, recordings, 0.0, method)
        raise


def noise_filters(
    done: Converged, order: Order, orders: Sequence[int] | None = None, coupled: bool = False
) -> tuple[ARFilter, ...] | VectorAR:
    """The AR filter of each output's residuals, or of all together, over all recordings.

    **Raises:** `NoiseError` if the residuals do not allow it.
    """
    residuals = residual_series(done)
    outputs = residuals[0].shape[1]
    if orders is not None and len(orders) != outputs:
        raise NoiseError(f"{len(orders)} orders are given for {outputs} outputs: give one for each")
    if coupled:
        given = None if orders is None else max(orders)
        return fit_var(residuals, given, highest=order.highest, criterion=order.criterion)
    filters = []
    for output in range(outputs):
        series = [x[:, output] for x in residuals]
        given = None if orders is None else orders[output]
        check_series(series, given or 0, output_name(done, output))
        filters.append(
            fit_ar(
                series,
                given,
                highest=order.highest,
                criterion=order.criterion,
                white=order.white,
            )
        )
    return tuple(filters)


def output_name(done: Converged, output: int) -> str:
    """The name of an output in messages."""
    signal, joint = divmod(output, done.loop.joints)
    what = {"tau": "torque", "q": "position"}[done.signals[signal]]
    return f"joint {joint + 1}'s {what}"


def prediction_spread(done: Converged, noise: Noise) -> float:
    """Logarithm of the determinant of the prediction error's covariance."""
    white = [innovations(x, noise) for x in residual_series(done)]
    together = np.concatenate(white)
    together = together[np.any(together != 0, axis=1)]
    return float(np.sum(np.log(np.mean(together**2, axis=0))))
