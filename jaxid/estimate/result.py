"""Base class of methods, and the result of a fit."""

import abc
import enum
import html
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..compiling import compiled
from ..display.shown import AbstractShown
from ..errors import FitError, check_words
from ..noise import ARFilter, VectorAR, innovations, ljung_box
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..storage.saved import save

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


# Relative error of a joint's torque, %, above which a model is of no use. Good models have an error
# of a few per cent, and noise is rarely above ten.
DOUBTFUL_PERCENT = 30.0


class Status(enum.Enum):
    """How a fit ended."""

    converged = "converged"
    stalled = "stopped without progress before the tolerance was met"
    max_steps = "reached the largest number of iterations; raise max_steps"
    max_seconds = "reached its time limit; raise max_seconds"
    diverged = "no parameter values were found at which the loop can be simulated"
    overflowed = "numbers overflowed float64; check the units of the recordings"
    unphysical = "ended at unphysical values: the mass matrix is not positive definite"
    misfit = "does not describe the recordings better than no model"
    out_of_solver_steps = (
        "the integration ran out of steps before a recording's end; raise Stepping(max_steps=...), "
        "loosen the tolerances of its controller, or choose an implicit solver"
    )
    smallest_solver_step = (
        "the integration's step became smaller than allowed; choose an implicit solver, or look "
        "for a value that makes the loop stiff"
    )
    implicit_step_failed = "an implicit step found no solution; use smaller steps or another solver"

    @property
    def simulated(self) -> bool:
        """Whether the loop could be simulated at some values."""
        return self not in (
            Status.diverged,
            Status.out_of_solver_steps,
            Status.smallest_solver_step,
            Status.implicit_step_failed,
        )


class Fit(AbstractShown):
    """Result of an estimation: the fitted loop, covariance, residuals, status.

    - `loop`: the model with the estimated values.
    - `covariance`: covariance of `loop.theta`, `(parameters, parameters)`; infinite if not
      determined.
    - `residuals`: measured minus simulated torque (for a position output: position), one
      `(samples, joints)` for each recording.
    - `undetermined`: sentences that name combinations of parameters that the data do not determine.
    - `notes`: other remarks.
    - `mistake`: likely mistake in the recordings, such as a wrong sign or unit, if the fit leaves a
      tenth of a joint's torque and a regression finds one; otherwise empty.
    - `noise`: estimated or given noise filters, one for each output or one for all; None for white
      noise.
    - `rounds`: number of alternations between parameters and filters.
    - `optimum`: the least-squares problem at its minimum, for deviations, bootstrap and profile;
      None for regressions.
    """

    loop: ClosedLoop
    recordings: Recordings
    method: Any
    status: Status = eqx.field(static=True)
    covariance: Float[np.ndarray, "parameters parameters"]
    residuals: tuple[Float[np.ndarray, "_samples joints"], ...]
    error_percent: "pd.DataFrame"
    iterations: int = eqx.field(static=True, default=0)
    simulations: int = eqx.field(static=True, default=0)
    seconds: float = eqx.field(static=True, default=0.0)
    deviations: str = eqx.field(static=True, default="")
    undetermined: tuple[str, ...] = eqx.field(static=True, default=())
    notes: tuple[str, ...] = eqx.field(static=True, default=())
    mistake: str = eqx.field(static=True, default="")
    noise: tuple[ARFilter, ...] | VectorAR | None = None
    rounds: int = eqx.field(static=True, default=0)
    optimum: Any = None

    @property
    def succeeded(self) -> bool:
        """Whether it converged."""
        return self.status is Status.converged

    @property
    def theta(self) -> Float[np.ndarray, " parameters"]:
        """Estimated values, in the order of `names`."""
        return np.asarray(self.loop.theta)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimated values."""
        return self.loop.names

    @property
    def std(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations, in the units of the parameters; infinite if not determined."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def units(self) -> tuple[str, ...]:
        """One unit for each value."""
        return tuple(unit for p in self.loop.free_parameters for unit in self.loop.units(p))

    @property
    def innovations(self) -> tuple[Float[np.ndarray, "_samples joints"], ...]:
        """Residuals through the inverse of the noise filters; zero if the past is not known."""
        noise = self.noise
        if isinstance(noise, VectorAR) and noise.outputs > self.loop.joints:
            raise FitError(
                "a coupled filter of torque and position has no innovations of torque alone: fit "
                "one of the two, or without coupled"
            )
        if noise is not None and not isinstance(noise, VectorAR):
            noise = noise[: self.loop.joints]
        return tuple(innovations(r, noise) for r in self.residuals)

    def whiteness(self, lags: int = 38) -> "pd.DataFrame":
        """Ljung and Box's test of residuals and innovations by joint, and the filter's order.

        **Arguments:**

        - `lags`: number of lags; at least twenty more than the order of a filter are used.
        """
        import pandas as pd

        rows = []
        for j in range(self.loop.joints):
            order = 0
            if isinstance(self.noise, VectorAR):
                order = self.noise.order
            elif self.noise is not None:
                order = self.noise[j].order
            reach = max(lags, order + 20)
            before = ljung_box([r[:, j] for r in self.residuals], reach)
            after = ljung_box([e[order:, j] for e in self.innovations], reach, order)
            rows.append((order, before.p_value, after.p_value))
        columns = ["order", "residuals_p", "innovations_p"]
        index = pd.Index(joint_columns(self.loop.joints), name="joint")
        return pd.DataFrame(rows, columns=columns, index=index)

    def table(self) -> "pd.DataFrame":
        """Value, unit, standard deviation and relative deviation (A.4) of each parameter."""
        import pandas as pd

        value, std = self.theta, self.std
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(value != 0, 100 * std / np.abs(value), np.inf)
        return pd.DataFrame(
            {"value": value, "std": std, "std_percent": relative, "unit": list(self.units)},
            index=pd.Index(self.names, name="parameter"),
        )

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain JSON."""
        return {
            "robot": self.loop.name,
            "method": repr(self.method),
            "status": self.status.name,
            "parameters": {
                name: {"value": value, "std": std if np.isfinite(std) else None, "unit": unit}
                for name, value, std, unit in zip(
                    self.names, self.theta.tolist(), self.std.tolist(), self.units, strict=True
                )
            },
            "error_percent": errors_to_dict(self.error_percent),
            "deviations": self.deviations,
            "undetermined": list(self.undetermined),
            "notes": list(self.notes),
            "mistake": self.mistake,
            "iterations": self.iterations,
            "seconds": self.seconds,
        }

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the fit to one file, which `jaxid.load` reads.

        **Arguments:**

        - `path`: by convention with the ending `.jaxid`; an existing file is replaced.

        **Raises:** `SaveError` if it cannot be written.
        """
        return save(self, path)

    def plot(self) -> "go.Figure":
        """The parameters with their deviations."""
        from ..display import figures

        std = np.where(np.isfinite(self.std), self.std, np.nan)
        return figures.parameters(list(self.names), self.theta, std, list(self.units))

    def __repr__(self) -> str:
        lines = [
            f"{self.method!r} of {self.loop.name} to {', '.join(self.recordings.names)}: "
            f"{self.status.value} ({self.iterations} iterations, {self.seconds:.2f} s)",
            self.table().to_string(float_format=lambda x: f"{x:.4g}"),
            "relative error, %:",
            self.error_percent.to_string(float_format=lambda x: f"{x:.3f}"),
        ]
        if self.deviations:
            lines.append(f"deviations: {self.deviations}")
        lines += [*self.undetermined, *self.notes]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        head = html.escape(repr(self).split("\n")[0])
        foot = "".join(f"<p>{html.escape(s)}</p>" for s in (*self.undetermined, *self.notes))
        return (
            f"<p>{head}</p>{self.table().to_html(float_format=lambda x: f'{x:.4g}')}"
            f"<p>relative error, %</p>{self.error_percent.to_html(float_format='%.3f')}{foot}"
        )


class AbstractMethod(eqx.Module):
    """An estimator with its settings.

    Class attribute, False by default: `rigid`, True for methods that assume that the sensors
    measure the motion of drives and links.
    """

    rigid: ClassVar[bool] = False

    def __check_init__(self):
        check_words(self)

    @abc.abstractmethod
    def fit(self, loop: ClosedLoop, recordings: Recordings) -> Fit:
        """Estimates the loop's free parameters; called by `jaxid.fit`."""


def joint_columns(joints: int) -> list[str]:
    """Column names for joints, counted from 1."""
    return [f"joint {j}" for j in range(1, joints + 1)]


def relative_errors(
    recordings: Recordings | Sequence[Recording],
    measured: Sequence[Float[np.ndarray, "_samples joints"]],
    residuals: Sequence[Float[np.ndarray, "_samples joints"]],
) -> "pd.DataFrame":
    """100 · ‖residual‖ / ‖measured‖ by recording and joint (Table 3 of Brunot et al. 2016).

    It is zero for a joint without compared samples in a recording: both norms are zero there.
    """
    import pandas as pd

    # The error of a diverging loop is infinite; no warning is needed.
    with np.errstate(over="ignore", divide="ignore"):
        rows = [
            100 * np.linalg.norm(e, axis=0) / np.where(m.any(axis=0) | e.any(axis=0), size, 1.0)
            for m, e in zip(measured, residuals, strict=True)
            for size in [np.linalg.norm(m, axis=0)]
        ]
    names = pd.Index([r.name for r in recordings], name="recording")
    return pd.DataFrame(rows, index=names, columns=joint_columns(measured[0].shape[1]))


def errors_to_dict(errors: "pd.DataFrame") -> dict[str, list[float | None]]:
    """Relative errors as JSON: a list of joints for each recording."""
    return {
        str(name): [float(x) if np.isfinite(x) else None for x in row]
        for name, row in zip(errors.index, errors.to_numpy(), strict=True)
    }


# Largest number of parameters that a sentence on a combination lists.
_MANY = 6


def determined_covariance(
    information: Float[np.ndarray, "parameters parameters"],
    names: Sequence[str],
    scales: Float[np.ndarray, " parameters"],
    meat: Float[np.ndarray, "parameters parameters"] | None = None,
) -> tuple[Float[np.ndarray, "parameters parameters"], tuple[str, ...]]:
    """The inverse of an information matrix, and the directions that the data do not determine.

    **Arguments:**

    - `information`: J'J of the weighted residuals.
    - `names`: names of its rows. `scales`: typical sizes of these parameters.
    - `meat`: covariance of the score if it is not `information`; the result is then the sandwich.
    """
    if not (np.isfinite(information).all() and (meat is None or np.isfinite(meat).all())):
        lost = "the signals' derivatives overflow float64, so deviations are unknown"
        return np.diag(np.full(len(names), np.inf)), (lost,)
    size = np.sqrt(np.maximum(np.diag(information), 0))
    # A parameter that has no influence even at ten thousand times its usual size: its column is due
    # to rounding.
    heard = size * scales > 1e-4
    size = np.where(heard, size, 0.0)
    information = information * np.outer(heard, heard)
    floor = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(floor, floor))
    # Columns have unit length and rounding is 1e-16, so along a direction with an eigenvalue below
    # 1e-11 the signals change by less than rounding.
    weak = values < 1e-11
    strong = vectors[:, ~weak]
    inverse = (strong / values[~weak]) @ strong.T / np.outer(floor, floor)
    covariance = inverse if meat is None else inverse @ meat @ inverse
    lost = np.zeros(len(names), bool)
    sentences = []
    for direction in vectors[:, weak].T:
        along = direction / floor
        along = along / np.abs(along).max()
        part = np.abs(direction) > 1e-3
        lost |= part
        involved = [(name, x) for name, x, on in zip(names, along, part, strict=True) if on]
        sentences.append(_without_change(involved))
    covariance = np.array(covariance)
    covariance[lost, :] = 0.0
    covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    return covariance, tuple(sentences)


def _without_change(involved: list[tuple[str, float]]) -> str:
    """The sentence on a combination of parameters that does not change the signals.

    **Arguments:**

    - `involved`: names and shares; if there are many, only the largest are in the sentence.
    """
    kept, names, more = involved, ", ".join(name for name, _ in involved), ""
    if len(involved) > _MANY:
        kept = sorted(involved, key=lambda one: -abs(one[1]))[:_MANY]
        names = f"{', '.join(name for name, _ in kept)} and {len(involved) - _MANY} more"
        more = " and smaller terms"
    terms = " ".join(f"{x:+.3g}·{name}" for name, x in kept)
    return (
        f"these recordings do not determine {names}: the signals do not change along {terms}{more}"
    )


def unphysical(loop: ClosedLoop) -> list[str]:
    """A note if the mass matrix is not positive definite."""
    if float(_smallest_inertia(loop.arm)) > 0:
        return []
    return ["these values are not physical: the mass matrix is not positive definite"]


_smallest_inertia = compiled(lambda arm: arm.smallest_inertia())
