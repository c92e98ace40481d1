"""A serial spatial arm whose links are physical bodies whatever its parameters are."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..chain import Chain
from ..errors import ModelError
from ..parameters import KNOWN, Vector, as_float64, parameter
from ._serial import AbstractSerialArm
from .physical import pseudo_inertia
from .serial import SerialArm

# The deformations of a link, in the order of its parameters.
DEFORMATIONS = (
    "density",
    "stretch_x",
    "stretch_y",
    "stretch_z",
    "shear_xy",
    "shear_xz",
    "shear_yz",
    "shift_x",
    "shift_y",
    "shift_z",
)
# Radius of gyration below which a body is a point, a line or a plate, and that of the ball which is
# then added to it, relative to the distance of its centre of mass from the joint.
_THIN, _BALL = 0.01, 0.1
# Smallest such distance, m. Deviation of the stretch of a body that got a ball.
_NEAR, _UNKNOWN = 0.05, 1.0


class PhysicalArm(AbstractSerialArm):
    """A chain of turning and sliding joints whose links are the drawn bodies, deformed.

    Each link has ten parameters, which are zero as drawn: the logarithm of its density relative to
    the drawing, and an affine map of its points. In axes through its centre of mass in which the
    drawn body has unit radii of gyration, the map has the upper triangular matrix with the diagonal
    exp(stretch) and shear above it, and it moves the centre by shift. These are the log-Cholesky
    parameters of Rucker and Wensing (2022) relative to the drawn body: the pseudo-inertia is
    positive definite for all values, and each physical body belongs to exactly one value.

    Torque is not linear in them. Many have no effect on the torque, so they need an uncertainty.

    **Arguments:**

    - `chain`: its joints. `bodies`: `BODY` of each link as drawn, SI units, `(joints, 10)`.
    - `lower`, `upper`: limits of the joints, `(joints,)`, rad or m.
    - `gears`: turns of each motor per turn of each joint, `(joints, joints)`, if motors drive more
      than their own joint; None if each motor drives one joint.
    - `deformation`: parameters of all links, `(10 · joints,)`, dimensionless, ordered as
      `DEFORMATIONS`; zero by default.
    - `uncertainty`: relative standard deviation of the drawn bodies, of which a stretch and a shear
      have half: squares of lengths are as uncertain as masses. The centre of mass is as uncertain
      as its distance from the joint or, if that is larger, the radius of gyration.

    A body that is drawn as a point, a line or a plate has no extent that could be deformed. It gets
    a ball with a tenth of the distance of its centre of mass from the joint as radius of gyration,
    whose stretch has a standard deviation of 1.

    **Raises:** `ModelError` if a drawn body is not physical.
    """

    constants = ("chain", "bodies", "roots")
    chain: Chain = eqx.field(metadata=KNOWN)
    bodies: Float[Array, "joints 10"] = eqx.field(converter=as_float64)
    lower: tuple[float, ...] = eqx.field(static=True)
    upper: tuple[float, ...] = eqx.field(static=True)
    gears: tuple[tuple[float, ...], ...] | None = eqx.field(static=True, default=None)
    deformation: Vector = parameter(None, symbol="deformation", unit="1", scale=0.2, linear=False)
    uncertainty: float = eqx.field(static=True, default=0.2)
    # Upper triangular roots of the drawn pseudo-inertias. They follow from `bodies`, also in a copy
    # with other bodies, so a given value is not used.
    roots: Float[Array, "joints 4 4"] = eqx.field(converter=as_float64, default=None)

    def __post_init__(self):
        bodies = np.asarray(self.bodies)
        self.roots = as_float64(np.stack([_root(k, body) for k, body in enumerate(bodies)]))
        if self.deformation is None:
            self.deformation = jnp.zeros(self.bodies.size)

    @property
    def deformation_names(self) -> tuple[str, ...]:
        """Names of the deformations of all links."""
        return tuple(f"{name}{k}" for k in range(1, self.joints + 1) for name in DEFORMATIONS)

    def inertias(self) -> Float[Array, "joints 10"]:
        """`BODY` of each deformed link, SI units."""
        # Sums over all links: an array operation for each would break up the kernel of a
        # simulation's loop.
        density, *rest = self.deformation.reshape(-1, 10).T
        sx, sy, sz, xy, xz, yz, tx, ty, tz = rest
        x, y, z = jnp.exp(sx), jnp.exp(sy), jnp.exp(sz)
        r = [[self.roots[:, i, j] for j in range(4)] for i in range(4)]
        # The root times the map.
        a, b, c = r[0][0] * x, r[0][0] * xy + r[0][1] * y, r[0][0] * xz + r[0][1] * yz + r[0][2] * z
        d, e, f = r[1][1] * y, r[1][1] * yz + r[1][2] * z, r[2][2] * z
        mx = r[0][0] * tx + r[0][1] * ty + r[0][2] * tz + r[0][3]
        my = r[1][1] * ty + r[1][2] * tz + r[1][3]
        mz, m = r[2][2] * tz + r[2][3], r[3][3]
        # The products of its rows: second moments, first moments and mass.
        xx = a * a + b * b + c * c + mx * mx
        yy = d * d + e * e + my * my
        zz = f * f + mz * mz
        of_pairs = b * d + c * e + mx * my, c * f + mx * mz, e * f + my * mz
        moments = yy + zz, -of_pairs[0], -of_pairs[1], xx + zz, -of_pairs[2], xx + yy
        body = jnp.stack([*moments, mx * m, my * m, mz * m, m * m], axis=1)
        return jnp.exp(density)[:, None] * body

    def expected(self) -> tuple[Float[Array, " values"], Float[Array, "values values"]] | None:
        """No deformation, and the covariance that follows from `uncertainty`."""
        roots = np.asarray(self.roots)
        centre = np.linalg.norm(roots[:, :3, 3], axis=1)
        radius = np.linalg.norm(roots[:, :3, :3], axis=(1, 2))
        thin = [_is_thin(*_about_centre(np.asarray(body))[1:]) for body in self.bodies]
        stretch = np.where(thin, _UNKNOWN, self.uncertainty / 2)
        moved = self.uncertainty * np.maximum(1, centre / radius)
        plain = np.full(len(roots), self.uncertainty)
        deviation = [plain, *[stretch] * 3, *[plain / 2] * 3, *[moved] * 3]
        return jnp.zeros(self.bodies.size), jnp.diag(np.stack(deviation, axis=1).ravel() ** 2)


def in_base_parameters(
    arm: PhysicalArm, covariance: Float[np.ndarray, "values values"]
) -> tuple[SerialArm, Float[np.ndarray, "base base"]]:
    """The same arm in base parameters, and their covariance.

    **Arguments:**

    - `arm`: with estimated deformations. `covariance`: of these.
    """
    drawn = SerialArm(arm.chain, arm.bodies, arm.lower, arm.upper, arm.gears)

    def base(deformation: Float[Array, " values"]) -> Float[Array, " base"]:
        moved = dataclasses.replace(arm, deformation=deformation)
        return drawn.combined @ moved.inertias().reshape(-1)

    slopes = np.asarray(jax.jacfwd(base)(arm.deformation))
    own = dataclasses.replace(drawn, base=base(arm.deformation))
    return own, slopes @ covariance @ slopes.T


def _root(k: int, body: Float[np.ndarray, "10"]) -> Float[np.ndarray, "4 4"]:
    """The upper triangular root of a drawn body's pseudo-inertia.

    **Arguments:**

    - `k`: number of its link, from zero.
    """
    mass, centre, squares = _about_centre(body)
    whole = pseudo_inertia(np, body)
    if _is_thin(centre, squares):
        size = _BALL * max(np.linalg.norm(centre), _NEAR)
        whole[:3, :3] += mass * size**2 * np.eye(3)
    if not mass > 0 or np.linalg.eigvalsh(whole)[0] <= 0:
        raise ModelError(
            f"link {k + 1} is drawn with a mass of {mass:.3g} kg and the squared radii of gyration "
            f"{', '.join(f'{x:.3g}' for x in squares)} m², which is not physical: correct the "
            "file, or estimate base parameters (bodies='near')"
        )
    return np.linalg.cholesky(whole[::-1, ::-1])[::-1, ::-1]


def _about_centre(
    body: Float[np.ndarray, "10"],
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Mass, centre of mass, and squared radii of gyration about it, ascending; NaN if massless."""
    whole = pseudo_inertia(np, body)
    mass = float(whole[3, 3])
    if mass == 0:
        return mass, np.zeros(3), np.full(3, np.nan)
    centre = whole[:3, 3] / mass
    return mass, centre, np.linalg.eigvalsh(whole[:3, :3] / mass - np.outer(centre, centre))


def _is_thin(centre: Float[np.ndarray, "3"], squares: Float[np.ndarray, "3"]) -> bool:
    """Whether a body is a point, a line or a plate."""
    return bool(squares[0] < (_THIN * max(np.linalg.norm(centre), _NEAR)) ** 2)
