"""The curve of an effect: its torque over a coordinate, with its band, over the residual."""

import dataclasses
import html
import textwrap
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..display.shown import AbstractShown
from ..effects import AbstractEffect, AbstractTransmission, Curve, Motion, recording_label
from ..effects.curve import coordinate_unit
from ..effects.placed import Placed
from ..errors import ModelError
from ..estimate import Fit
from ..recording import Recording, Recordings
from ..simulation.batch import held_at, held_names
from ..simulation.dynamics import imposed
from ..simulation.loads import link_load
from ..simulation.loop import ClosedLoop
from .comparison import Comparison, compare
from .forces import force_and_slopes, left_for_links, misreads
from .hypotheses import effect_on
from .text import WIDTH

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go

# Share of the torque above which the curve represents the effect completely, and is drawn finely.
_ALL = 0.98
# A coordinate later in the list must explain this additional share of the torque.
_MORE = 0.01
# The same for a coordinate of another joint: along few recordings it may be like one of the own.
_OTHER = 0.1
# Time is not considered if another coordinate explains more than this share.
_HALF = 0.5
_COARSE, _FINE = 30, 100
_WIDE = 1.96


class EffectCurve(AbstractShown):
    """An effect's torque along recordings, over the coordinate that explains most of it.

    - `effect`, `joint`: the effect, and the joint of the torque.
    - `coordinate`: in words; `units` has its unit and that of the torque.
    - `signed`: whether torque and residual are multiplied by the sign of the joint's velocity.
    - `share`: share of the power of the effect's torque that the curve explains, 0 to 1.
    - `x`, `torque`, `std`: the curve and its standard deviation, from the fit's covariance; not
      finite if the recordings do not determine the effect.
    - `cloud_x`, `cloud`: the residual of the model without the effect, at unchanged other values;
      None if the effect acts on a sensor's reading, or no torque is compared.
    """

    effect: AbstractEffect
    joint: int = eqx.field(static=True)
    coordinate: str = eqx.field(static=True)
    units: tuple[str, str] = eqx.field(static=True)
    signed: bool = eqx.field(static=True)
    share: float
    x: Float[np.ndarray, " points"]
    torque: Float[np.ndarray, " points"]
    std: Float[np.ndarray, " points"]
    cloud_x: Float[np.ndarray, " samples"] | None = None
    cloud: Float[np.ndarray, " samples"] | None = None

    @property
    def sensed(self) -> bool:
        """Whether the effect changes a sensor's reading, and the curve is that change."""
        return misreads(self.effect)

    @property
    def name(self) -> str:
        """The effect with its joint, in words."""
        return effect_on(self.effect.spoken(), self.joint)

    def table(self) -> "pd.DataFrame":
        """The curve point by point: coordinate, torque, deviation and 95 % interval."""
        import pandas as pd

        half = _WIDE * self.std
        what = "reading" if self.sensed else "torque"
        columns = {
            f"{what} ({self.units[1]})": self.torque,
            "std": self.std,
            "low": self.torque - half,
            "high": self.torque + half,
        }
        index = pd.Index(self.x, name=f"{self.coordinate} ({self.units[0]})")
        return pd.DataFrame(columns, index=index)

    def plot(self) -> "go.Figure":
        """The curve with its 95 % band over the residual of the model without the effect."""
        from ..display import figures

        times = " × sign of velocity" if self.signed else ""
        none = np.zeros(0)
        return figures.curve_fit(
            none if self.cloud_x is None else self.cloud_x,
            none if self.cloud is None else self.cloud,
            self.coordinate,
            *self.units,
            self.x,
            self.torque,
            _WIDE * self.std if np.isfinite(self.std).all() else None,
            y_name=self._axis() + times,
            curve_name=self.name,
        )

    def _axis(self) -> str:
        if self.cloud is not None:
            return "residual without effect"
        return "change of the position reading" if self.sensed else "torque of the effect"

    def to_dict(self) -> dict[str, Any]:
        """The curve as plain JSON."""
        std = [float(s) if np.isfinite(s) else None for s in self.std]
        return {
            "effect": self.effect.effect_name(),
            "joint": self.joint,
            "coordinate": self.coordinate,
            "units": list(self.units),
            "times_sign_of_v": self.signed,
            "share": self.share,
            "x": self.x.tolist(),
            "torque": self.torque.tolist(),
            "std": std,
        }

    def __repr__(self) -> str:
        head = textwrap.fill(self._head(), WIDTH)
        return f"{head}\n\n{self._rows().to_string(float_format=self._digits())}"

    def _repr_html_(self) -> str:
        table = self._rows().to_html(float_format=self._digits())
        return f"<p>{html.escape(self._head())}</p>{table}"

    def _rows(self) -> "pd.DataFrame":
        """Rows that fit on a screen; the table has all rows."""
        rows = self.table().iloc[:: max(1, len(self.x) // 20)]
        rows.index = rows.index.map(lambda x: f"{x:.4g}")
        return rows

    def _digits(self) -> Callable[[float], str]:
        """Four digits of the largest torque."""
        size = float(np.abs(self.torque).max(initial=0.0))
        places = max(0, 3 - int(np.floor(np.log10(size)))) if size > 0 else 3
        return lambda x: f"{x:z.{places}f}"

    def _head(self) -> str:
        times = ", times the sign of velocity" if self.signed else ""
        what = "change of the reading" if self.sensed else "torque"
        head = (
            f"{self.name}: {what} over the {self.coordinate}{times}, with its standard deviation "
            "(std) and its 95 % interval (low to high)."
        )
        if self.share < _ALL:
            head += f" The curve shows {100 * self.share:.0f} % of it."
        return f"{head} The table has {len(self.x)} rows."


def effect_curve(
    fit: Fit,
    effect: str | AbstractEffect,
    joint: int | None = None,
    recordings: Recording | Recordings | Iterable[Recording] | None = None,
) -> EffectCurve:
    """An effect's torque over the coordinate that explains most of it, with its 95 % band.

    The coordinate is position, velocity, drive torque or acceleration of a joint, or time. If the
    torque depends on several coordinates, the curve is its mean along the recordings.

    **Arguments:**

    - `fit`: fit of a loop with the effect.
    - `effect`: its name as in tables, or the effect itself, one of `fit.loop.effects`.
    - `joint`: joint of the effect, counted from 1; for an effect on all joints, the one to show.
    - `recordings`: by default those of the fit.

    **Raises:** `ModelError` if the loop does not have the effect, or the effect is a transmission,
    which has no torque of its own; `FitError` if the loop cannot be simulated.
    """
    place = _place(fit.loop, effect, joint)
    chosen = fit.loop.effects[place]
    recordings = fit.recordings if recordings is None else Recordings.of(recordings)
    run = compare(fit, recordings)
    motion, mask = _motion(run, chosen)
    value, slopes, sensed = _own(fit.loop, place, motion)
    size = np.linalg.norm(value[mask], axis=0)
    own = getattr(chosen, "joint", None) or joint or int(size.argmax()) + 1
    shown, by = value[..., own - 1], slopes[..., own - 1, :]
    over, share = _coordinate(chosen, shown, motion, mask, own)
    sign = np.sign(np.asarray(motion.v)[..., own - 1]) if over.signed else np.ones(mask.shape)
    along = _along(motion, over)
    x, y, j = _curve(along[mask], (shown * sign)[mask], (by * sign[..., None])[mask], share)
    std = np.sqrt(np.maximum(np.einsum("pi,ij,pj->p", j, _covariance(fit, place), j), 0.0))
    cloud = None
    if not sensed and run.signal == "torque":
        cloud = _cloud(fit, place, run, along, sign, own)
    torque, position = fit.loop.arm.units()
    units = coordinate_unit(over, torque, position), (position if sensed else torque)[own - 1]
    curve = EffectCurve(chosen, own, over.spoken_coordinate, units, over.signed, share, x, y, std)
    return curve if cloud is None else dataclasses.replace(curve, cloud_x=cloud[0], cloud=cloud[1])


def _place(loop: ClosedLoop, effect: str | AbstractEffect, joint: int | None) -> int:
    """The place of an effect among those of a loop.

    **Raises:** `ModelError` if it is not there, or has no torque of its own.
    """
    for k, e in enumerate(loop.effects):
        if isinstance(effect, str):
            where = getattr(e, "joint", None)
            found = e.effect_name() == effect and (joint is None or where in (None, joint))
        else:
            found = e is effect
        if found and isinstance(e, AbstractTransmission):
            raise ModelError(
                f"{e.effect_name()} is a transmission, which has no torque of its own: compare the "
                "models with and without it by jaxid.compare_models"
            )
        if found:
            return k
    name = effect if isinstance(effect, str) else effect.effect_name()
    there = ", ".join(effect_on(e.effect_name(), getattr(e, "joint", None)) for e in loop.effects)
    raise ModelError(f"there is no effect {effect_on(name, joint)} in the loop: it has {there}")


def _motion(run: Comparison, effect: AbstractEffect) -> tuple[Motion, np.ndarray]:
    """The motion of the runs, padded to the longest, and the mask of samples."""
    # An effect on the command needs the torque before the effect, not after it.
    commands = type(effect).command is not AbstractEffect.command
    longest = max(r.samples for r in run.recordings)

    def padded(rows: Any) -> Any:
        rows = np.asarray(rows)
        return np.pad(rows, [(0, longest - len(rows))] + [(0, 0)] * (rows.ndim - 1), "edge")

    def stacked(rows: Iterable[Any]) -> Any:
        return jnp.asarray(np.stack([padded(x) for x in rows]))

    runs, names = run.runs, held_names(run.recordings)
    held = [
        held_at(r, np.asarray(x.time), names) for r, x in zip(run.recordings, runs, strict=True)
    ]
    # Nested vmaps, because `Motion` declares the shapes of one instant.
    motion = jax.vmap(jax.vmap(Motion))(
        stacked(x.time for x in runs),
        stacked(x.q for x in runs),
        stacked(x.v for x in runs),
        stacked(x.a for x in runs),
        stacked(x.tau if commands else x.delivered for x in runs),
        jnp.zeros((len(runs), longest, 0)),
        stacked(np.full(r.samples, recording_label(r.name)) for r in run.recordings),
        {name: stacked(x[name] for x in held) for name in names},
    )
    # Effects on the links, whose torque is a part of the load, have no states of their own.
    states = tuple(e.initial_state() for e in run.loop.effects)

    def of_loop(at: Motion) -> Motion:
        load = link_load(run.loop, at, states)
        return dataclasses.replace(at, load=load, imposed=imposed(run.loop))

    motion = jax.vmap(jax.vmap(of_loop))(motion)
    mask = np.stack([np.arange(longest) < r.samples for r in run.recordings])
    return motion, mask


def _own(loop: ClosedLoop, place: int, motion: Motion) -> tuple[np.ndarray, np.ndarray, bool]:
    """Torque that an effect needs of each joint along runs, N·m or N, with its derivatives.

    For an effect of a sensor: its change of the position reading, rad or m, and True.
    """
    effect = loop.effects[place]
    left = left_for_links(_without(loop, place), motion)
    fields = tuple(str(p.place[-1]) for p in _parameters(loop, place))
    push, noise, _ = force_and_slopes(Placed.of(effect, loop.joints), motion, left, fields)
    sensed = misreads(effect)
    # The sign changes, because torque that the effect adds to the joint relieves the drive.
    found = np.asarray(noise) if sensed else -np.asarray(push)
    return found[..., 0], found[..., 1:], sensed


def _without(loop: ClosedLoop, place: int) -> ClosedLoop:
    return loop.with_effects(e for k, e in enumerate(loop.effects) if k != place)


def _parameters(loop: ClosedLoop, place: int) -> list[Any]:
    return [p for p in loop.free_parameters if p.place[:2] == ("effects", place)]


def _covariance(fit: Fit, place: int) -> Float[np.ndarray, "values values"]:
    """Covariance of an effect's free values."""
    rows, at = [], 0
    for p in fit.loop.free_parameters:
        if p.place[:2] == ("effects", place):
            rows += range(at, at + p.size)
        at += p.size
    return fit.covariance[np.ix_(rows, rows)]


def _coordinate(
    effect: AbstractEffect, value: np.ndarray, motion: Motion, mask: np.ndarray, joint: int
) -> tuple[Curve, float]:
    """The coordinate that explains most of a torque, and the share that it explains."""
    joints = [joint, *(j for j in range(1, motion.q.shape[-1] + 1) if j != joint)]
    # A sensor's error depends on the position that it reads.
    order = ("q", "v", "tau", "a") if misreads(effect) else ("v", "q", "tau", "a")
    names = [(c, j) for j in joints for c in order]
    found = [
        Curve(joint=joint, coordinate=c, of=j, signed=signed)  # type: ignore[arg-type]
        for signed in (False, True)
        for c, j in names
    ]
    found.append(Curve(joint=joint, coordinate="t"))
    if isinstance(effect, Curve):
        found = [effect]
    best, share = found[0], -np.inf
    sign = np.sign(np.asarray(motion.v)[..., joint - 1])
    for over in found:
        y = (value * sign if over.signed else value)[mask]
        along = _along(motion, over)[mask]
        # If torque depends on a coordinate, it differs little between neighbours (von Neumann).
        step = np.diff(y[np.argsort(along, kind="stable")])
        total = float(y @ y)
        shown = 1.0 if total == 0 else max(0.0, 1 - float(step @ step) / (2 * total))
        # Along one recording every torque is a smooth function of time.
        if over.coordinate == "t" and share > _HALF:
            continue
        other = best.of == joint and over.coordinate != "t" and over.of != joint
        if shown > share + (_OTHER if other else _MORE):
            best, share = over, shown
    return best, float(share)


def _along(motion: Motion, over: Curve) -> Float[np.ndarray, "recordings points"]:
    if over.coordinate == "t":
        return np.asarray(motion.t)
    return np.asarray(getattr(motion, over.coordinate))[..., over.of - 1]


def _curve(
    x: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " samples"],
    slopes: Float[np.ndarray, "samples values"],
    share: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means in bins of the coordinate: position, torque and derivatives, ascending."""
    count = _FINE if share > _ALL else _COARSE
    edges = np.quantile(x, np.linspace(0, 1, count + 1)[1:-1])
    if share > _ALL:
        # Bins of equal count alone would be too wide where there are few samples.
        edges = np.union1d(edges, np.linspace(x.min(), x.max(), count + 1)[1:-1])
    _, part = np.unique(np.searchsorted(edges, x), return_inverse=True)
    size = np.bincount(part)
    columns = [np.bincount(part, c) / size for c in (x, y, *slopes.T)]
    apart = np.append(True, np.diff(columns[0]) > 0)
    rows = np.stack(columns, axis=1)[apart]
    return rows[:, 0], rows[:, 1], rows[:, 2:]


def _cloud(
    fit: Fit, place: int, run: Comparison, along: np.ndarray, sign: np.ndarray, joint: int
) -> tuple[np.ndarray, np.ndarray]:
    """The residual of the model without an effect, and the coordinate of each sample."""
    without = dataclasses.replace(fit, loop=_without(fit.loop, place))
    left = compare(without, run.recordings)
    x, y = [], []
    for k, record in enumerate(run.recordings):
        time, measured, simulated = left.judged(k)
        rows = np.searchsorted(record.time, time - 1e-9)
        residual = (measured - simulated)[:, joint - 1]
        there = residual != 0
        x.append(along[k, rows][there])
        y.append((residual * sign[k, rows])[there])
    return np.concatenate(x), np.concatenate(y)
