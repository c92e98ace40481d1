"""The search space of references: series under limits, their margins and information."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiling import compiled
from ..errors import FitError, LimitsError
from ..parameters import Bounds
from ..recording import Recording, Recordings
from ..signals.fourier import fourier_basis
from ..simulation.loop import ClosedLoop
from ..simulation.steps import fastest_rate, set_substeps, steps_at
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
from .limits import SIDES, Limits, margins_along

# Margin to the limits on the grid on which they are imposed.
SLACK = 1e-3


class Design(eqx.Module):
    """The search space of references: finite Fourier series that start and end at rest.

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
        """Shape of z: free numbers per joint, joints."""
        return self.span.shape[1], self.base.shape[1]

    def coefficients(
        self, z: Float[Array | np.ndarray, " numbers"]
    ) -> Float[Array | np.ndarray, "coefficients joints"]:
        """The series of coefficients for flat free numbers."""
        return self.base + self.span @ z.reshape(self.shape)


def _margins(design: Design, z: Float[Array, " numbers"]) -> Float[Array, "points kinds"]:
    signals = jnp.asarray(design.basis @ design.coefficients(z))
    tau = torque_along(design.loop, jnp.asarray(design.time), signals)
    rows, inside = margins_along(design.limits, signals, tau)
    return jnp.concatenate([rows.reshape(len(rows), -1), inside], axis=1)


@compiled
def margins_and_slopes(design: Design, z: Float[Array, " numbers"]) -> tuple[Array, Array]:
    return _margins(design, z), jax.jacfwd(_margins, argnums=1)(design, z)


@compiled
def feasible_share(
    design: Design, z: Float[Array, " numbers"], centre: Float[Array, " numbers"]
) -> Float[Array, ""]:
    """The largest fraction of the way from a pose to a reference at which all limits hold."""

    def good(share):
        return jnp.min(_margins(design, centre + share * (z - centre))) >= SLACK

    def body(_, bounds):
        low, high = bounds
        middle = (low + high) / 2
        fits = good(middle)
        return jnp.where(fits, middle, low), jnp.where(fits, high, middle)

    found = jax.lax.fori_loop(0, 20, body, (jnp.zeros(()), jnp.ones(())))[0]
    # A smaller motion may violate a limit that a larger one satisfies.
    return jnp.where(good(1.0), 1.0, found)


@compiled
def _information(design: Design, z: Float[Array, " numbers"]) -> Float[Array, "p p"]:
    signals = jnp.asarray(design.sampled @ design.coefficients(z))
    noise = jnp.asarray(design.settings.noise)
    if design.settings.kind == "closed-loop":
        _, columns = closed_loop_columns(design.loop, design.samples, signals)
    else:
        columns = inverse_columns(design.loop, jnp.asarray(design.samples), signals)
    return design.weight * information_of(columns, noise)


@compiled
def score_of(design: Design, z: Float[Array, " numbers"]) -> Float[Array, ""]:
    return design.settings.judge(_information(design, z))


@compiled
def score_and_slope(design: Design, z: Float[Array, " numbers"]) -> tuple[Array, Array]:
    return jax.value_and_grad(lambda at: design.settings.judge(_information(design, at)))(z)


def information_along(
    design: Design, z: Float[np.ndarray, " numbers"]
) -> Float[np.ndarray, "parameters parameters"]:
    """Information of one period of a reference of the search space."""
    return np.asarray(_information(design, jnp.asarray(z)))


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
            f"a period of {period:g} s and {harmonics} harmonics do not allow a reference that "
            "starts at rest: choose a positive period and at least two harmonics"
        )
    if harmonics / period >= rate / 4:
        raise FitError(
            f"{harmonics} harmonics of {period:g} s reach {harmonics / period:.3g} Hz, more than a "
            f"quarter of the sample rate of {rate:g} Hz: choose fewer, or a longer period"
        )
    wrong = [x for x in (noise, start) if x is not None and np.ndim(x) and len(x) != loop.joints]
    if wrong:
        raise FitError(f"{len(wrong[0])} values are given for {loop.joints} joints: give one each")
    own = loop.controller.period
    if own is not None and abs(own * rate - 1) > 1e-6:
        raise FitError(f"the controller's period is {own:g} s: design at its rate, {1 / own:g} Hz")


def _static_margins(
    loop: ClosedLoop, limits: Limits, poses: Float[np.ndarray, "poses joints"]
) -> Float[np.ndarray, "poses kinds"]:
    """Margins of poses at rest to every limit."""

    def one(q):
        signals = jnp.stack([q, jnp.zeros_like(q), jnp.zeros_like(q)])[:, None]
        tau = torque_along(loop, jnp.zeros(1), signals)
        rows, inside = margins_along(limits, signals, tau)
        return jnp.concatenate([rows.reshape(-1), inside[0]])

    return np.asarray(compiled(jax.vmap(one))(jnp.asarray(poses)))


def pose_within(
    loop: ClosedLoop, limits: Limits, start: Float[np.ndarray, " joints"] | None
) -> Float[np.ndarray, " joints"]:
    """A pose at which the arm can stand still within all limits, `(joints,)`.

    **Raises:** `LimitsError` if no pose is within all limits; the message names one limit.
    """
    if start is not None:
        poses = np.asarray(start, float).reshape(1, -1)
        where = "at the given start"
    else:
        points = _grid(loop.joints)
        poses = limits.low + (limits.high - limits.low) * points
        where = "anywhere between limits.low and limits.high"
    margins = _static_margins(loop, limits, poses)
    worst = margins.min(axis=1)
    best = int(np.argmax(worst))
    if worst[best] > 2 * SLACK:
        return poses[best]
    kind = int(np.argmin(margins[best]))
    joints = loop.joints
    if kind >= 8 * joints:
        raise LimitsError(
            f"limits.workspace allows no pose {where}: the nearest pose is {-worst[best]:.3g} "
            "outside; widen it, or limits.low and limits.high"
        )
    name, joint = SIDES[kind // joints], kind % joints + 1
    if name == "torque":
        needed = limits.torque[joint - 1] * (1 - worst[best])
        raise LimitsError(
            f"limits.torque of joint {joint} is {limits.torque[joint - 1]:.4g}, but standing still "
            f"{where} needs at least {needed:.4g}: raise it, or move the limits of position"
        )
    raise LimitsError(
        f"limits.{name} of joint {joint} allows no pose {where}: widen it, or start elsewhere"
    )


def _grid(joints: int) -> Float[np.ndarray, "points joints"]:
    """Points that fill the unit cube; the first is its centre."""
    import scipy

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
    """The search space, and the free numbers of a pose within all limits.

    Arguments are those of `optimal_excitation`.
    """
    import scipy

    _check(loop, limits, period, harmonics, rate, noise, start)
    if not chosen_parameters(loop, kind):
        raise FitError(f"{loop.name} has no free parameter to determine: free one with loop.free")
    pose = pose_within(loop, limits, None if start is None else np.asarray(start, float))
    at_start = fourier_basis(np.zeros(1), period, harmonics)[:, 0]
    rest = at_start[1:] if start is None else at_start
    # High harmonics start small, because speed and acceleration grow with the harmonic number.
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
    settings = Settings(kind=kind, criterion=criterion, noise=levels, scales=scales)
    if loop.stepping.substeps is None:
        fastest = _fastest_at(loop, pose)
        fastest = max(1 / 2.5e-3, fastest / 0.25)
        loop = set_substeps(loop, steps_at(fastest, 1 / rate, loop.name))
    design = Design(
        loop=loop,
        limits=limits,
        settings=settings,
        base=base,
        span=span,
        time=points,
        basis=fourier_basis(points, period, harmonics),
        samples=samples,
        sampled=fourier_basis(samples, period, harmonics),
        period=float(period),
        weight=n / few,
    )
    return design, centre


def _fastest_at(loop: ClosedLoop, pose: Float[np.ndarray, " joints"]) -> float:
    """Largest eigenvalue of the loop at standstill in a pose, 1/s."""
    q = np.stack([pose, pose + 1e-3])
    return fastest_rate(loop, Recordings((Recording(np.arange(2.0), q, q),)))
