"""Every effect of the catalogue held against the residual of one fit, without a refit."""

import dataclasses
import html
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import plotly.graph_objects as go
from jaxtyping import Float

from ..display import figures
from ..display.progress import working
from ..display.shown import AbstractShown
from ..effects import AbstractEffect, AbstractTransmission, Curve, Motion, Scene
from ..effects import catalogue as known
from ..errors import FitError, ModelError
from ..estimate import Fit
from ..estimate.oem import _free_starts, _signals, from_best_starts, oem_of, pieces_of
from ..noise import ARFilter
from ..parameters import write_values
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from ..simulation.runs import Batch, prepare, with_substeps
from ..storage.saved import save
from .comparison import Comparison
from .linear import Linearised, base_columns, linearise
from .score import Data, Gram, chance, corrected, effective_tests
from .separate import columns_of, estimate_noise, leftover
from .signatures import Hypothesis, amplitudes, candidates, curves, signatures, survey


class Verdict(eqx.Module):
    """What one hypothesis, at its best setting, explains.

    `evidence` is the whitened squared error it takes away, less log(samples) for each amplitude
    (twice the logarithm of odds, as BIC has it); `p_value` is corrected for all that was asked.
    """

    hypothesis: Hypothesis
    evidence: float
    explained: float
    freedom: int
    p_value: float
    possible: bool

    @property
    def key(self) -> tuple[str, int | None]:
        """Effect and joint."""
        return self.hypothesis.name, self.hypothesis.joint


class Diagnosis(AbstractShown):
    """Where a fitted model fails and which effects may be missing, ranked.

    - `ranking`: the catalogue's entries, each at its best setting, best first.
    - `forms`: the same for every form of an effect (class) on its own.
    - `where`: free-form curves of every coordinate, best first.
    - `pair`: two entries that together explain more than the best curve, where none does alone.
    - `noise`: the noise filter of each output.
    """

    fit: Fit | Comparison
    ranking: tuple[Verdict, ...]
    forms: tuple[Verdict, ...]
    where: tuple[Verdict, ...]
    pair: tuple[Verdict, ...]
    noise: tuple[ARFilter, ...]
    data: Data
    gram: Gram
    scene: Scene
    motion: Motion
    floor: Float[np.ndarray, "recordings joints"]
    tests: float
    significance: float = 0.01

    @property
    def best(self) -> AbstractEffect:
        """The leading effect of the catalogue at its predicted amplitude, ready to be added.

        **Raises:** `FitError` where nothing of the catalogue can be added.
        """
        for verdict in self.ranking:
            if verdict.possible:
                return self.predicted(verdict)
        raise FitError(
            "no effect of the catalogue explains anything of the residual: there is nothing to add"
        )

    @property
    def adequate(self) -> bool:
        """Whether nothing significant is left, neither for the catalogue nor for a curve."""
        return all(v.p_value > self.significance for v in (*self.ranking, *self.where))

    def light(self) -> "Diagnosis":
        """The same with the signatures of the ranking alone: all of them are large."""
        ranked = sorted({c for v in self.ranking for c in v.hypothesis.columns})
        return dataclasses.replace(self, data=self.data.only(ranked))

    def predicted(self, verdict: Verdict) -> AbstractEffect:
        """An effect with the amplitudes that its signature predicts."""
        effect, columns = verdict.hypothesis.effect, verdict.hypothesis.columns
        linear = amplitudes(effect)
        values, _ = self.gram.amplitude(columns)
        if not linear:
            return effect.scaled(float(np.clip(values[0], 0.05, 20.0)))
        return write_values(effect, linear, jnp.asarray(values))

    def amplitude(self, verdict: Verdict) -> tuple[np.ndarray, np.ndarray]:
        """Predicted amplitudes and their deviations, in the units of the effect's parameters."""
        values, covariance = self.gram.amplitude(verdict.hypothesis.columns)
        return values, np.sqrt(np.diag(covariance))

    def predicted_error(self, verdict: Verdict) -> Float[np.ndarray, " joints"]:
        """Relative error on the fitted recordings that adding the effect would leave, %."""
        rest = leftover(self.data, self.noise, verdict.hypothesis.columns)
        share = _share_left(self.fit, self.data, rest)
        return over_recordings(self.fit.error_percent.to_numpy() * share)

    def correlation(self, one: Verdict, other: Verdict) -> float:
        """Largest correlation of two effects' signatures, what the model absorbs taken off."""
        return self.gram.correlation(one.hypothesis.columns, other.hypothesis.columns)

    def alike(self, verdict: Verdict, within: float = 10.0) -> tuple[Verdict, ...]:
        """Effects that these recordings can hardly tell apart from one.

        Their evidence is within `within` of its own, and their signatures correlate above 0.9.
        """
        return tuple(
            other
            for other in self.ranking
            if other.key != verdict.key
            and other.evidence > verdict.evidence - within
            and self.correlation(verdict, other) > 0.9
        )

    def table(self) -> pd.DataFrame:
        """The ranking: what each explains, corrected p-value, amplitude, predicted error."""
        rows = []
        total = self.gram.rest
        for verdict in self.ranking:
            values, stds = self.amplitude(verdict)
            shown = [
                (name, self.fit.loop.unit(p))
                for p in amplitudes(verdict.hypothesis.effect)
                for name in p.names
            ]
            rows_of = zip(shown or [("setting", "1")], values, stds, strict=True)
            size = ", ".join(
                f"{s} {v:.3g} ± {d:.1g}{'' if unit == '1' else f' {unit}'}"
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

    def where_table(self) -> pd.DataFrame:
        """Where the model fails: on which coordinate which joint's torque depends, best first."""
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

    def plot(self) -> go.Figure:
        """The leading entries of the ranking by what they explain."""
        top = self.ranking[:12]
        labels = [_label(v) for v in top]
        shares = np.array([100 * v.explained / self.gram.rest for v in top])
        return figures.ranking(
            labels, shares, np.array([v.p_value < self.significance for v in top])
        )

    def plot_shares(self, recording: int = 0, joint: int = 1, contenders: int = 4) -> go.Figure:
        """What each contender explains of one joint's residual in time, the model refitted to it.

        **Arguments:**

        - `recording`: number from 0; of the piece, where the fit was in windows.
        - `joint`: counted from 1. `contenders`: how many.
        """
        keep = self.data.mask[recording]
        shares = {}
        for verdict in self.ranking[:contenders]:
            rest = leftover(self.data, self.noise, verdict.hypothesis.columns)
            shares[_label(verdict)] = (self.data.residual - rest)[recording, keep, joint - 1]
        record = pieces_of(self.fit.recordings, oem_of(self.fit).window)[recording]
        residual = self.data.residual[recording, keep, joint - 1]
        time = record.time[keep[: record.samples]]
        unit = self.fit.loop.arm.units()[0][joint - 1]
        return figures.shares_in_time(time, residual, shares, unit=unit)

    def plot_where(self, place: int = 0) -> go.Figure:
        """The residual of all recordings against a coordinate on which it depends, and its mean.

        Where it depends on the direction of motion as well, it is drawn times the sign of velocity.

        **Arguments:**

        - `place`: in `where`, 0 for the strongest.
        """
        curve = self.where[place].hypothesis.effect
        assert isinstance(curve, Curve)
        joint, motion = curve.joint, self.motion
        along = motion.t if curve.coordinate == "t" else getattr(motion, curve.coordinate)
        along = np.asarray(along if curve.coordinate == "t" else along[..., curve.of - 1])
        x, y = self._kept(along), self._kept(self.data.residual[..., joint - 1])
        if curve.signed:
            y = y * np.sign(self._kept(np.asarray(motion.v)[..., joint - 1]))
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
        """Writes the diagnosis to one file, from which `jaxid.load` gives it back.

        **Arguments:**

        - `path`: by convention with the ending `.jaxid`; a file that is there is replaced.

        **Raises:** `SaveError` where it cannot be written.
        """
        return save(self, path)

    def _kept(self, rows: Float[np.ndarray, "recordings points"]) -> Float[np.ndarray, " samples"]:
        """The samples of all recordings, one after the other."""
        return rows[self.data.mask]

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

    def next_experiment(self, **settings: Any) -> Any:
        """The reference that would tell look-alikes apart: see `jaxid.next_experiment`."""
        from .experiment import next_experiment

        return next_experiment(self, **settings)

    def depends_on(self) -> list[dict[str, Any]]:
        """Coordinates on which a significant part of the residual depends, best first."""
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
        """Relative error that a perfect model would leave on the fitted recordings, %."""
        return over_recordings(self.floor)

    def __repr__(self) -> str:
        table = self.table().head(12)
        state = "nothing significant is missing" if self.adequate else "something is missing"
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


def coordinate_unit(curve: Curve, torque: Sequence[str], position: Sequence[str]) -> str:
    """The unit of a curve's coordinate, given those of each joint's torque and position."""
    if curve.coordinate == "t":
        return "s"
    if curve.coordinate == "tau":
        return torque[curve.of - 1]
    return position[curve.of - 1] + {"v": "/s", "a": "/s²"}.get(curve.coordinate, "")


def diagnose(
    fit: Fit | Comparison,
    *,
    catalogue: Sequence[Any] = known,
    significance: float = 0.01,
    progress: bool = True,
) -> Diagnosis:
    """Screens every effect of a catalogue, on all joints, at all settings, from one fit.

    Exact sensitivities make it cheap: the closed loop is linearised along its runs, and every
    hypothesis is the response of that linear system to its torque.

    **Arguments:**

    - `fit`: of a loop that can be simulated; or a comparison of a loop with recordings.
    - `catalogue`: effect classes, effects, or functions from a `Scene` to effects; for instance
      `(*jaxid.catalogue, Mine)`.
    - `significance`: corrected p-value below which something counts as missing.

    **Raises:** `FitError` where the fitted loop cannot be simulated; `RecordingError` where
    recordings were sampled at different rates.
    """
    fit.recordings.common_period()
    if fit.error_percent.to_numpy().max() < 1e-8:
        raise FitError(
            f"{fit.loop.name} leaves nothing of these recordings but rounding: they were simulated "
            "with it, and there is nothing to diagnose"
        )
    with working(f"diagnosis of {fit.loop.name}", progress) as say:
        loop = with_substeps(fit.loop, fit.recordings)
        output, batch, free = _as_fitted(fit, loop)
        say("linearising along the recordings")
        linear = linearise(loop, batch, output)
        residual, base = _residual_and_base(batch, linear, loop, output, free)
        if not np.isfinite(residual).all() or not np.isfinite(base).all():
            raise FitError(
                f"{loop.name} cannot be simulated at its fitted values, so nothing can be held "
                "against its residual: fit it by OEM first"
            )
        tones, trials = _tones(residual, np.asarray(batch.kept), fit.recordings)
        scene = survey(loop, fit.recordings, linear.motion, tones)
        proposed = candidates(catalogue, scene, trials)
        parted = {e.joint for e in loop.effects if isinstance(e, AbstractTransmission)}
        proposed = [
            (effect, tests)
            for effect, tests in proposed
            if not (isinstance(effect, AbstractTransmission) and effect.joint in parted)
        ]
        proposed += [(curve, 1.0) for curve in curves(scene, linear.motion)]
        row = {"tau": 0, "q": 1}[output]
        hypotheses, table = signatures(loop, batch, linear, proposed, row, say)
        _check_finite(loop, hypotheses, table)
        table = _at_samples(batch, table)
        data = Data(residual, base, table, np.asarray(batch.kept))
        say(f"scoring {len(hypotheses)} hypotheses")
        try:
            motion = _sampled(batch, linear.motion)
            return _judge(fit, data, hypotheses, scene, motion, significance)
        except np.linalg.LinAlgError as error:
            raise FitError(
                f"what is left of these recordings by {loop.name} is too large to be held against "
                "anything: check the units of the recordings and the loop's gains"
            ) from error


def _check_finite(
    loop: ClosedLoop,
    hypotheses: Sequence[Hypothesis],
    table: Float[np.ndarray, "recordings points outputs columns"],
) -> None:
    """Raises `FitError` where a signature is not finite."""
    there = np.asarray(np.isfinite(table).all(axis=(0, 1, 2)))
    bad = [h for h in hypotheses if not there[list(h.columns)].all()]
    if len(bad) > len(hypotheses) / 2:
        raise FitError(
            f"{loop.name} runs away once it is linearised along these recordings: take smaller "
            "steps, jaxid.Stepping(substeps=...)"
        )
    if bad:
        first = bad[0]
        raise FitError(
            f"the signature of {first.name} on joint {first.joint or 'all'} is not finite along "
            "these recordings: mend its torque, or leave it out of the catalogue"
        )


def _as_fitted(fit: Fit | Comparison, loop: ClosedLoop) -> tuple[str, Batch, np.ndarray]:
    """Which output is compared, the batch, and which initial states are free, as in the fit."""
    method = oem_of(fit)
    pieces = pieces_of(fit.recordings, method.window)
    batch = prepare(loop, pieces)
    free = _free_starts(method, pieces, batch)
    if free.any():
        start, n = getattr(getattr(fit, "optimum", None), "start", None), loop.joints
        if start is not None and len(start) == len(pieces):
            batch = dataclasses.replace(batch, q0=start[:, :n], v0=start[:, n:])
        else:
            batch = from_best_starts(method, loop, pieces, batch)
    return _signals(method, loop)[0], batch, free


def _sampled(batch: Batch, tree: Any) -> Any:
    """Leaves of `(recordings, points, ...)` at the samples alone, of a grid that may be finer."""
    if batch.at is None:
        return tree
    rows = np.arange(len(batch.at))[:, None], np.asarray(batch.at)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[rows], tree)


def _at_samples(batch: Batch, x: Float[np.ndarray, "recordings points *axes"]) -> np.ndarray:
    """Rows at the samples, in the band that is compared, zero where there is no sample."""
    x = _sampled(batch, x)
    mask = np.asarray(batch.mask).reshape(*batch.mask.shape, *(1,) * (x.ndim - 2))
    x = x * mask.astype(x.dtype)
    return x if batch.band is None else np.asarray(batch.band(jnp.asarray(x)), x.dtype)


def _residual_and_base(
    batch: Batch, linear: Linearised, loop: ClosedLoop, output: str, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    seen = _sampled(batch, np.asarray(linear.seen[:, :, {"tau": 0, "q": 1}[output]]))
    residual = (np.asarray(getattr(batch, output)) - seen) * np.asarray(batch.mask)[..., None]
    if batch.band is not None:
        residual = np.asarray(batch.band(jnp.asarray(residual)))
    p = loop.theta.shape[0]
    base = _at_samples(batch, np.asarray(base_columns(linear, p, bool(free.any()))))
    if not free.any():
        return residual, base
    shared, own = base[..., :p], base[..., p:]
    blocks = [shared]
    for k in np.flatnonzero(free):
        alone = np.zeros_like(own)
        alone[k] = own[k]
        blocks.append(alone)
    return residual, np.concatenate(blocks, axis=-1)


def _tones(
    residual: np.ndarray, mask: np.ndarray, recordings: Recordings, most: int = 4
) -> tuple[list[list[float]], float]:
    """Frequencies that stand out of each joint's spectrum, and how many they were picked from."""
    period = recordings.common_period()
    n = residual.shape[1]
    f = np.fft.rfftfreq(4 * n, period)
    usable = (f > 2 / (n * period)) & (f < 0.4 / period)
    found = []
    for j in range(residual.shape[2]):
        power = np.zeros(len(f))
        for row, there in zip(residual[..., j], mask, strict=True):
            window = np.zeros(n)
            window[there] = np.hanning(int(there.sum()))
            power += np.abs(np.fft.rfft(row * window, 4 * n)) ** 2
        # Against the level around it, so that coloured noise does not take every place.
        width = max(9, n // 20)
        around = np.exp(np.convolve(np.log(power + 1e-300), np.ones(width) / width, mode="same"))
        stands = np.where(usable, power / around, 0.0)
        row = []
        for _ in range(most):
            k = int(stands.argmax())
            row.append(float(f[k]))
            stands[np.abs(f - f[k]) < 2 / (n * period)] = 0.0
        found.append(row)
    return found, float(usable.sum() / 4 * residual.shape[2])


# Rows from which noise is told from physics as well as from all: a minute of two joints at 400 Hz.
_ENOUGH = 50_000


def _judge(
    fit: Fit | Comparison,
    data: Data,
    hypotheses: list[Hypothesis],
    scene: Scene,
    motion: Motion,
    significance: float,
) -> Diagnosis:
    blocks = [h.columns for h in hypotheses]
    windows = len(data.residual) != len(fit.recordings)
    apart = estimate_noise(data.middle(_ENOUGH), blocks, alike=windows)
    data, noise = dataclasses.replace(data, level=apart.data.level), apart.noise
    gram = Gram.of(data, noise)
    tests = effective_tests(gram, blocks)
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
    best = tuple(sorted(ranking.values(), key=_order, reverse=True))
    curves = tuple(sorted(where.values(), key=_order, reverse=True))
    return Diagnosis(
        fit,
        best,
        tuple(sorted(forms.values(), key=_order, reverse=True)),
        curves,
        _pair(gram, hypotheses, best, curves, tests),
        noise,
        data,
        gram,
        scene,
        motion,
        _floor(fit, data, leftover(data, noise, columns), len(columns)),
        tests,
        significance,
    )


def _pair(
    gram: Gram,
    hypotheses: list[Hypothesis],
    ranking: tuple[Verdict, ...],
    where: tuple[Verdict, ...],
    tests: float,
) -> tuple[Verdict, ...]:
    """Two effects that only together explain what the best curve does, each leading entry tried."""
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
    """Keeps the better of two settings; one that is not physical gives way to one that is."""
    old = found.get(key)
    if old is None or (new.possible, new.evidence) > (old.possible, old.evidence):
        found[key] = new


def _order(verdict: Verdict) -> float:
    return verdict.evidence


def _verdict(
    gram: Gram, hypothesis: Hypothesis, explained: float, freedom: int, tests: float
) -> Verdict:
    p = corrected(min(1.0, chance(explained, freedom) * hypothesis.tests), tests)
    price = freedom * np.log(gram.count) + 2 * np.log(hypothesis.tests)
    possible = freedom > 0 and _within_bounds(gram, hypothesis)
    return Verdict(hypothesis, explained - float(price), explained, freedom, p, possible)


def _within_bounds(gram: Gram, hypothesis: Hypothesis) -> bool:
    """Whether the predicted amplitudes are physical (a drag that pushes is not)."""
    values, _ = gram.amplitude(hypothesis.columns)
    return all(
        low < value < high
        for value, low, high in zip(values, hypothesis.lower, hypothesis.upper, strict=True)
    )


def _floor(
    fit: Fit | Comparison, data: Data, rest: np.ndarray, lost: int
) -> Float[np.ndarray, "recordings joints"]:
    """Relative error by recording and joint of noise alone, what the model took of it put back."""
    outputs = data.residual.shape[2]
    freedom = 1 - (data.base.shape[-1] + lost) / (data.mask.sum() * outputs)
    # What is least once whitened may be more than what the model leaves as it is.
    share = np.minimum(_share_left(fit, data, rest), 1) / np.sqrt(max(freedom, 0.1))
    return fit.error_percent.to_numpy() * share


def _share_left(
    fit: Fit | Comparison, data: Data, rest: np.ndarray
) -> Float[np.ndarray, "recordings joints"]:
    """What is left of a fit's error; of all its recordings together where data are windows."""
    over = 1 if len(data.residual) == len(fit.residuals) else (0, 1)
    share = np.sqrt(np.sum(rest**2, axis=over) / np.sum(data.residual**2, axis=over))
    return np.broadcast_to(share, (len(fit.residuals), data.residual.shape[2]))


def over_recordings(
    percent: Float[np.ndarray, "recordings joints"],
) -> Float[np.ndarray, " joints"]:
    """Relative errors of several recordings in one for each joint: their quadratic mean, %."""
    return np.sqrt(np.mean(percent**2, axis=0))


def on_recordings(effect: AbstractEffect) -> str:
    """The recordings that an effect is on, as a sentence goes on; nothing where it is on all."""
    named = getattr(effect, "recordings", ())
    return f" in {' and '.join(named)}" if named else ""


def effect_parameters(loop: ClosedLoop, effect: AbstractEffect) -> list[tuple[int, str, str]]:
    """Where an effect's free values stand in `loop.theta`: place, name in the effect, unit.

    **Raises:** `ModelError` where the loop does not have the effect.
    """
    position = next((k for k, e in enumerate(loop.effects) if e is effect), None)
    if position is None:
        raise ModelError(f"{effect.effect_name()} is not one of the loop's effects: add it first")
    found, place = [], 0
    for p in loop.free_parameters:
        steps = p.where.steps  # type: ignore[attr-defined]
        if steps[:2] == ("effects", position):
            for k in range(p.size):
                name = steps[-1] if not p.several else f"{steps[-1]}[{k + 1}]"
                found.append((place + k, str(name), loop.unit(p)))
        place += p.size
    return found
