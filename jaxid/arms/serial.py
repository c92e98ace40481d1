"""A serial spatial arm with any number of joints, in base parameters."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import BODY, BODY_UNITS, Chain
from ..parameters import KNOWN, Vector, as_float64, parameter
from ._serial import AbstractSerialArm
from .base_parameters import base_parameters, random_regressor


class SerialArm(AbstractSerialArm):
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
    base: Vector = parameter(None, symbol="base", unit="", scale=1.0)
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

    @property
    def base_units(self) -> tuple[str, ...]:
        """Units of the base parameters: those of their leading parameters."""
        return tuple(BODY_UNITS[k % len(BODY)] for k in self.leading)

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
        rows, a = random_regressor(self.chain, self.lower, self.upper)
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
