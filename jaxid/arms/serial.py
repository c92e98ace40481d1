"""A serial spatial arm with any number of joints, in base parameters."""

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import BODY, Chain, InSpace, inverse_by_rows, moved_body
from ..errors import ModelError
from ..parameters import KNOWN, Vector, as_float64, parameter
from ._base import AbstractArm
from .urdf import Described, read_urdf


class SerialArm(AbstractArm):
    """A chain of turning and sliding joints, linear in its base parameters.

    Torque depends only on some combinations of the ten parameters of each link (Gautier, Khalil
    1990). `base` holds these combinations, each named after its leading parameter. The other
    parameters stay at the values of `bodies`. `SerialArm.from_urdf` reads a URDF file.

    **Arguments:**

    - `chain`: its joints. `bodies`: `BODY` of each link as drawn, SI units, `(joints, 10)`.
    - `lower`, `upper`: limits of the joints, `(joints,)`, rad or m.
    - `gears`: turns of each motor per turn of each joint, `(joints, joints)`, if motors drive more
      than their own joint; None if each motor drives one joint.
    - `base`: values of the base parameters, `(base,)`, in kg·m², kg·m or kg according to their
      names; those of `bodies` by default.
    - `leading`, `base_names`, `combined`: results of `base_parameters`, which is called if they
      are left out.
    - `covariance`: of the base parameters of `bodies` before any recording, `(base, base)`, in
      products of their units; None if nothing is known. `drawn_covariance` computes it.
    """

    constants = ("chain", "bodies", "combined")
    chain: Chain = eqx.field(metadata=KNOWN)
    bodies: Float[Array, "joints 10"] = eqx.field(converter=as_float64)
    lower: tuple[float, ...] = eqx.field(static=True)
    upper: tuple[float, ...] = eqx.field(static=True)
    gears: tuple[tuple[float, ...], ...] | None = eqx.field(static=True, default=None)
    base: Vector = parameter(None, symbol="base", unit="SI", scale=1.0)
    leading: tuple[int, ...] = eqx.field(static=True, default=())
    base_names: tuple[str, ...] = eqx.field(static=True, default=())
    combined: Float[Array, "base parameters"] = eqx.field(converter=as_float64, default=None)
    covariance: Float[Array, "base base"] | None = eqx.field(converter=as_float64, default=None)

    def __post_init__(self):
        if not self.leading:
            found = base_parameters(self.chain, self.lower, self.upper)
            self.leading, self.base_names, self.combined = found
        if self.base is None:
            self.base = jnp.asarray(self.combined) @ jnp.ravel(jnp.asarray(self.bodies))

    @classmethod
    def from_urdf(
        cls,
        source: str | os.PathLike[str],
        *,
        base: str | None = None,
        tip: str | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        gears: Any = None,
    ) -> "SerialArm":
        """The arm that a URDF describes, between two of its links.

        **Arguments:**

        - `source`: path of the file, or its text.
        - `base`, `tip`: names of the first and last link; if None, the root and the only leaf.
        - `gravity`: in the frame of the first link, m/s².
        - `gears`: as in the class.

        **Raises:** `ModelError` for a file that cannot be read or describes no such chain.
        """
        return cls.of(read_urdf(source, base, tip), gravity, gears)

    @classmethod
    def of(
        cls,
        found: Described,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        gears: Any = None,
    ) -> "SerialArm":
        """The arm of a URDF that was read."""
        if gears is not None and np.shape(gears) != (len(found.joints),) * 2:
            raise ModelError(
                f"gears have shape {np.shape(gears)}, but the arm has {len(found.joints)} joints: "
                "give a square matrix with a row per motor and a column per joint"
            )
        rotations, offsets, axes = (
            np.stack([getattr(joint, what) for joint in found.joints])
            for what in ("rotation", "offset", "axis")
        )
        slides = tuple(joint.slides for joint in found.joints)
        chain = Chain(rotations, offsets, axes, gravity, slides, found.tip)
        lower = tuple(joint.lower for joint in found.joints)
        upper = tuple(joint.upper for joint in found.joints)
        matrix = (
            None
            if gears is None
            else tuple(tuple(float(x) for x in row) for row in np.asarray(gears))
        )
        return cls(chain, found.bodies, lower, upper, matrix)

    @property
    def joints(self) -> int:
        """Number of joints of the chain."""
        return self.chain.joints

    def prismatic(self) -> tuple[bool, ...]:
        """Whether each joint of the chain slides."""
        return self.chain.slides

    def inertias(self) -> Float[Array, "joints 10"]:
        """`BODY` of each link with these base parameters, SI units.

        They give the torque of these base parameters; combinations on which torque does not depend
        are as in `bodies`.
        """
        drawn = self.bodies.reshape(-1)
        changed = self.base - self.combined @ drawn
        # Number by number: an array operation would break up the kernel of a simulation's loop.
        place = {leading: k for k, leading in enumerate(self.leading)}
        numbers = [x + changed[place[k]] if k in place else x for k, x in enumerate(drawn)]
        return jnp.stack(numbers).reshape(self.bodies.shape)

    def combinations(self) -> dict[str, str]:
        """Each base parameter as a sum of link parameters."""
        names = [f"{what}{k}" for k in range(1, self.joints + 1) for what in BODY]
        rows = np.asarray(self.combined)
        found = {}
        for name, row in zip(self.base_names, rows, strict=True):
            terms = [(names[k], row[k]) for k in np.flatnonzero(np.abs(row) > 1e-6)]
            terms.sort(key=lambda term: term[0] != name.removesuffix("R"))
            text = " ".join(
                f"{'-' if c < 0 else '+'} {'' if abs(abs(c) - 1) < 1e-9 else f'{abs(c):.4g} '}{t}"
                for t, c in terms
            )
            found[name] = text.removeprefix("+ ")
        return found

    def mass_matrix(self, q: Float[Array, " joints"]) -> Float[Array, "joints joints"]:
        """Inertia at q, `(joints, joints)`, kg·m² or kg."""
        return self.chain.mass_matrix(self.inertias(), q)

    def bias(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Coriolis, centrifugal and gravity torque, `(joints,)`, N·m or N."""
        return self.chain.inverse(self.inertias(), q, v, jnp.zeros_like(q))

    def inverse(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, " joints"]:
        """Torque needed for a motion, `(joints,)`, N·m or N, without forming the inertia matrix."""
        return inverse_by_rows(self.chain, self.inertias(), q, v, a)

    def inverse_slopes(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> tuple[Float[Array, "joints joints"], Float[Array, "joints joints"]]:
        """Derivatives of `inverse` by position and velocity, a row for each torque, SI units."""
        return self.chain.inverse_slopes(self.inertias(), q, v, a)

    def expected(self) -> tuple[Float[Array, " base"], Float[Array, "base base"]] | None:
        """The base parameters of the drawn bodies, and their covariance if it is given."""
        if self.covariance is None:
            return None
        return self.combined @ self.bodies.reshape(-1), self.covariance

    def absorbed_rotors(self) -> tuple[bool, ...]:
        """Whether each joint's rotor inertia is part of a base parameter, `(joints,)`."""
        return tuple(not np.isnan(column).any() for column in self.rotors_in_base().T)

    def rotors_in_base(self) -> Float[np.ndarray, "base joints"]:
        """Change of the base parameters by a unit of each rotor's inertia; NaN if none has it."""
        rows, a = _regressor(_geometry(self.chain), self.chain.slides, self.lower, self.upper)
        basis, triangle = np.linalg.qr(rows[:, np.asarray(self.leading)])
        found = np.full((basis.shape[1], self.joints), np.nan)
        for j in range(self.joints):
            column = np.zeros((len(a), self.joints))
            column[:, j] = a[:, j]
            flat = column.ravel()
            within = basis.T @ flat
            if np.linalg.norm(flat - basis @ within) < 1e-7 * np.linalg.norm(flat):
                found[:, j] = np.linalg.solve(triangle, within)
        return found

    def planar(self) -> bool:
        """False: the links move in space."""
        return False

    def in_space(self) -> InSpace:
        """Its chain and bodies."""
        shift, bodies = _shift_and_bodies(self)
        shown = np.asarray(self.combined)[:, -10:] @ np.asarray(shift)
        # Mass and first moments, which also cause gravity torque, before moments of inertia.
        kept = _independent(shown, [9, 6, 7, 8, *range(6)], 1e-6)
        return InSpace(self.chain, bodies, tuple(kept))

    def couplings(self) -> tuple[tuple[int, int, float], ...]:
        """Pairs that `gears` couples; without `gears`, all neighbouring joints that turn."""
        if self.gears is None:
            turning = [not slides for slides in self.chain.slides]
            pairs = [j for j in range(1, self.joints) if turning[j - 1] and turning[j]]
            return tuple((j, j + 1, sign) for j in pairs for sign in (1.0, -1.0))
        return tuple(
            (joint, motor, turns / row[motor - 1])
            for motor, row in enumerate(self.gears, start=1)
            for joint, turns in enumerate(row, start=1)
            if joint != motor and turns != 0 and row[motor - 1] != 0
        )

    def gravity(self) -> float:
        """Magnitude of gravity, m/s²."""
        return float(np.linalg.norm(np.asarray(self.chain.gravity)))

    def workspace(self) -> Float[np.ndarray, "points joints"]:
        """Random positions between the limits, `(points, joints)`."""
        low, high = np.asarray(self.lower), np.asarray(self.upper)
        return np.random.default_rng(0).uniform(low, high, (8 * self.joints, self.joints))

    def smallest_inertia(self) -> Float[Array, ""]:
        """Smallest eigenvalue of the mass matrix over the workspace; above zero if physical.

        With bodies drawn as points it is zero up to rounding. Rotor inertias are not included.
        """
        masses = jax.vmap(self.mass_matrix)(jnp.asarray(self.workspace()))
        found = jnp.linalg.eigvalsh(masses)
        return jnp.min(found) + 1e-9 * jnp.max(found)


@eqx.filter_jit
def _shift_and_bodies(
    arm: SerialArm,
) -> tuple[Float[Array, "10 10"], Float[Array, "joints 10"]]:
    """Parameters of a body at the tip as those of the last link, and those of all links."""
    return jax.jacfwd(moved_body)(jnp.zeros(10), arm.chain.tip), arm.inertias()


def base_parameters(
    chain: Chain, lower: tuple[float, ...], upper: tuple[float, ...]
) -> tuple[tuple[int, ...], tuple[str, ...], Float[np.ndarray, "base parameters"]]:
    """The combinations of the bodies' parameters on which torque depends (Gautier 1991).

    **Arguments:**

    - `lower`, `upper`: limits of the joints, rad or m.

    **Returns:** for each combination, the place of its leading parameter and its name (with an R if
    other parameters are added), and the combinations, `(base, 10 · joints)`.
    """
    return _base_parameters(_geometry(chain), chain.slides, lower, upper)


Geometry = tuple[tuple[float, ...], ...]


def _geometry(chain: Chain) -> Geometry:
    """A chain's numbers in hashable form, for a cache."""
    arrays = chain.rotations, chain.offsets, chain.axes, chain.gravity
    return tuple(tuple(np.asarray(x).ravel().tolist()) for x in arrays)


def _chain(geometry: Geometry, slides: tuple[bool, ...]) -> Chain:
    n = len(slides)
    turns, places, axes, gravity = (np.asarray(x) for x in geometry)
    return Chain(turns.reshape(n, 3, 3), places.reshape(n, 3), axes.reshape(n, 3), gravity, slides)


@lru_cache(maxsize=64)
def _base_parameters(
    geometry: Geometry,
    slides: tuple[bool, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> tuple[tuple[int, ...], tuple[str, ...], Float[np.ndarray, "base parameters"]]:
    import scipy

    chain = _chain(geometry, slides)
    rows, _ = _regressor(geometry, slides, lower, upper)
    order = sorted(range(rows.shape[1]), key=lambda k: _led(k, chain))
    kept = sorted(_independent(rows, order, 1e-7))
    combined = scipy.linalg.lstsq(rows[:, kept], rows)[0]
    combined[np.abs(combined) < 1e-9] = 0.0
    names = []
    for row, k in zip(combined, kept, strict=True):
        several = np.count_nonzero(np.abs(row) > 1e-6) > 1
        names.append(f"{BODY[k % 10]}{k // 10 + 1}{'R' if several else ''}")
    return tuple(kept), tuple(names), combined


def _independent(
    rows: Float[np.ndarray, "rows columns"], order: Sequence[int], tolerance: float
) -> list[int]:
    """Columns that do not depend linearly on earlier ones, in the given order."""
    size = np.linalg.norm(rows, axis=0)
    kept: list[int] = []
    basis = np.zeros((len(rows), 0))
    for k in order:
        if size[k] <= 1e-9 * size.max():
            continue
        column = rows[:, k] / size[k]
        for _ in range(2):
            column = column - basis @ (basis.T @ column)
        left = np.linalg.norm(column)
        if left > tolerance:
            basis = np.column_stack([basis, column / left])
            kept.append(k)
    return kept


def _led(place: int, chain: Chain) -> tuple[bool, int]:
    """The rank of a parameter among those that may lead a combination.

    Mass, the first moment along the axis and one moment across it are combined with parameters of
    the previous link (Khalil, Dombre 2002). They lead a combination only without such parameters.
    """
    axis = int(np.argmax(np.abs(np.asarray(chain.axes)[place // 10])))
    across = (axis + 2) % 3
    led = (("XX", "YY", "ZZ")[across], ("MX", "MY", "MZ")[axis], "M")
    return BODY[place % 10] in led, place


@lru_cache(maxsize=8)
def _regressor(
    geometry: Geometry,
    slides: tuple[bool, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> tuple[Float[np.ndarray, "rows parameters"], Float[np.ndarray, "states joints"]]:
    """Regressor of all bodies' parameters at random states, a row per joint; accelerations."""
    chain, n = _chain(geometry, slides), len(slides)
    rng = np.random.default_rng(0)
    q = rng.uniform(lower, upper, (20 * n, n))
    v, a = rng.normal(size=(2, 20 * n, n))
    rows = jax.jit(jax.vmap(chain.regressor))(q, v, a)
    return np.asarray(rows).reshape(-1, 10 * n), a
