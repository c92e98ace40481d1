"""Base class of arms whose links are bodies of a chain in space."""

import abc
import os
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import Chain, InSpace, inverse_by_rows, moved_body
from ..errors import ModelError
from ..parameters import as_float64
from ._base import AbstractArm
from .base_parameters import base_parameters, independent
from .urdf import Described, read_urdf

_Arm = TypeVar("_Arm", bound="AbstractSerialArm")


class AbstractSerialArm(AbstractArm):
    """A chain of turning and sliding joints, each with a body that moves with it.

    - `chain`: its joints. `bodies`: `BODY` of each link as drawn, SI units, `(joints, 10)`.
    - `lower`, `upper`: limits of the joints, `(joints,)`, rad or m.
    - `gears`: turns of each motor per turn of each joint, `(joints, joints)`, if motors drive more
      than their own joint; None if each motor drives one joint.
    """

    chain: eqx.AbstractVar[Chain]
    bodies: eqx.AbstractVar[Float[Array, "joints 10"]]
    lower: eqx.AbstractVar[tuple[float, ...]]
    upper: eqx.AbstractVar[tuple[float, ...]]
    gears: eqx.AbstractVar[tuple[tuple[float, ...], ...] | None]

    @abc.abstractmethod
    def inertias(self) -> Float[Array, "joints 10"]:
        """`BODY` of each link, SI units."""

    @classmethod
    def from_urdf(
        cls: type[_Arm],
        source: str | os.PathLike[str],
        *,
        base: str | None = None,
        tip: str | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        gears: Any = None,
    ) -> _Arm:
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
        cls: type[_Arm],
        found: Described,
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        gears: Any = None,
    ) -> _Arm:
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
        return cls(chain, as_float64(found.bodies), lower, upper, matrix)

    @property
    def joints(self) -> int:
        """Number of joints of the chain."""
        return self.chain.joints

    def prismatic(self) -> tuple[bool, ...]:
        """Whether each joint of the chain slides."""
        return self.chain.slides

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

    def planar(self) -> bool:
        """False: the links move in space."""
        return False

    def in_space(self) -> InSpace:
        """Its chain and bodies."""
        shift, bodies = _shift_and_bodies(self)
        combined = base_parameters(self.chain, self.lower, self.upper)[2]
        shown = combined[:, -10:] @ np.asarray(shift)
        # Mass and first moments, which also cause gravity torque, before moments of inertia.
        kept = independent(shown, [9, 6, 7, 8, *range(6)], 1e-6)
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
    arm: AbstractSerialArm,
) -> tuple[Float[Array, "10 10"], Float[Array, "joints 10"]]:
    """Parameters of a body at the tip as those of the last link, and those of all links."""
    return jax.jacfwd(moved_body)(jnp.zeros(10), arm.chain.tip), arm.inertias()
