"""Rows of a rigid robot's regression, by SciPy's filters and Pinocchio's regressor.

Of jaxid only the reading of recordings is used, not its arms, effects or search.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import signal

import jaxid

# Sample rate over cutoff, and over the rate of the rows.
CUTOFF = 10
THINNED = 4
# Below this share of the top speed, the motion does not determine friction.
SLOW = 0.01
# Trial widths of the sign of velocity, in shares of the top speed.
WIDTHS = tuple(np.geomspace(0.001, 0.06, 13).tolist())
# Seconds of a block; every third block is left out of the fit for choices.
BLOCK = 1.0
# Number of columns that each joint has on its own.
OWN = 4


@dataclass(frozen=True)
class Motion:
    """Low-passed motion and torque of a recording, `(samples, joints)`, and Pinocchio's regressor
    along it, `(samples, joints, ten of each link)`."""

    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    rate: float
    bodies: np.ndarray

    @classmethod
    def of(cls, urdf: str, recording: jaxid.Recording) -> "Motion":
        """The recording through a low-pass without delay, differentiated by central differences.

        **Arguments:**

        - `urdf`: the drawn robot; its masses and inertias are not used.
        """
        time, rate = np.asarray(recording.time), float(recording.rate)
        q, tau = (_passed(np.asarray(x), rate) for x in (recording.q, recording.tau))
        v = np.gradient(q, 1 / rate, axis=0)
        a = np.gradient(v, 1 / rate, axis=0)
        return cls(time, q, v, a, tau, rate, _regressor(urdf, q, v, a))

    def thinned(self, x: np.ndarray) -> np.ndarray:
        """Signals along the motion, with the low-pass of its torque, at fewer samples."""
        return self.picked(_passed(x, self.rate))

    def picked(self, x: np.ndarray) -> np.ndarray:
        """The samples of the rows, without those near the ends that the filter affects."""
        ends = 2 * CUTOFF
        return x[ends : len(x) - ends : THINNED]


def _passed(x: np.ndarray, rate: float) -> np.ndarray:
    return signal.sosfiltfilt(signal.butter(4, rate / CUTOFF, fs=rate, output="sos"), x, axis=0)


# Torque of one joint along a motion, by amplitude, (samples, columns).
Columns = Callable[[Motion], np.ndarray]


@dataclass(frozen=True)
class Table:
    """The regression of some recordings on the rigid robot with friction.

    **Arguments:**

    - `widths`: widths of the sign of velocity by joint, rad/s or m/s.
    - `scale`: deviation of the residual torque by joint, by which rows are weighted.
    """

    motions: tuple[Motion, ...]
    widths: np.ndarray
    scale: np.ndarray

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.motions[0].q.shape[1]

    @cached_property
    def moving(self) -> list[np.ndarray]:
        """The thinned samples, of all motions concatenated, in which a joint moves."""
        v = np.abs(np.concatenate([m.picked(m.v) for m in self.motions]))
        return list((v > SLOW * v.max(axis=0)).T)

    @cached_property
    def base(self) -> np.ndarray:
        """Columns of the rigid robot, its rotors, friction and drives' delay, `(rows, columns)`."""
        thinned = [m.thinned(rigid_columns(m, self.widths)) for m in self.motions]
        return self.rows(np.concatenate(thinned))

    @cached_property
    def right(self) -> np.ndarray:
        """Torque, `(rows,)`."""
        return self.rows(np.concatenate([m.thinned(m.tau) for m in self.motions]))

    @cached_property
    def plain(self) -> np.ndarray:
        """The rigid robot's amplitudes without other effects, `(columns,)`."""
        return solved(self.base, self.right)

    def load(self, motion: Motion) -> np.ndarray:
        """The torque that moves links and rotors of the rigid robot, `(samples, joints)`.

        The recorded torque cannot be used instead, because it would explain itself.
        """
        own = motion.bodies.shape[-1]
        rotors = self.plain[own::OWN] * motion.a
        return motion.bodies @ self.plain[:own] + rotors

    @cached_property
    def left_out(self) -> np.ndarray:
        """The rows that are left out of the fit for choices."""
        times = np.concatenate([m.picked(m.time - m.time[0]) for m in self.motions])
        return np.concatenate([(times[kept] // BLOCK) % 3 == 2 for kept in self.moving])

    @cached_property
    def joint(self) -> np.ndarray:
        """The joint (from 0) of each row."""
        return np.concatenate([np.full(kept.sum(), j) for j, kept in enumerate(self.moving)])

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Thinned signals `(samples, joints, ...)` as rows in units of each joint's deviation."""
        return np.concatenate([x[kept, j] / self.scale[j] for j, kept in enumerate(self.moving)])

    def block(self, joint: int, columns: Columns) -> np.ndarray:
        """Torques of one joint (from 0) as rows, `(rows, columns)`."""
        felt = np.concatenate([m.thinned(columns(m)) for m in self.motions])
        spread = np.zeros((len(felt), self.joints, felt.shape[1]))
        spread[:, joint] = felt
        return self.rows(spread)

    def features(self, columns: Columns, joint: int) -> np.ndarray:
        """Signals along the motions at the rows of one joint, `(its rows, columns)`."""
        picked = np.concatenate([m.picked(columns(m)) for m in self.motions])
        return picked[self.moving[joint]]


def table_of(urdf: str, recordings: Sequence[jaxid.Recording]) -> Table:
    """The regression with the widths of the sign of smallest residual, joint by joint."""
    motions = tuple(Motion.of(urdf, r) for r in recordings)
    fastest = np.max([np.abs(m.v).max(axis=0) for m in motions], axis=0)
    scale = np.std(np.concatenate([m.tau for m in motions]), axis=0)
    table = Table(motions, 0.01 * fastest, scale)
    for j in range(len(fastest)):
        tried = []
        for share in WIDTHS:
            widths = table.widths.copy()
            widths[j] = share * fastest[j]
            tried.append(replace(table, widths=widths))
        table = min(tried, key=lambda t: float(np.sum(residual(t.base, t.right) ** 2)))
    rest = residual(table.base, table.right)
    left = [np.sqrt(np.mean(rest[table.joint == j] ** 2)) for j in range(len(fastest))]
    return replace(table, scale=table.scale * np.array(left))


def rigid_columns(motion: Motion, widths: np.ndarray) -> np.ndarray:
    """The linear model's columns along a motion, `(samples, joints, columns)`.

    They are ten parameters for every link, and for every joint the rotor, viscous and Coulomb
    friction, and a delay of the torque to first order.
    """
    slope = np.gradient(motion.tau, 1 / motion.rate, axis=0)
    own = np.stack([motion.a, motion.v, np.tanh(motion.v / widths), slope], axis=-1)
    joints = own.shape[1]
    spread = np.zeros((len(own), joints, joints, OWN))
    for j in range(joints):
        spread[:, j, j] = own[:, j]
    return np.concatenate([motion.bodies, spread.reshape(len(own), joints, -1)], axis=-1)


def _regressor(urdf: str, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    import pinocchio

    # Its compiled part has no types.
    pin: Any = pinocchio
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    rows = zip(q, v, a, strict=True)
    bodies = [pin.computeJointTorqueRegressor(model, data, *row) for row in rows]
    return np.reshape(bodies, (*q.shape, -1))


def solved(columns: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Least squares with normalised columns, against rounding errors."""
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0, size, 1.0)
    theta = np.linalg.lstsq(columns / size, right, rcond=1e-8)[0]
    return (theta.T / size).T


def residual(columns: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The residual of least squares."""
    return right - columns @ solved(columns, right)
