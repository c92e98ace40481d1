"""A chain of joints in space: forward kinematics and inverse dynamics."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .parameters import as_float64

# Names of a body's ten parameters (Khalil, Dombre 2002), without the link's number: inertia about
# the origin of the link's frame, first moment, mass.
BODY = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")


class Chain(eqx.Module):
    """A serial chain of joints, each with a link that moves with it.

    - `rotations`, `offsets`: from the previous link's frame to the joint's frame at zero, m.
    - `axes`: unit vectors in the joint's frame, along which it slides or about which it turns.
    - `gravity`: in the base's frame, m/s².
    - `slides`: whether a joint slides.
    - `tip`: where tools and payloads are fixed, in the last link's frame, m.
    """

    rotations: Float[Array, "joints 3 3"] = eqx.field(converter=as_float64)
    offsets: Float[Array, "joints 3"] = eqx.field(converter=as_float64)
    axes: Float[Array, "joints 3"] = eqx.field(converter=as_float64)
    gravity: Float[Array, "3"] = eqx.field(converter=as_float64)
    slides: tuple[bool, ...] = eqx.field(static=True)
    tip: Float[Array, "3"] = eqx.field(converter=as_float64, default=(0.0, 0.0, 0.0))

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.slides)

    def frames(
        self, q: Float[Array, " joints"]
    ) -> tuple[Float[Array, "joints 3 3"], Float[Array, "joints 3"], Float[Array, "joints 3"]]:
        """Rotation and origin of each link, and its joint's axis, in the base's frame."""
        turn, place = np.eye(3), np.zeros(3)
        turns, places, axes = [], [], []
        for k, slides in enumerate(self.slides):
            place = place + turn @ self.offsets[k]
            turn = turn @ self.rotations[k]
            axis = turn @ self.axes[k]
            if slides:
                place = place + axis * q[k]
            else:
                cross = _cross_matrix(self.axes[k])
                turn = turn @ (
                    np.eye(3) + jnp.sin(q[k]) * cross + (1 - jnp.cos(q[k])) * cross @ cross
                )
            turns.append(turn)
            places.append(place)
            axes.append(axis)
        return jnp.stack(turns), jnp.stack(places), jnp.stack(axes)

    def inverse(
        self,
        bodies: Float[Array, "joints 10"],
        q: Float[Array, " joints"],
        v: Float[Array, " joints"],
        a: Float[Array, " joints"],
    ) -> Float[Array, " joints"]:
        """Torque needed for a motion, `(joints,)`, N·m or N, by the Newton-Euler equations.

        Forces and moments of the links beyond a joint are summed in the base's frame.

        **Arguments:**

        - `bodies`: `BODY` of each link in its own frame, SI units.
        - `q`, `v`, `a`: position, velocity, acceleration, rad or m and per s.
        """
        turns, places, axes = self.frames(q)
        turning, sliding = self._apart(axes)
        rate = jnp.cumsum(turning * v[:, None], axis=0)
        still = np.zeros((1, 3))
        before = jnp.concatenate([still, rate[:-1]])
        spin = jnp.cumsum(turning * a[:, None] + jnp.cross(before, turning * v[:, None]), axis=0)
        before_spin = jnp.concatenate([still, spin[:-1]])
        arm = jnp.diff(places, axis=0, prepend=still)
        moved = jnp.cross(before_spin, arm) + jnp.cross(before, jnp.cross(before, arm))
        along = sliding * a[:, None] + 2 * jnp.cross(before, sliding * v[:, None])
        lift = jnp.cumsum(moved + along, axis=0) - self.gravity
        inertia, moment, mass = _in_base(bodies, turns)
        force = mass * lift + jnp.cross(spin, moment) + jnp.cross(rate, jnp.cross(rate, moment))
        momentum = jnp.einsum("kij,kj->ki", inertia, rate)
        torque = (
            jnp.einsum("kij,kj->ki", inertia, spin)
            + jnp.cross(rate, momentum)
            + jnp.cross(moment, lift)
            + jnp.cross(places, force)
        )
        beyond = jnp.cumsum(force[::-1], axis=0)[::-1]
        about_base = jnp.cumsum(torque[::-1], axis=0)[::-1]
        at_joint = about_base - jnp.cross(places, beyond)
        return jnp.sum(turning * at_joint + sliding * beyond, axis=1)

    def _apart(
        self, axes: Float[Array, "joints 3"]
    ) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]:
        """Axes of the joints that turn, and of those that slide; zero for the others."""
        # Constant zeros, with which a simulation's kernel does not multiply.
        slides, none = np.array(self.slides)[:, None], np.zeros((self.joints, 3))
        return jnp.where(slides, none, axes), jnp.where(slides, axes, none)

    def mass_matrix(
        self, bodies: Float[Array, "joints 10"], q: Float[Array, " joints"]
    ) -> Float[Array, "joints joints"]:
        """Inertia at q, `(joints, joints)`, by composite bodies about the base's origin."""
        turns, places, axes = self.frames(q)
        turning, _ = self._apart(axes)
        passing = jnp.where(np.array(self.slides)[:, None], axes, jnp.cross(places, axes))
        inertia, moment, mass = _in_base(bodies, turns)
        shift = 2 * jnp.einsum("ki,ki->k", places, moment)[:, None, None] * np.eye(3)
        both = jnp.einsum("ki,kj->kij", places, moment)
        square = jnp.einsum("ki,ki->k", places, places)[:, None, None] * np.eye(3)
        own = square - jnp.einsum("ki,kj->kij", places, places)
        inertia = inertia + shift - both - both.mT + mass[:, :, None] * own
        moment = moment + mass * places
        inertia, moment, mass = (jnp.cumsum(x[::-1], axis=0)[::-1] for x in (inertia, moment, mass))
        linear = mass * passing + jnp.cross(turning, moment)
        angular = jnp.einsum("kij,kj->ki", inertia, turning) + jnp.cross(moment, passing)
        upper = jnp.triu(turning @ angular.T + passing @ linear.T)
        return upper + jnp.triu(upper, 1).T


class InSpace(eqx.Module):
    """The properties of an arm that determine its loads in space.

    - `chain`: its joints. `bodies`: `BODY` of each link.
    - `carried`: indices in `BODY` of the parameters of a body at the tip that some motion can
      identify, its mass first; all ten for an arm that moves its tip freely.
    """

    chain: Chain
    bodies: Float[Array, "joints 10"] = eqx.field(converter=as_float64)
    carried: tuple[int, ...] = eqx.field(static=True)


def moved_body(body: Float[Array, "10"], place: Float[Array, "3"]) -> Float[Array, "10"]:
    """`BODY` about the origin of a frame, for a body given about another point (parallel axes).

    **Arguments:**

    - `body`: about the point, along the frame's axes. `place`: the point in the frame, m.
    """
    moment, mass = body[6:9], body[9]
    # Linear in the body, so that its mass may be zero or negative.
    both = jnp.outer(place, moment) + jnp.outer(moment, place) + mass * jnp.outer(place, place)
    shift = jnp.trace(both) * jnp.eye(3) - both
    return jnp.concatenate([body[:6] + shift[jnp.triu_indices(3)], moment + mass * place, body[9:]])


def _cross_matrix(x: Float[Array | np.ndarray, "3"]) -> Float[Array, "3 3"]:
    return jnp.cross(np.eye(3), x)


def _in_base(
    bodies: Float[Array, "joints 10"], turns: Float[Array, "joints 3 3"]
) -> tuple[Float[Array, "joints 3 3"], Float[Array, "joints 3"], Float[Array, "joints 1"]]:
    """Inertia about its origin, first moment and mass of each link, along the base's axes."""
    xx, xy, xz, yy, yz, zz = (bodies[:, k] for k in range(6))
    rows = [jnp.stack(row, axis=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
    own = jnp.stack(rows, axis=-2)
    inertia = jnp.einsum("kij,kjl,kml->kim", turns, own, turns)
    return inertia, jnp.einsum("kij,kj->ki", turns, bodies[:, 6:9]), bodies[:, 9:]
