"""References that determine the parameters best: Fourier series under limits."""

import html
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import plotly.graph_objects as go
import scipy
from jaxtyping import Array, Float

from ..display import figures
from ..display.shown import AbstractShown
from ..errors import FitError, LimitsError
from ..estimate.result import determined_covariance
from ..parameters import Bounds
from ..recording import Recording, Recordings
from ..signals.fourier import FourierSeries, fourier_basis
from ..simulation.loop import ClosedLoop
from ..simulation.runs import fastest_rate, set_substeps
from ._information import (
    Criterion,
    Kind,
    Settings,
    chosen_parameters,
    closed_loop_columns,
    information_of,
    inverse_columns,
    torque_along,
)
from .limits import Limits

# Limits are kept this far from, on the grid where they are imposed.
_SLACK = 1e-3
# The grid on which a result is checked is so many times as fine.
_FINER = 10
# How often points that a descent has overlooked are imposed before the step is shortened.
_EXCHANGES = 4


class Design(eqx.Module):
    """The search space of references: series of some harmonics that start and end at rest.

    Coefficients are `base + span @ z` for free numbers z, `(numbers, joints)`.
    """

    loop: ClosedLoop
    limits: Limits
    settings: Settings
    base: Float[np.ndarray, "coefficients joints"]
    span: Float[np.ndarray, "coefficients numbers"]
    time: Float[np.ndarray, " points"]
    basis: Float[np.ndarray, "3 points coefficients"]
    samples: Float[np.ndarray, " samples"]
    sampled: Float[np.ndarray, "3 samples coefficients"]
    period: float = eqx.field(static=True)
    weight: float = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        """Of z: free numbers a joint, joints."""
        return self.span.shape[1], self.base.shape[1]

    def coefficients(
        self, z: Float[Array | np.ndarray, " numbers"]
    ) -> Float[Array | np.ndarray, "coefficients joints"]:
        """The series of free numbers, flat."""
        return self.base + self.span @ z.reshape(self.shape)


# The limits of a joint, in the order of `margins_along`: magnitudes have two sides.
_NAMES = ("low", "high", "speed", "speed", "acceleration", "acceleration", "torque", "torque")


def margins_along(
    limits: Limits,
    signals: Float[Array, "3 points joints"],
    tau: Float[Array, "points joints"],
) -> tuple[Float[Array, "points 8 joints"], Float[Array, "points sides"]]:
    """How far a motion is from each limit, as a share of it; negative where it is passed."""
    q, v, a = signals
    span = limits.high - limits.low
    rates = [(v, limits.speed), (a, limits.acceleration), (tau, limits.torque)]
    rows = [(q - limits.low) / span, (limits.high - q) / span]
    rows += [1 + sign * x / most for x, most in rates for sign in (-1.0, 1.0)]
    inside = jnp.zeros((q.shape[0], 0))
    if limits.workspace is not None:
        inside = jax.vmap(limits.workspace)(q)
    return jnp.stack(rows, axis=1), inside


def _margins(design: Design, z: Float[Array, " numbers"]) -> Float[Array, "points kinds"]:
    signals = jnp.asarray(design.basis @ design.coefficients(z))
    tau = torque_along(design.loop, jnp.asarray(design.time), signals)
    rows, inside = margins_along(design.limits, signals, tau)
    return jnp.concatenate([rows.reshape(len(rows), -1), inside], axis=1)


@eqx.filter_jit
def _margins_and_slopes(design: Design, z: Float[Array, " numbers"]) -> tuple[Array, Array]:
    return _margins(design, z), jax.jacfwd(_margins, argnums=1)(design, z)


@eqx.filter_jit
def _feasible_share(
    design: Design, z: Float[Array, " numbers"], centre: Float[Array, " numbers"]
) -> Float[Array, ""]:
    """The largest share of the way from a pose to a reference at which all limits hold."""

    def good(share):
        return jnp.min(_margins(design, centre + share * (z - centre))) >= _SLACK

    def body(_, bounds):
        low, high = bounds
        middle = (low + high) / 2
        fits = good(middle)
        return jnp.where(fits, middle, low), jnp.where(fits, high, middle)

    found = jax.lax.fori_loop(0, 20, body, (jnp.zeros(()), jnp.ones(())))[0]
    # A smaller motion may pass a limit that a larger one keeps.
    return jnp.where(good(1.0), 1.0, found)


@eqx.filter_jit
def _information(design: Design, z: Float[Array, " numbers"]) -> Float[Array, "p p"]:
    signals = jnp.asarray(design.sampled @ design.coefficients(z))
    noise = jnp.asarray(design.settings.noise)
    if design.settings.kind == "closed-loop":
        _, columns = closed_loop_columns(design.loop, design.samples, signals)
    else:
        columns = inverse_columns(design.loop, jnp.asarray(design.samples), signals)
    return design.weight * information_of(columns, noise)


@eqx.filter_jit
def _score(design: Design, z: Float[Array, " numbers"]) -> Float[Array, ""]:
    return design.settings.judge(_information(design, z))


@eqx.filter_jit
def _score_and_slope(design: Design, z: Float[Array, " numbers"]) -> tuple[Array, Array]:
    return jax.value_and_grad(lambda at: design.settings.judge(_information(design, at)))(z)


class Excitation(AbstractShown):
    """A reference that determines the parameters, and how well it will.

    - `series`: the reference as a Fourier series; `reference()` samples it.
    - `std`: predicted standard deviations of the parameters `names`, for one period and the torque
      noise that was assumed.
    - `margins`: by limit and joint, how much of it is left, in percent; of the workspace what
      its function leaves, as a rule m; none is negative.
    - `score`: logarithm of the criterion, parameters in units of their scales; of the determinant
      the root that makes it a deviation.
    """

    loop: ClosedLoop
    series: FourierSeries
    limits: Limits
    covariance: Float[np.ndarray, "parameters parameters"]
    names: tuple[str, ...] = eqx.field(static=True)
    undetermined: tuple[str, ...] = eqx.field(static=True)
    margins: pd.DataFrame
    score: float
    rate: float = eqx.field(static=True)
    kind: str = eqx.field(static=True)

    @property
    def std(self) -> Float[np.ndarray, " parameters"]:
        """Predicted standard deviations, in the units of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def reference(self, periods: int = 1, rate: float | None = None) -> Recording:
        """The reference sampled, with the torque it takes as `tau`.

        **Arguments:**

        - `periods`: how often it is run through. `rate`: Hz; by default as it was designed for.
        """
        rate = rate or self.rate
        time = np.arange(round(periods * self.series.period * rate) + 1) / rate
        signals = np.asarray(self.series(time))
        tau = np.asarray(torque_along(self.loop, jnp.asarray(time), jnp.asarray(signals)))
        return Recording(time, signals[0], tau, q_ref=signals[0], v=signals[1], name="excitation")

    def table(self) -> pd.DataFrame:
        """Predicted deviations."""
        known = {n: self.loop.unit(p) for p in self.loop.parameters for n in p.names}
        units = [known[name] for name in self.names]
        return pd.DataFrame(
            {"std": self.std, "unit": units}, index=pd.Index(self.names, name="parameter")
        )

    def plot(self) -> go.Figure:
        """The reference in time."""
        r = self.reference()
        units = self.loop.arm.units()[1]
        panels = [
            [figures.Trace(f"joint {j}", column, unit, "reference")]
            for j, (column, unit) in enumerate(zip(r.q.T, units, strict=True), start=1)
        ]
        return figures.signals(r.time, panels)

    def __repr__(self) -> str:
        lines = [
            self._head(),
            self.table().to_string(float_format=lambda x: f"{x:.3g}"),
            "left of the limits, %:",
            self.margins.to_string(float_format=lambda x: f"{x:.3g}"),
        ]
        return "\n".join([*lines, *self.undetermined])

    def _repr_html_(self) -> str:
        foot = "".join(f"<p>{html.escape(s)}</p>" for s in self.undetermined)
        return (
            f"<p>{html.escape(self._head())}</p>"
            f"{self.table().to_html(float_format=lambda x: f'{x:.3g}')}"
            f"<p>left of the limits, %</p>{self.margins.to_html(float_format='%.3g')}{foot}"
        )

    def _head(self) -> str:
        return (
            f"a reference of {self.series.period:g} s and {self.series.harmonics} harmonics for "
            f"{self.loop.name}, by its {self.kind} information"
        )


def _check(
    loop: ClosedLoop,
    limits: Limits,
    period: float,
    harmonics: int,
    rate: float,
    noise: Sequence[float] | np.ndarray | None = None,
    start: Sequence[float] | np.ndarray | None = None,
) -> None:
    if len(limits.low) != loop.joints:
        raise LimitsError(
            f"limits are given for {len(limits.low)} joints, but {loop.name} has {loop.joints}"
        )
    if period <= 0 or harmonics < 2:
        raise FitError(
            f"a period of {period:g} s and {harmonics} harmonics make no reference that starts at "
            "rest: take a positive period and at least two harmonics"
        )
    if harmonics / period >= rate / 4:
        raise FitError(
            f"{harmonics} harmonics of {period:g} s reach {harmonics / period:.3g} Hz, more than a "
            f"quarter of the sample rate of {rate:g} Hz: take fewer, or a longer period"
        )
    wrong = [x for x in (noise, start) if x is not None and np.ndim(x) and len(x) != loop.joints]
    if wrong:
        raise FitError(f"{len(wrong[0])} values are given for {loop.joints} joints: give one each")
    own = loop.controller.period
    if own is not None and abs(own * rate - 1) > 1e-6:
        raise FitError(f"the controller ticks every {own:g} s: design at its rate, {1 / own:g} Hz")


def _static_margins(
    loop: ClosedLoop, limits: Limits, poses: Float[np.ndarray, "poses joints"]
) -> Float[np.ndarray, "poses kinds"]:
    """How far poses at rest are from every limit."""

    def one(q):
        signals = jnp.stack([q, jnp.zeros_like(q), jnp.zeros_like(q)])[:, None]
        tau = torque_along(loop, jnp.zeros(1), signals)
        rows, inside = margins_along(limits, signals, tau)
        return jnp.concatenate([rows.reshape(-1), inside[0]])

    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(poses)))


def pose_within(
    loop: ClosedLoop, limits: Limits, start: Float[np.ndarray, " joints"] | None
) -> Float[np.ndarray, " joints"]:
    """A pose at which the arm can stand still inside all limits, `(joints,)`.

    **Raises:** `LimitsError` that names the limit which leaves none.
    """
    if start is not None:
        poses = np.asarray(start, float).reshape(1, -1)
        where = "at the start that is given"
    else:
        points = _grid(loop.joints)
        poses = limits.low + (limits.high - limits.low) * points
        where = "anywhere between limits.low and limits.high"
    margins = _static_margins(loop, limits, poses)
    worst = margins.min(axis=1)
    best = int(np.argmax(worst))
    if worst[best] > 2 * _SLACK:
        return poses[best]
    kind = int(np.argmin(margins[best]))
    joints = loop.joints
    if kind >= 8 * joints:
        raise LimitsError(
            f"limits.workspace leaves no pose {where}: the nearest lies {-worst[best]:.3g} outside "
            "it; widen it, or limits.low and limits.high"
        )
    name, joint = _NAMES[kind // joints], kind % joints + 1
    if name == "torque":
        needed = limits.torque[joint - 1] * (1 - worst[best])
        raise LimitsError(
            f"limits.torque of joint {joint} is {limits.torque[joint - 1]:.4g}, but to stand still "
            f"{where} takes at least {needed:.4g}: raise it, or move the limits of position"
        )
    raise LimitsError(
        f"limits.{name} of joint {joint} leaves no room {where}: widen it, or start elsewhere"
    )


def _grid(joints: int) -> Float[np.ndarray, "points joints"]:
    """Points that fill the unit cube, its middle first."""
    middle = np.full((1, joints), 0.5)
    if joints <= 2:
        axes = np.meshgrid(*[np.linspace(0.02, 0.98, 49)] * joints, indexing="ij")
        return np.concatenate([middle, np.stack([x.ravel() for x in axes], axis=1)])
    return np.concatenate([middle, scipy.stats.qmc.Sobol(joints, scramble=False).random(4096)])


def make_design(
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
) -> tuple[Design, Float[np.ndarray, " numbers"]]:
    """The search space, and the free numbers of a pose that keeps all limits.

    Arguments are those of `optimal_excitation`.
    """
    _check(loop, limits, period, harmonics, rate, noise, start)
    if not chosen_parameters(loop, kind):
        raise FitError(f"{loop.name} has no free parameter to determine: free one with loop.free")
    pose = pose_within(loop, limits, None if start is None else np.asarray(start, float))
    at_start = fourier_basis(np.zeros(1), period, harmonics)[:, 0]
    rest = at_start[1:] if start is None else at_start
    # High harmonics are small: their speed and acceleration grow with their number.
    own = 1 / np.concatenate([[1.0], np.repeat(np.arange(1, harmonics + 1), 2)]) ** 1.5
    span = own[:, None] * scipy.linalg.null_space(rest * own)
    base = np.zeros((2 * harmonics + 1, loop.joints))
    level = np.zeros_like(base)
    level[0] = pose
    if start is not None:
        base = level
    centre = np.linalg.lstsq(span, level - base, rcond=None)[0].ravel()
    n = round(period * rate)
    # Sums over a period hardly change with more samples than these.
    few = n if kind == "closed-loop" else min(n, 24 * harmonics)
    samples = np.arange(few + (kind == "closed-loop")) * period / few
    points = np.arange(64 * harmonics) * period / (64 * harmonics)
    if noise is None:
        noise = 0.01 * limits.torque
    chosen = chosen_parameters(loop, kind)
    scales = np.asarray(Bounds.of(chosen).scale)
    levels = np.broadcast_to(np.asarray(noise, float), (loop.joints,)).copy()
    settings = Settings(kind, criterion, levels, scales)
    if loop.stepping.substeps is None:
        fastest = _fastest_at(loop, pose)
        substeps = int(np.ceil(max(1 / 2.5e-3, fastest / 0.25) / rate - 1e-9))
        loop = set_substeps(loop, int(np.clip(substeps, 1, 64)))
    design = Design(
        loop,
        limits,
        settings,
        base,
        span,
        points,
        fourier_basis(points, period, harmonics),
        samples,
        fourier_basis(samples, period, harmonics),
        float(period),
        n / few,
    )
    return design, centre


def _fastest_at(loop: ClosedLoop, pose: Float[np.ndarray, " joints"]) -> float:
    """Largest eigenvalue of the loop at standstill in a pose, 1/s."""
    q = np.stack([pose, pose + 1e-3])
    return fastest_rate(loop, Recordings((Recording(np.arange(2.0), q, q),)))


def random_references(
    design: Design,
    centre: Float[np.ndarray, " numbers"],
    count: int,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "count numbers"], Float[np.ndarray, " count"]]:
    """Random references as large as the limits let them be, and their scores.

    **Arguments:**

    - `centre`: free numbers of the pose they grow from.
    """
    rng = np.random.default_rng(seed)
    joints = design.base.shape[1]
    span = (design.limits.high - design.limits.low) / 2
    drawn = rng.normal(size=(count, *design.shape)) * span
    # Each joint as large as its own size lets it be, in proportions of its own.
    drawn *= rng.uniform(0.3, 1.5, (count, 1, joints))
    drawn = centre + drawn.reshape(count, -1)
    shares = jax.lax.map(
        lambda z: _feasible_share(design, z, jnp.asarray(centre)), jnp.asarray(drawn), batch_size=50
    )
    drawn = centre + np.asarray(shares)[:, None] * (drawn - centre)
    scores = jax.lax.map(lambda z: _score(design, z), jnp.asarray(drawn), batch_size=50)
    return drawn, np.where(np.isfinite(scores), np.asarray(scores), np.inf)


def _dips(margins: Float[np.ndarray, "points kinds"]) -> np.ndarray:
    """Where each limit comes nearest, and the points beside; bool, (points, kinds)."""
    before, after = np.roll(margins, 1, axis=0), np.roll(margins, -1, axis=0)
    nearest = (margins <= before) & (margins <= after)
    return nearest | np.roll(nearest, 1, axis=0) | np.roll(nearest, -1, axis=0)


def _active(margins: Float[np.ndarray, "points kinds"], reach: float) -> np.ndarray:
    """Where limits may soon bind; bool, (points, kinds)."""
    coarse = np.zeros_like(margins, bool)
    coarse[::8] = True
    return (margins < 1.5 * reach) & (_dips(margins) | coarse)


def _improve(
    design: Design,
    z: Float[np.ndarray, " numbers"],
    centre: Float[np.ndarray, " numbers"],
    rounds: int,
    say: Callable[[str], None],
) -> Float[np.ndarray, " numbers"]:
    """Constrained descent: SLSQP within a trust region, on the points where limits are near.

    After each round the points are chosen anew, and the reference is drawn in until it keeps the
    limits everywhere: the best that does is what counts.
    """
    best, best_score = z, float(_score(design, jnp.asarray(z)))
    reach = 0.5
    scale = np.tile((design.limits.high - design.limits.low) / 2, design.shape[0])
    for k in range(rounds):
        found = _descend(design, best, reach, reach * scale)
        share = float(_feasible_share(design, jnp.asarray(found), jnp.asarray(centre)))
        inside = centre + share * (found - centre)
        score = float(_score(design, jnp.asarray(inside)))
        gained = best_score - score
        say(f"round {k + 1}: {score:.4f}, {100 * share:.1f} % of the step, reach {reach:.2f}")
        if np.isfinite(score) and gained > 0:
            best, best_score = inside, score
        reach = min(1.0, 1.5 * reach) if share > 0.98 else reach / 2.5
        if (abs(gained) < 1e-3 and share > 0.98) or reach < 0.01:
            break
    return best


def _descend(
    design: Design,
    z: Float[np.ndarray, " numbers"],
    reach: float,
    box: Float[np.ndarray, " numbers"],
) -> Float[np.ndarray, " numbers"]:
    """SLSQP from a reference that keeps all limits, within a box around it.

    Where what it finds passes a limit at a point that was not imposed, that is imposed too, and
    the descent goes on from there (exchange method, Hettich and Kortanek 1993).
    """
    low, high, found = z - box, z + box, z
    imposed = _active(_margins_at(design, z), reach)
    for _ in range(_EXCHANGES):
        found = _descend_on(design, found, np.stack([low, high], axis=1), imposed)
        margins = _margins_at(design, found)
        passed = (margins < _SLACK) & _dips(margins) & ~imposed
        if not passed.any():
            break
        imposed |= passed
    return found


def _margins_at(
    design: Design, z: Float[np.ndarray, " numbers"]
) -> Float[np.ndarray, "points kinds"]:
    return np.asarray(_margins_and_slopes(design, jnp.asarray(z))[0])


def _descend_on(
    design: Design,
    z: Float[np.ndarray, " numbers"],
    bounds: Float[np.ndarray, "numbers 2"],
    imposed: np.ndarray,
) -> Float[np.ndarray, " numbers"]:
    """SLSQP with limits imposed at points, bool (points, kinds)."""
    points, kinds = np.nonzero(imposed)

    def limits(x):
        return _margins_at(design, x)[points, kinds] - 2 * _SLACK

    def slopes(x):
        return np.asarray(_margins_and_slopes(design, jnp.asarray(x))[1])[points, kinds]

    def score(x):
        value, slope = _score_and_slope(design, jnp.asarray(x))
        return float(value), np.asarray(slope)

    found = scipy.optimize.minimize(
        score,
        z,
        jac=True,
        method="SLSQP",
        bounds=bounds,
        constraints={"type": "ineq", "fun": limits, "jac": slopes},
        options={"maxiter": 30, "ftol": 1e-4},
    )
    return found.x if np.isfinite(found.x).all() else z


def _shrunk(
    design: Design, z: Float[np.ndarray, " numbers"], centre: Float[np.ndarray, " numbers"]
) -> Float[np.ndarray, " numbers"]:
    """The reference, drawn in towards a pose where need be until every limit holds in between."""
    share = 1.0
    for _ in range(60):
        at = centre + share * (z - centre)
        if float(_all_margins(design, at)[0].min()) >= 0:
            return at
        share *= 0.995 if share > 0.9 else 0.95
    raise LimitsError("no reference was found that keeps all limits: widen them")


def _all_margins(
    design: Design, z: Float[np.ndarray, " numbers"]
) -> tuple[Float[np.ndarray, "kinds"], Float[np.ndarray, "kinds"]]:
    """The smallest margin of each limit on the fine grid, of the reference and of its tracking."""
    count = _FINER * max(len(design.time), round(design.period * 1.0) * 100)
    time = np.arange(count) * design.period / count
    coefficients = np.asarray(design.coefficients(z))
    harmonics = (len(coefficients) - 1) // 2
    signals = jnp.asarray(fourier_basis(time, design.period, harmonics) @ coefficients)
    tau = torque_along(design.loop, jnp.asarray(time), signals)
    rows, inside = margins_along(design.limits, signals, tau)
    smallest = np.concatenate([np.asarray(rows).min(axis=0).ravel(), np.asarray(inside).min(0)])
    # Between the points of a fine grid a series of so many harmonics rises by no more than this
    # (Ehlich and Zeller 1964).
    smallest = smallest - (1 / np.cos(np.pi * harmonics / count) - 1)
    if design.settings.kind != "closed-loop":
        return smallest, smallest
    at = jnp.asarray(design.sampled @ coefficients)
    seen, _ = closed_loop_columns(design.loop, design.samples, at)
    moved = jnp.stack([seen[:, 1], seen[:, 2], jnp.zeros_like(seen[:, 1])])
    rows, inside = margins_along(design.limits, moved, seen[:, 0])
    tracked = np.concatenate([np.asarray(rows).min(axis=0).ravel(), np.asarray(inside).min(0)])
    return np.minimum(smallest, tracked), smallest


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
    """Finds the reference from which the parameters are determined best.

    A finite Fourier series a joint that starts and ends at rest (Swevers et al. 1997), by exact
    gradients: SLSQP from the best of random references. Limits are imposed where they are nearest,
    again and again, and checked on a grid ten times as fine.

    **Arguments:**

    - `loop`: the model at the best values known; its free parameters are to be determined.
    - `limits`: that the reference and the torque it takes keep.
    - `period`: s. `harmonics`: how many. `rate`: at which it will be sampled, Hz.
    - `kind`: `"inverse-dynamics"` for regressions, `"closed-loop"` for `OEM`: the sensitivities of
      the simulated loop, whose motion and torque must then keep the limits too.
    - `criterion`: what is made small: `"determinant"` (of the covariance), `"deviation"` (geometric
      mean of the standard deviations) or `"condition"` (of the columns).
    - `noise`: deviation of torque noise, one or one a joint, N·m or N; a hundredth of the limits
      where None.
    - `start`: pose to start and end at, `(joints,)`; any where None.
    - `tries`: random references. `starts`: how many of the best are improved. `rounds`: at most.
    - `seed`: of the random references. `say`: told how it goes.

    **Raises:** `LimitsError` that names the limit which leaves no motion; `FitError` for settings
        that make no reference.
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
        z = _shrunk(design, _improve(design, drawn[k], centre, rounds, say), centre)
        score = float(_score(design, jnp.asarray(z)))
        if score < best_score:
            best, best_score = z, score
    if best is None:
        raise FitError("no reference of finite information was found: raise tries, or hold some")
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
        design.loop,
        series,
        design.limits,
        covariance,
        names,
        lost,
        _margin_table(design, _all_margins(design, z)[0]),
        score,
        float(rate),
        settings.kind,
    )


def information_along(
    design: Design, z: Float[np.ndarray, " numbers"]
) -> Float[np.ndarray, "parameters parameters"]:
    """Information of one period of a reference of the search space."""
    return np.asarray(_information(design, jnp.asarray(z)))


def margins_on(
    excitation: Excitation, time: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "points kinds"]:
    """How far a reference is from each limit at times, s, as a share of it."""
    signals = jnp.asarray(excitation.series(time))
    tau = torque_along(excitation.loop, jnp.asarray(time), signals)
    rows, inside = margins_along(excitation.limits, signals, tau)
    return np.concatenate([np.asarray(rows).reshape(len(rows), -1), np.asarray(inside)], axis=1)


def _margin_table(design: Design, smallest: Float[np.ndarray, " kinds"]) -> pd.DataFrame:
    joints = design.base.shape[1]
    table: dict[str, Any] = {}
    for kind, row in zip(_NAMES, smallest[: 8 * joints].reshape(8, joints), strict=True):
        table[kind] = np.minimum(table[kind], row) if kind in table else row
    frame = pd.DataFrame(table, index=[f"joint {j}" for j in range(1, joints + 1)]).T * 100
    if len(smallest) > 8 * joints:
        # A function that a user gave, in whatever unit.
        frame.loc["workspace, in its unit"] = np.nan
        frame.iloc[-1, 0] = smallest[8 * joints :].min()
    return frame.rename_axis("limit")
