"""The result of a diagnosis: where a fitted model fails, and which effects may be missing."""

import dataclasses
import html
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..display.shown import AbstractShown
from ..effects import AbstractEffect, Curve, Motion, Scene
from ..effects.curve import coordinate_unit
from ..errors import FitError
from ..estimate import Fit
from ..noise import ARFilter
from ..storage.saved import save
from .bounded import within_bounds
from .comparison import Comparison
from .data import Data
from .floor import Floor
from .hypotheses import Hypothesis, amplitude_names, on_recordings, sized
from .score import Gram
from .separate import leftover

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


class Verdict(eqx.Module):
    """How much one hypothesis, at its best setting, explains.

    `evidence` is the reduction of the whitened squared error, minus log(samples) for each amplitude
    (twice the logarithm of the odds, as in BIC); `p_value` is corrected for all tests. Along a
    recorded motion both are corrected for its noise, and `wider` is the variance of the score over
    that with an exact motion.
    """

    hypothesis: Hypothesis
    evidence: float
    explained: float
    freedom: int
    p_value: float
    possible: bool
    wider: float = 1.0

    @property
    def key(self) -> tuple[str, int | None]:
        """Name of the effect and its joint."""
        return self.hypothesis.name, self.hypothesis.joint


# Number of curves whose data a saved discovery keeps for fitting.
_CURVES = 6
# Leading entries of a ranking of which is drawn what they explain over time.
_DRAWN = 4


class Diagnosis(AbstractShown):
    """Where a fitted model fails and which effects may be missing, ranked.

    - `ranking`: the catalogue's entries, each at its best setting, best first.
    - `forms`: the same for each form of an effect (class) separately.
    - `where`: free-form curves over every coordinate, best first.
    - `noise`: the noise filter of each output.
    - `floor`: relative error that a model with every effect and curve that matters leaves, %.
    - `measured`: the noise floor from the recordings alone, if they determine it.
    - `unexplained`: improvement of the score of the model of `floor` over that of the fit.
    - `errors`: predicted errors of the ranking where no signatures are kept, %, and `shares`: what
      its leading entries explain of the residual.
    """

    fit: Fit | Comparison
    ranking: tuple[Verdict, ...]
    forms: tuple[Verdict, ...]
    where: tuple[Verdict, ...]
    noise: tuple[ARFilter, ...]
    data: Data
    gram: Gram
    scene: Scene
    motion: Motion
    floor: Float[np.ndarray, "recordings joints"]
    tests: float
    significance: float = 0.01
    unexplained: float = 0.0
    measured: Floor | None = None
    errors: Float[np.ndarray, "ranked joints"] | None = None
    shares: Float[np.ndarray, "drawn recordings samples outputs"] | None = None

    @classmethod
    def fields_of_format(cls, fields: dict[str, Any], written: int) -> dict[str, Any]:
        """Drops a field of older file formats."""
        return fields if written > 4 else {k: x for k, x in fields.items() if k != "pair"}

    @property
    def best(self) -> AbstractEffect:
        """The leading effect of the catalogue at its predicted amplitude, ready to be added.

        **Raises:** `FitError` if no effect of the catalogue can be added.
        """
        for verdict in self.ranking:
            if verdict.possible:
                return self.predicted(verdict)
        raise FitError(
            "no effect of the catalogue explains anything of the residual: there is nothing to add"
        )

    @property
    def adequate(self) -> bool:
        """Whether no effect of the catalogue and no curve is significant."""
        return all(v.p_value > self.significance for v in (*self.ranking, *self.where))

    def light(self) -> "Diagnosis":
        """The same with only the signatures of the ranking, to save memory.

        For curves, only the products of the first few are kept, because only these are drawn.
        """
        ranked = sorted({c for v in self.ranking for c in v.hypothesis.columns})
        told = (*self.ranking, *self.forms, *self.where[:_CURVES])
        products = sorted({c for v in told for c in v.hypothesis.columns})
        return dataclasses.replace(self, data=self.data.only(ranked), gram=self.gram.only(products))

    def stored(self) -> "Diagnosis":
        """The same for a file: what is shown of signatures in place of them."""
        errors = [self.predicted_error(v) for v in self.ranking]
        shares = [self._share(v).astype(np.float32) for v in self.ranking[:_DRAWN]]
        data = dataclasses.replace(self.data.only(()), base=self.data.base[..., :0])

        def drawn(motion: Motion) -> tuple[Any, ...]:
            return motion.q, motion.v, motion.a, motion.tau

        single = [np.asarray(x, np.float32) for x in drawn(self.motion)]
        return dataclasses.replace(
            self,
            data=data,
            motion=eqx.tree_at(drawn, self.motion, single),
            errors=np.array(errors),
            shares=np.array(shares),
        )

    def _share(self, verdict: Verdict) -> Float[np.ndarray, "recordings samples outputs"]:
        """What an entry explains of the residual after a refit, N·m or N."""
        if self.shares is not None:
            for share, leading in zip(self.shares, self.ranking, strict=False):
                if leading is verdict:
                    return share
        return self.data.residual - leftover(self.data, self.noise, verdict.hypothesis.columns)

    def predicted(self, verdict: Verdict) -> AbstractEffect:
        """An effect with the amplitudes that its signature predicts, within their bounds.

        If all of them are at a bound (`verdict.possible` is false), they are those without bounds.
        """
        values, explained = within_bounds(self.gram, verdict.hypothesis)
        if not explained > 0:
            values, _ = self.gram.amplitude(verdict.hypothesis.columns)
        return sized(verdict.hypothesis.effect, values)

    def amplitude(self, verdict: Verdict) -> tuple[np.ndarray, np.ndarray]:
        """Predicted amplitudes and standard deviations, in the units of the effect's parameters."""
        values, covariance = self.gram.amplitude(verdict.hypothesis.columns)
        return values, np.sqrt(verdict.wider * np.diag(covariance))

    def predicted_error(self, verdict: Verdict) -> Float[np.ndarray, " joints"]:
        """Relative error on the fitted recordings that adding the effect would leave, %."""
        if self.errors is not None:
            place = next((k for k, v in enumerate(self.ranking) if v is verdict), None)
            if place is not None:
                return self.errors[place]
        rest = leftover(self.data, self.noise, verdict.hypothesis.columns)
        share = share_left(self.fit, self.data, rest)
        return over_recordings(self.fit.error_percent.to_numpy() * share)

    def correlation(self, one: Verdict, other: Verdict) -> float:
        """Largest correlation of two effects' signatures after projection of the model."""
        return self.gram.correlation(one.hypothesis.columns, other.hypothesis.columns)

    def alike(self, verdict: Verdict, within: float = 10.0) -> tuple[Verdict, ...]:
        """Effects that these recordings can hardly distinguish from the given one.

        Their evidence is at most `within` below its own, and the signatures correlate above 0.9.
        """
        return tuple(
            other
            for other in self.ranking
            if other.key != verdict.key
            and other.evidence > verdict.evidence - within
            and self.correlation(verdict, other) > 0.9
        )

    def table(self) -> "pd.DataFrame":
        """The ranking: explained share, corrected p-value, amplitude and predicted error."""
        import pandas as pd

        rows = []
        total = self.gram.rest
        for verdict in self.ranking:
            values, stds = self.amplitude(verdict)
            shown = amplitude_names(self.fit.loop, verdict.hypothesis.effect)
            rows_of = zip(shown or [("setting", "1")], values, stds, strict=True)
            size = ", ".join(
                f"{s} {_digits(v, 3)} ± {_digits(d, 1)}{'' if unit == '1' else f' {unit}'}"
                for (s, unit), v, d in rows_of
            )
            error = self.predicted_error(verdict) if verdict.p_value < 0.05 else None
            rows.append(
                {
                    "effect": verdict.hypothesis.name,
                    "joint": "all"
                    if verdict.hypothesis.joint is None
                    else verdict.hypothesis.joint,
                    "p_value": verdict.p_value,
                    "explained_percent": 100 * verdict.explained / total if total else 0.0,
                    "evidence": verdict.evidence,
                    "amplitude": size + on_recordings(verdict.hypothesis.effect),
                    "predicted_error_percent": None
                    if error is None
                    else ", ".join(f"{x:.2f}" for x in error),
                    "possible": verdict.possible,
                }
            )
        return pd.DataFrame(rows)

    def where_table(self) -> "pd.DataFrame":
        """Where the model fails: joint and coordinate of its residual, best first."""
        import pandas as pd

        total = self.gram.rest
        return pd.DataFrame(
            [
                {
                    "coordinate": verdict.hypothesis.effect.label,  # type: ignore[attr-defined]
                    "times_sign_of_v": verdict.hypothesis.effect.signed,  # type: ignore[attr-defined]
                    "joint": verdict.hypothesis.joint,
                    "p_value": verdict.p_value,
                    "explained_percent": 100 * verdict.explained / total if total else 0.0,
                }
                for verdict in self.where
            ]
        )

    def plot(self) -> "go.Figure":
        """Bars of the share that the leading entries of the ranking explain."""
        from ..display import figures

        top = self.ranking[:12]
        labels = [_label(v) for v in top]
        shares = np.array([100 * v.explained / self.gram.rest for v in top])
        return figures.ranking(
            labels, shares, np.array([v.p_value < self.significance for v in top])
        )

    def plot_shares(
        self, recording: int = 0, joint: int = 1, contenders: int = _DRAWN
    ) -> "go.Figure":
        """The part of one joint's residual over time that each contender explains after a refit.

        **Arguments:**

        - `recording`: number from 0; the number of the piece if the fit was in windows.
        - `joint`: counted from 1. `contenders`: number of contenders to draw.
        """
        from ..display import figures

        keep = self.data.mask[recording]
        shares = {}
        for verdict in self.ranking[:contenders]:
            shares[_label(verdict)] = self._share(verdict)[recording, keep, joint - 1]
        residual = self.data.residual[recording, keep, joint - 1]
        time = np.asarray(self.motion.t)[recording, keep]
        unit = self.fit.loop.arm.units()[0][joint - 1]
        return figures.shares_in_time(time, residual, shares, unit=unit)

    def plot_where(self, place: int = 0) -> "go.Figure":
        """The residual of all recordings against a coordinate on which it depends, and its mean.

        If it also depends on the direction of motion, it is multiplied by the sign of velocity.

        **Arguments:**

        - `place`: index in `where`; 0 is the strongest.
        """
        from ..display import figures

        curve = self.where[place].hypothesis.effect
        assert isinstance(curve, Curve)
        joint, motion = curve.joint, self.motion
        along = motion.t if curve.coordinate == "t" else getattr(motion, curve.coordinate)
        along = np.asarray(along if curve.coordinate == "t" else along[..., curve.of - 1])
        residual = self.data.residual[..., joint - 1]
        # It is zero while the joint is at rest, if its standstill is left out.
        there = self.data.mask & (residual != 0)
        x, y = along[there], residual[there]
        if curve.signed:
            y = y * np.sign(np.asarray(motion.v)[..., joint - 1][there])
        torque, position = self.fit.loop.arm.units()
        return figures.dependence(
            x,
            y,
            curve.spoken_coordinate,
            coordinate_unit(curve, torque, position),
            torque[joint - 1],
            y_name=f"residual of joint {joint}" + (" × sign of velocity" if curve.signed else ""),
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the diagnosis to one file, which `jaxid.load` reads.

        **Arguments:**

        - `path`: by convention with the ending `.jaxid`; an existing file is replaced.

        **Raises:** `SaveError` if it cannot be written.
        """
        return save(self, path)

    def to_dict(self) -> dict[str, Any]:
        """The ranking and where the model fails, as plain JSON."""
        return {
            "robot": self.fit.loop.name,
            "ranking": [
                {
                    "effect": v.hypothesis.name,
                    "joint": v.hypothesis.joint,
                    "p_value": v.p_value,
                    "predicted_error_percent": self.predicted_error(v).tolist(),
                }
                for v in self.ranking
            ],
            "depends_on": self.depends_on(),
            "noise_floor_percent": self.floor_percent().tolist(),
        }

    def depends_on(self) -> list[dict[str, Any]]:
        """Coordinates that explain a significant part of the residual, best first."""
        return [
            {
                "coordinate": v.hypothesis.effect.label,  # type: ignore[attr-defined]
                "joint": v.hypothesis.joint,
                "p_value": v.p_value,
            }
            for v in self.where
            if v.p_value < self.significance
        ]

    def floor_percent(self) -> Float[np.ndarray, " joints"]:
        """Relative error that a perfect model would leave on the fitted recordings, %.

        It is estimated from the recordings alone if they determine it, otherwise by a model with
        every effect and curve that matters.
        """
        return over_recordings(self.floor_by_recording())

    def floor_by_recording(self) -> Float[np.ndarray, "recordings joints"]:
        """As `floor_percent`, for each recording."""
        if self.measured is None:
            return self.floor
        return np.where(np.isfinite(self.measured.percent), self.measured.percent, self.floor)

    def floor_sources(self) -> tuple[tuple[str, ...], ...]:
        """Sources of the noise floor by joint: measurement methods, or "rich model"."""
        if self.measured is None:
            return (("rich model",),) * self.floor.shape[1]
        return tuple(
            tuple(dict.fromkeys(source or "rich model" for source in column))
            for column in zip(*self.measured.sources, strict=True)
        )

    def __repr__(self) -> str:
        table = self.table().head(12)
        state = "nothing significant is missing" if self.adequate else "something is missing"
        if isinstance(self.fit, Fit) and self.fit.mistake:
            # Effects would only approximate the mistake.
            state = f"{self.fit.mistake}; correct this first"
        return (
            f"{self.fit.loop.name}: {state}; noise floor "
            f"{', '.join(f'{x:.2f}' for x in self.floor_percent())} %\n"
            f"{table.to_string(index=False, float_format=lambda x: f'{x:.3g}')}"
        )

    def _repr_html_(self) -> str:
        head = html.escape(repr(self).split("\n")[0])
        return f"<p>{head}</p>{self.table().to_html(index=False, float_format='%.3g')}"


def _label(verdict: Verdict) -> str:
    joint = verdict.hypothesis.joint
    return verdict.hypothesis.name + ("" if joint is None else f", joint {joint}")


def share_left(
    fit: Fit | Comparison, data: Data, rest: np.ndarray
) -> Float[np.ndarray, "recordings joints"]:
    """Remaining share of a fit's error; over all recordings together if data are windows."""
    over = 1 if len(data.residual) == len(fit.residuals) else (0, 1)
    share = np.sqrt(np.sum(rest**2, axis=over) / np.sum(data.residual**2, axis=over))
    return np.broadcast_to(share, (len(fit.residuals), data.residual.shape[2]))


def over_recordings(
    percent: Float[np.ndarray, "recordings joints"],
) -> Float[np.ndarray, " joints"]:
    """Root mean square of the relative errors of several recordings, one per joint, %."""
    return np.sqrt(np.mean(percent**2, axis=0))


def _digits(value: float, digits: int) -> str:
    """A number rounded to a number of digits; up to a million without an exponent."""
    return f"{float(f'{value:.{digits}g}'):g}"
