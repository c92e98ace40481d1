"""Stepwise regression on filtered derivatives, with jaxid's own catalogue, as a baseline.

The motion is low-passed without delay and differentiated. Every effect of the catalogue gives the
torque that it would need along that motion. Columns enter one effect at a time by BIC while an
F-test accepts them. Elasticity and backlash have no torque along a measured motion and are left
out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import jaxid
from jaxid import effects as fx
from jaxid.discovery.signs import shapes_of_signs
from jaxid.effects import recording_label
from jaxid.errors import FitError
from jaxid.estimate.regression import decimator, filtered, linear_parameters, regression
from jaxid.parameters import list_parameters, read_values, write_values
from jaxid.simulation.loads import inverse
from jaxid.simulation.runs import Simulated

Key = tuple[str, int | None]
# A column with less than this share beyond the others is ignored.
WEAK = 1e-6


@dataclass(frozen=True)
class Entry:
    """One effect that was selected: its key, its p-value, and the place of its block."""

    key: Key
    p_value: float
    place: int


@dataclass(frozen=True)
class Rows:
    """Rows of all recordings, scaled by each joint's deviation: base, candidates, torque."""

    base: np.ndarray
    blocks: list[np.ndarray]
    keys: list[Key]
    right: np.ndarray


def first_effect(
    loop: jaxid.ClosedLoop, recordings: jaxid.Recordings, p_to_enter: float = 0.01
) -> Key | None:
    """The effect that is selected first, with its joint; None if none is selected."""
    entered = select(loop, recordings, p_to_enter, most=1)
    return entered[0].key if entered else None


def select(
    loop: jaxid.ClosedLoop,
    recordings: jaxid.Recordings,
    p_to_enter: float = 0.01,
    most: int = 6,
) -> list[Entry]:
    """Forward selection by BIC while the F-test's p-value stays below `p_to_enter`."""
    return forward(assemble(loop, recordings), p_to_enter, most)


def forward(rows: Rows, p_to_enter: float = 0.01, most: int = 6) -> list[Entry]:
    """Forward selection among blocks of columns."""
    basis = _basis(rows.base)
    entered: list[Entry] = []
    while len(entered) < most:
        entry, basis = _enter(rows, basis)
        if entry is None or entry.p_value > p_to_enter:
            break
        entered.append(entry)
    return entered


def _enter(rows: Rows, basis: np.ndarray) -> tuple[Entry | None, np.ndarray]:
    """The best block by BIC and the basis with it."""
    count = len(rows.right)
    rest = rows.right - basis @ (basis.T @ rows.right)
    left = float(rest @ rest)
    best, price, grown = None, count * np.log(left), basis
    for place, (key, block) in enumerate(zip(rows.keys, rows.blocks, strict=True)):
        own = _basis(block, basis)
        if own.shape[1] == 0:
            continue
        spare = count - basis.shape[1] - own.shape[1]
        if spare <= 0:
            continue
        taken = float(np.sum((own.T @ rest) ** 2))
        still = max(left - taken, 1e-12 * left)
        bic = count * np.log(still) + own.shape[1] * np.log(count)
        if bic < price:
            f = taken / own.shape[1] / (still / spare)
            best = Entry(key, float(stats.f.sf(f, own.shape[1], spare)), place)
            price, grown = bic, np.concatenate([basis, own], axis=1)
    return best, grown


def _basis(columns: np.ndarray, beside: np.ndarray | None = None) -> np.ndarray:
    """An orthonormal basis of columns, orthogonal to another basis."""
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    if beside is not None:
        columns = columns - beside @ (beside.T @ columns)
    if columns.shape[1] == 0:
        return columns
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > WEAK]


# --- the regression ------------------------------------------------------------------------------


def settle(recordings: jaxid.Recordings) -> jaxid.Filtering:
    """The filter with the cutoffs of the spectra, or a tenth of the rate if these are too low."""
    try:
        for recording in recordings:
            jaxid.Filtering().settled(recording)
    except FitError:
        return jaxid.Filtering(cutoff=min(r.rate for r in recordings) / 10)
    return jaxid.Filtering()


def assemble(loop: jaxid.ClosedLoop, recordings: jaxid.Recordings) -> Rows:
    """Base and candidate columns along the filtered motion, all with the same filter, decimated."""
    filtering = settle(recordings)
    reducers = [decimator(r, filtering) for r in recordings]
    motions = [filtered(r, filtering) for r in recordings]
    bases, rights = [], []
    for recording, motion, reduce in zip(recordings, motions, reducers, strict=True):
        wide, right = regression(loop, recording, motion)
        bases.append(reduce(wide))
        rights.append(reduce(right))
    base, right = np.concatenate(bases), np.concatenate(rights)
    theta = np.linalg.lstsq(_flat(base), right.reshape(-1), rcond=None)[0]
    fitted = write_values(loop, linear_parameters(loop), jnp.asarray(theta))
    weight = 1 / np.sqrt(np.mean((right - base @ theta) ** 2, axis=0))
    tones = _tones(
        [r - b @ theta for r, b in zip(rights, bases, strict=True)], recordings, reducers
    )
    scene = survey(fitted, recordings, motions, tones)
    keys, blocks = [], []
    for effect in proposed(scene):
        parts = [
            reduce(columns(fitted, effect, recording, motion))
            for recording, motion, reduce in zip(recordings, motions, reducers, strict=True)
        ]
        block = _flat(np.concatenate(parts) * weight[:, None])
        if np.isfinite(block).all():
            blocks.append(block)
            keys.append((effect.effect_name(), getattr(effect, "joint", None)))
    return Rows(_flat(base * weight[:, None]), blocks, keys, (right * weight).reshape(-1))


def _flat(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1, x.shape[-1])


def proposed(scene: fx.Scene) -> list[fx.AbstractEffect]:
    """The catalogue's settings to screen, without transmissions."""
    kinds = [kind for kind in fx.catalogue if not issubclass(kind, fx.AbstractTransmission)]
    return [effect for kind in kinds for effect in kind.screened(scene)]


def survey(
    loop: jaxid.ClosedLoop,
    recordings: jaxid.Recordings,
    motions: Sequence[Simulated],
    tones: Sequence[Sequence[float]],
) -> fx.Scene:
    """Ranges of the measured motion, for the grids of shapes."""
    q, v, tau = (
        np.concatenate([np.asarray(getattr(m, n)) for m in motions]) for n in ["q", "v", "tau"]
    )
    mass = np.asarray(jax.vmap(loop.arm.mass_matrix)(jnp.asarray(q[::50])))
    return fx.Scene(
        q.min(axis=0),
        q.max(axis=0),
        np.abs(v).max(axis=0),
        np.abs(tau).max(axis=0),
        np.einsum("kjj->j", mass) / len(mass),
        *shapes_of_signs(loop),
        float(np.median([r.period for r in recordings])),
        float(max(r.duration for r in recordings)),
        tuple(recordings.names),
        tuple(tuple(row) for row in tones),
        tuple(float(x) for x in loop.arm.link_lengths()),
        float(loop.arm.gravity()),
        tuple(loop.arm.prismatic()),
        tuple(loop.arm.first_moments()),
    )


def _tones(residuals, recordings, reducers, most: int = 4) -> list[list[float]]:
    """The highest peaks of each joint's residual spectrum, Hz."""
    found = []
    for j in range(residuals[0].shape[1]):
        power, f = 0.0, np.zeros(0)
        shortest = min(len(r) for r in residuals)
        for rest, recording, reduce in zip(residuals, recordings, reducers, strict=True):
            kept = len(reduce(recording.time))
            period = float(np.diff(reduce(recording.time)[kept // 2 - 1 : kept // 2 + 1])[0])
            wave = rest[:shortest, j] * np.hanning(shortest)
            f = np.fft.rfftfreq(4 * shortest, period)
            power = power + np.abs(np.fft.rfft(wave, 4 * shortest)) ** 2
        power, row = np.where(f > 0.1, power, 0.0), []
        for _ in range(most):
            k = int(np.argmax(power))
            row.append(float(f[k]))
            power[np.abs(f - f[k]) < 8 * f[1]] = 0.0
        found.append(row)
    return found


# --- columns of one effect -----------------------------------------------------------------------


def columns(
    loop: jaxid.ClosedLoop, effect: fx.AbstractEffect, recording: jaxid.Recording, motion: Simulated
) -> np.ndarray:
    """Commanded torque that one effect would need, by amplitude, `(samples, joints, ...)`.

    A lag and a delay act on the torque itself: by its derivative and by a shift.
    """
    if isinstance(effect, (fx.ActuatorLag, fx.TimeDelay)):
        return _late(effect, np.asarray(motion.time), np.asarray(motion.tau))
    n = motion.q.shape[0]
    at = jax.vmap(fx.Motion)(
        *(jnp.asarray(getattr(motion, name)) for name in ("time", "q", "v", "a", "tau")),
        jnp.zeros((n, 0)),
        jnp.full(n, recording_label(recording.name)),
    )
    return np.asarray(_needed(loop, effect, at))


def _late(effect: fx.ActuatorLag | fx.TimeDelay, time: np.ndarray, tau: np.ndarray) -> np.ndarray:
    j, column = effect.joint - 1, np.zeros((*tau.shape, 1))
    if isinstance(effect, fx.ActuatorLag):
        column[:, j, 0] = np.gradient(tau[:, j], time)
    else:
        column[:, j, 0] = tau[:, j] - np.interp(time - float(effect.delay), time, tau[:, j])
    return column


@eqx.filter_jit
def _needed(loop: jaxid.ClosedLoop, effect: fx.AbstractEffect, at: fx.Motion) -> jax.Array:
    linear = tuple(
        p for p in list_parameters(effect) if p.declaration.free and p.declaration.linear
    )
    states = _states(effect, at)
    still = tuple(e.initial_state() for e in loop.effects)

    def along(values):
        here = write_values(effect, linear, values) if linear else effect

        def one(measured, own):
            true = _behind_sensor(here, measured)
            driven = replace(true, state=own)
            delivered = here.command(driven)
            grown = loop.add(here)
            needed = inverse(grown, replace(true, tau=delivered), (*still, own))
            return needed - (delivered - measured.tau)

        return jax.vmap(one)(at, states)

    if linear:
        return jax.jacfwd(along)(read_values(effect, linear))
    absent = jax.vmap(lambda m: inverse(loop, m, still))(at)
    return (along(jnp.zeros(0)) - absent)[..., None]


def _behind_sensor(effect: fx.AbstractEffect, measured: fx.Motion) -> fx.Motion:
    """The motion that a sensor with this effect would read as the measured one."""

    def true(q):
        return 2 * q - effect.read(q)

    def speed(q, v):
        return jax.jvp(true, (q,), (v,))[1]

    q, v, a = measured.q, measured.v, measured.a
    return replace(measured, q=true(q), v=speed(q, v), a=jax.jvp(speed, (q, v), (v, a))[1])


def _states(effect: fx.AbstractEffect, at: fx.Motion) -> jax.Array:
    """An effect's own states along a motion, by an exponential step for each sample."""
    start = effect.initial_state()
    if start.shape[0] == 0:
        return jnp.zeros((at.t.shape[0], 0))

    def body(x, pair):
        now, h = pair

        def rate(state):
            return effect.derivative(replace(now, state=state))

        slope = h * jnp.diagonal(jax.jacfwd(rate)(x))
        small = jnp.abs(slope) < 1e-6
        gain = jnp.where(small, 1.0, jnp.expm1(slope) / jnp.where(small, 1.0, slope))
        return x + h * gain * rate(x), x

    steps = jnp.diff(at.t, append=at.t[-1:])
    return jax.lax.scan(body, start, (at, steps))[1]
