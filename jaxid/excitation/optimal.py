"""References that determine the parameters best: Fourier series under limits."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import FitError
from ..estimate.result import determined_covariance
from ..signals.fourier import FourierSeries, fourier_basis
from ..simulation.loop import ClosedLoop
from ._information import (
    Criterion,
    Kind,
    chosen_parameters,
    closed_loop_columns,
    information_of,
    inverse_columns,
)
from .descent import all_margins, improved, random_references, shrunk
from .design import Design, make_design, score_of
from .limits import SIDES, Limits
from .reference import Excitation

if TYPE_CHECKING:
    import pandas as pd


def optimal_excitation(
    loop: ClosedLoop,
    limits: Limits,
    *,
    period: float = 10.0,
    harmonics: int = 5,
    rate: float = 100.0,
    kind: Kind = "inverse-dynamics",
    criterion: Criterion = "determinant",
    noise: Sequence[float] | np.ndarray | None = None,
    start: Sequence[float] | np.ndarray | None = None,
    tries: int = 200,
    starts: int = 3,
    rounds: int = 12,
    seed: int = 0,
    say: Callable[[str], None] = lambda text: None,
) -> Excitation:
    """Finds the reference that determines the parameters best.

    Each joint follows a finite Fourier series that starts and ends at rest (Swevers et al. 1997).
    SLSQP with exact gradients starts from the best of random references. Limits are imposed at the
    points that are nearest to them; these are chosen again in each round. Limits are checked on a
    grid that is ten times finer.

    **Arguments:**

    - `loop`: the model at the best known values; its free parameters are to be determined.
    - `limits`: of the reference and of the torque that it needs.
    - `period`: s. `harmonics`: their number. `rate`: sample rate, Hz.
    - `kind`: `"inverse-dynamics"` for regressions, `"closed-loop"` for `OEM`: information by the
      sensitivities of the simulated loop, whose motion and torque must also keep the limits.
    - `criterion`: the criterion to minimise: `"determinant"` (of the covariance), `"deviation"`
      (geometric mean of the standard deviations) or `"condition"` (of the columns).
    - `noise`: standard deviation of torque noise, one or one per joint, N·m or N; a hundredth of
      the torque limits if None.
    - `start`: pose to start and end at, `(joints,)`; any if None.
    - `tries`: number of random references. `starts`: how many of the best are improved.
      `rounds`: largest number of rounds.
    - `seed`: of the random references. `say`: called with progress.

    **Raises:** `LimitsError` if a limit allows no motion; `FitError` for settings that allow no
        reference.
    """
    design, centre = make_design(
        loop,
        limits,
        period=period,
        harmonics=harmonics,
        rate=rate,
        kind=kind,
        criterion=criterion,
        noise=noise,
        start=start,
    )
    drawn, scores = random_references(design, centre, tries, seed)
    best, best_score = None, np.inf
    for k in np.argsort(scores)[:starts]:
        z = shrunk(design, improved(design, drawn[k], centre, rounds, say), centre)
        score = float(score_of(design, jnp.asarray(z)))
        if score < best_score:
            best, best_score = z, score
    if best is None:
        raise FitError(
            "no reference with finite information was found: raise tries, or hold some parameters"
        )
    return _report(design, best, best_score, rate)


def _report(
    design: Design, z: Float[np.ndarray, " numbers"], score: float, rate: float
) -> Excitation:
    coefficients = np.asarray(design.coefficients(z))
    harmonics = (len(coefficients) - 1) // 2
    series = FourierSeries(coefficients, design.period)
    settings = design.settings
    time = np.arange(round(design.period * rate)) / rate
    signals = jnp.asarray(fourier_basis(time, design.period, harmonics) @ coefficients)
    if settings.kind == "closed-loop":
        _, columns = closed_loop_columns(design.loop, time, signals)
    else:
        columns = inverse_columns(design.loop, jnp.asarray(time), signals)
    information = np.asarray(information_of(columns, jnp.asarray(settings.noise)))
    names = tuple(n for p in chosen_parameters(design.loop, settings.kind) for n in p.names)
    covariance, lost = determined_covariance(information, names, settings.scales)
    return Excitation(
        loop=design.loop,
        series=series,
        limits=design.limits,
        covariance=covariance,
        names=names,
        undetermined=lost,
        margins=_margin_table(design, all_margins(design, z)[0]),
        score=score,
        rate=float(rate),
        kind=settings.kind,
    )


def _margin_table(design: Design, smallest: Float[np.ndarray, " kinds"]) -> "pd.DataFrame":
    import pandas as pd

    joints = design.base.shape[1]
    table: dict[str, Any] = {}
    for kind, row in zip(SIDES, smallest[: 8 * joints].reshape(8, joints), strict=True):
        table[kind] = np.minimum(table[kind], row) if kind in table else row
    frame = pd.DataFrame(table, index=[f"joint {j}" for j in range(1, joints + 1)]).T * 100
    if len(smallest) > 8 * joints:
        # A function given by the user, in an unknown unit.
        frame.loc["workspace, in its unit"] = np.nan
        frame.iloc[-1, 0] = smallest[8 * joints :].min()
    return frame.rename_axis("limit")
