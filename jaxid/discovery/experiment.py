"""What to record next to distinguish effects that look alike."""

import dataclasses
import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..control import OpenLoop
from ..display.shown import AbstractShown
from ..errors import FitError
from ..excitation import Limits
from ..recording import Recording
from ..simulation.batch import prepare
from ..simulation.loop import ClosedLoop
from ..simulation.steps import with_substeps
from .data import Data
from .diagnosis import Diagnosis, Verdict
from .hypotheses import effect_on
from .linear import at_samples, base_columns, linearise, sampled
from .score import Gram
from .signatures import signatures

if TYPE_CHECKING:
    import plotly.graph_objects as go


class Experiment(AbstractShown):
    """A reference to record next.

    - `recording`: its `time` and `q_ref`; `q` and `tau` are predictions of the model.
    - `now`, `then`: whitened squared error by which the effects differ, on the present recordings
      and on the proposed one; ten is decisive.
    - `units`: units of torque and of position, one for each joint.
    """

    recording: Recording
    effects: tuple[str, ...] = eqx.field(static=True)
    now: float
    then: float
    units: tuple[tuple[str, ...], tuple[str, ...]] = eqx.field(static=True)

    def plot(self) -> "go.Figure":
        """The reference in time."""
        from ..display import figures

        r = self.recording
        assert r.q_ref is not None
        panels = [
            [figures.Trace(f"joint {j}", column, unit, "reference")]
            for j, (column, unit) in enumerate(zip(r.q_ref.T, self.units[1], strict=True), start=1)
        ]
        return figures.signals(r.time, panels)

    def _repr_html_(self) -> str:
        import pandas as pd

        r = self.recording
        assert r.q_ref is not None
        speed = np.abs(np.gradient(r.q_ref, r.time, axis=0))
        rows = [
            {
                "from": f"{r.q_ref[:, j].min():.3g} {position}",
                "to": f"{r.q_ref[:, j].max():.3g} {position}",
                "speed up to": f"{speed[:, j].max():.3g} {position}/s",
                "torque up to": f"{np.abs(r.tau[:, j]).max():.3g} {torque}",
            }
            for j, (torque, position) in enumerate(zip(*self.units, strict=True))
        ]
        table = pd.DataFrame(rows, index=[f"joint {j}" for j in range(1, r.joints + 1)])
        return f"<p>{html.escape(repr(self))}</p>{table.to_html()}"

    def __repr__(self) -> str:
        said = (
            f"a reference of {self.recording.duration:.0f} s that distinguishes "
            f"{' and '.join(self.effects)} by {self.then:.3g} in whitened squared error; the "
            f"present recordings do by {self.now:.3g} (ten is decisive)"
        )
        if self.then > self.now:
            return said
        return (
            f"{said}, so it is worth less than what is recorded: propose one with a longer "
            "duration, wider limits or more tries"
        )


def next_experiment(
    diagnosis: Diagnosis,
    effects: Sequence[Verdict] | None = None,
    *,
    limits: Limits | None = None,
    duration: float = 20.0,
    tries: int = 24,
    seed: int = 0,
) -> Experiment:
    """Proposes a reference on which effects that look alike differ most.

    Random multi-sines are scaled to the limits and simulated; the best one is returned.

    **Arguments:**

    - `effects`: two or more entries of the ranking; by default the leader and its look-alikes. For
      a single effect, the reference is the one that determines its amplitude best.
    - `limits`: by default those that the present recordings have reached.
    - `duration`: s. `tries`: number of random references.

    **Raises:** `FitError` if there is nothing to compare, no reference is within the limits, or the
    loop cannot follow a reference.
    """
    if isinstance(diagnosis.fit.loop.controller, OpenLoop):
        raise FitError(
            "the recorded torque drives this loop, so it cannot follow a reference: give the loop "
            "its controller"
        )
    chosen = list(effects) if effects is not None else _group(diagnosis)
    # Too slow to repeat for each reference.
    asked, simulated = chosen, [v for v in chosen if v.hypothesis.effect.finite]
    chosen = [v for v in asked if not v.hypothesis.effect.finite]
    if simulated and len(chosen) < min(len(asked), 2):
        raise FitError(
            f"the signature of {effect_on(*simulated[0].key)} needs simulations, too slow to "
            "repeat for each reference: give two other effects"
        )
    bounds = Limits.of(diagnosis.fit.recordings) if limits is None else limits
    loop = with_substeps(diagnosis.fit.loop, diagnosis.fit.recordings)
    period = float(np.median([r.period for r in diagnosis.fit.recordings]))
    drawn = [
        _draw(bounds, duration, period, np.random.default_rng([seed, k])) for k in range(tries)
    ]
    scores, runs = _separations(loop, drawn, chosen, diagnosis, bounds)
    if not np.isfinite(scores).any():
        raise FitError(
            "none of the random references keeps the torque within its limits: raise "
            "limits.torque, or lower limits.speed"
        )
    best = int(np.nanargmax(np.where(np.isfinite(scores), scores, np.nan)))
    names = tuple(effect_on(*v.key) for v in chosen)
    numbers = [list(v.hypothesis.columns) for v in chosen]
    sizes = [diagnosis.gram.amplitude(c)[0] for c in numbers]
    flat = [c for columns in numbers for c in columns]
    # Only the products of these effects, with columns counted from zero.
    at_hand = dataclasses.replace(diagnosis.gram.only(flat), kept=None)
    columns = [[flat.index(c) for c in own] for own in numbers]
    now = _apart(at_hand, columns, sizes)
    return Experiment(
        recording=runs[best],
        effects=names,
        now=now,
        then=float(scores[best]),
        units=loop.arm.units(),
    )


def _group(diagnosis: Diagnosis) -> list[Verdict]:
    if not diagnosis.ranking:
        raise FitError("nothing was screened, so there are no effects to distinguish")
    leader = diagnosis.ranking[0]
    return [leader, *diagnosis.alike(leader, within=30.0)][:3]


def _draw(limits: Limits, duration: float, period: float, rng: np.random.Generator) -> Recording:
    """A random multi-sine from rest, as large as the limits allow."""
    time = np.arange(round(duration / period) + 1) * period
    ramp = np.clip(time / min(2.0, duration / 5), 0, 1)
    ramp = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    columns = []
    for j in range(len(limits.low)):
        top = rng.uniform(0.3, 1.0) * limits.acceleration[j] / max(limits.speed[j], 1e-9) / np.pi
        f = rng.uniform(0.05, max(top, 0.1), 6)
        wave = np.sin(2 * np.pi * np.outer(time, f) + rng.uniform(0, 2 * np.pi, 6))
        x = wave @ rng.normal(size=6)
        x = (x - x[0]) * ramp
        v = np.gradient(x, period)
        a = np.gradient(v, period)
        span = limits.high[j] - limits.low[j]
        scale = min(
            span / max(np.ptp(x), 1e-12),
            limits.speed[j] / max(np.abs(v).max(), 1e-12),
            limits.acceleration[j] / max(np.abs(a).max(), 1e-12),
        )
        x = scale * x
        # At a random place within the limits, because a signature may depend on it.
        low, high = limits.low[j] - x.min(), limits.high[j] - x.max()
        columns.append(x + rng.uniform(min(low, high), max(low, high)))
    q_ref = np.stack(columns, axis=1)
    return Recording(time, q_ref, np.ones_like(q_ref), q_ref=q_ref, name="next")


def _separations(
    loop: ClosedLoop,
    drawn: Sequence[Recording],
    chosen: Sequence[Verdict],
    diagnosis: Diagnosis,
    limits: Limits,
) -> tuple[Float[np.ndarray, " tries"], list[Recording]]:
    """How much the effects differ on each reference; NaN if a limit is exceeded."""
    batch = prepare(loop, drawn)
    linear = linearise(loop, batch, "tau")
    proposed = [(v.hypothesis.effect, 1.0) for v in chosen]
    hypotheses, table = signatures(loop, batch, linear, proposed, 0, lambda text: None)
    base = at_samples(batch, np.asarray(base_columns(linear, loop.theta.shape[0], False)))
    seen = sampled(batch, np.asarray(linear.seen))
    kept = np.asarray(batch.kept)
    columns = [list(h.columns) for h in hypotheses]
    sizes = [diagnosis.gram.amplitude(v.hypothesis.columns)[0] for v in chosen]
    scores, runs = np.full(len(drawn), np.nan), []
    for k, recording in enumerate(drawn):
        tau, q = seen[k, : recording.samples, 0], seen[k, : recording.samples, 1]
        runs.append(Recording(recording.time, q, tau, q_ref=recording.q_ref, name=recording.name))
        if not np.isfinite(seen[k]).all() or np.any(np.abs(tau) > 1.05 * limits.torque):
            continue
        data = Data(
            # Only the signatures matter, but a row without a residual counts as not compared.
            residual=np.ones((1, *base.shape[1:3])) * kept[k : k + 1, :, None],
            base=base[k : k + 1],
            table=table.recordings(slice(k, k + 1)),
            mask=kept[k : k + 1],
        )
        scores[k] = _apart(Gram.of(data, diagnosis.noise), columns, sizes)
    return scores, runs


def _apart(gram: Gram, columns: Sequence[Sequence[int]], amplitudes: Sequence[np.ndarray]) -> float:
    """Whitened squared error between the first effect and the nearest other effect.

    It is the part of one effect, at its amplitude, that the other cannot imitate. The larger value
    of both directions counts, because an effect can always imitate its special cases.
    """

    def left(one: int, other: Sequence[int]) -> float:
        own = list(columns[one])
        size = amplitudes[one] * gram.size[own]
        rest = gram.without(list(other)) if len(other) else gram
        return float(size @ rest.gram[np.ix_(own, own)] @ size)

    if len(columns) == 1:
        return left(0, [])
    others = range(1, len(columns))
    return min(max(left(0, columns[k]), left(k, columns[0])) for k in others)
