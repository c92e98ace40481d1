"""A chain of joints in space: forward kinematics and inverse dynamics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .parameters import as_float64

# Names of a body's ten parameters (Khalil, Dombre 2002), without the link's number: inertia about
# the origin of the link's frame, first moment, mass.
BODY = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
BODY_UNITS = ("kg·m²",) * 6 + ("kg·m",) * 3 + ("kg",)


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
        rate, spin, lift = self._moving(places, axes, v, a)
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

    def _moving(
        self,
        places: Float[Array, "joints 3"],
        axes: Float[Array, "joints 3"],
        v: Float[Array, " joints"],
        a: Float[Array, " joints"],
    ) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"], Float[Array, "joints 3"]]:
        """Angular velocity and acceleration of each link, and its origin's acceleration minus
        gravity, in the base's frame."""
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
        return rate, spin, lift

    def regressor(
        self, q: Float[Array, " joints"], v: Float[Array, " joints"], a: Float[Array, " joints"]
    ) -> Float[Array, "joints parameters"]:
        """Derivative of `inverse` by the bodies, `BODY` of one link after the other, SI units.

        **Arguments:** as for `inverse`.
        """
        turns, places, axes = self.frames(q)
        rate, spin, lift = (
            jnp.einsum("kji,kj->ki", turns, x) for x in self._moving(places, axes, v, a)
        )
        cross = jax.vmap(_cross_matrix)
        across, about, fall = cross(rate), cross(spin), cross(lift)
        inertia = _by_inertia(spin) + across @ _by_inertia(rate)
        moment = jnp.concatenate([inertia, -fall, np.zeros((self.joints, 3, 1))], axis=2)
        moved = about + across @ across
        none = np.zeros((self.joints, 3, 6))
        force = turns @ jnp.concatenate([none, moved, lift[:, :, None]], axis=2)
        moment = turns @ moment + cross(places) @ force
        turning, passing = self._screws(places, axes)
        rows = jnp.einsum("ji,kip->jkp", turning, moment)
        rows = rows + jnp.einsum("ji,kip->jkp", passing, force)
        carried = np.triu(np.ones((self.joints,) * 2))[:, :, None]
        return (rows * carried).reshape(self.joints, -1)

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
        turning, passing = self._screws(places, axes)
        inertia, moment, mass = _beyond(*_about_base(bodies, turns, places))
        linear = mass * passing + jnp.cross(turning, moment)
        angular = jnp.einsum("kij,kj->ki", inertia, turning) + jnp.cross(moment, passing)
        upper = jnp.triu(turning @ angular.T + passing @ linear.T)
        return upper + jnp.triu(upper, 1).T

    def _screws(
        self, places: Float[Array, "joints 3"], axes: Float[Array, "joints 3"]
    ) -> tuple[Float[Array, "joints 3"], Float[Array, "joints 3"]]:
        """Angular velocity of the links beyond each joint, and velocity of their point at the
        base's origin, for a joint velocity of one."""
        turning, _ = self._apart(axes)
        slides = np.array(self.slides)[:, None]
        return turning, jnp.where(slides, axes, jnp.cross(places, axes))

    def inverse_slopes(
        self,
        bodies: Float[Array, "joints 10"],
        q: Float[Array, " joints"],
        v: Float[Array, " joints"],
        a: Float[Array, " joints"],
    ) -> tuple[Float[Array, "joints joints"], Float[Array, "joints joints"]]:
        """Derivatives of `inverse` by position and velocity, a row for each torque, SI units.

        In spatial vectors about the base's origin, moments before forces (Singh, Russell, Wensing
        2022). Differentiating `inverse` would compute it once for each joint.

        **Arguments:** as for `inverse`.
        """
        turns, places, axes = self.frames(q)
        s = jnp.concatenate(self._screws(places, axes), axis=1)
        speed = jnp.cumsum(s * v[:, None], axis=0)
        before = _previous(speed, np.zeros(6))
        change = _across(speed, s)
        fall = jnp.concatenate([np.zeros(3), -self.gravity])
        rise = fall + jnp.cumsum(s * a[:, None] + change * v[:, None], axis=0)
        moved = _across(before, s)
        bent = _across(_previous(rise, fall), s) + _across(before, moved)
        inertia = _spatial(*_about_base(bodies, turns, places))
        momentum = _times(inertia, speed)
        force = _times(inertia, rise) + _across_force(speed, momentum)
        cross = jax.vmap(_motion_matrix)(speed)
        twice_b = _force_matrix(momentum) - inertia @ cross - cross.mT @ inertia
        inertia, twice_b, force = _beyond(inertia, twice_b, force)
        left, left_b = (jnp.einsum("ki,kij->kj", s, x) for x in (inertia, twice_b))
        by_q = left_b @ moved.T + left @ bent.T
        by_v = left_b @ s.T + left @ (moved + change).T
        above = _times(twice_b, moved) + _times(inertia, bent) + _across_force(s, force)
        above_v = _times(twice_b, s) + _times(inertia, moved + change)

        def whole(below, above):
            return jnp.tril(below) + jnp.triu(s @ above.T, 1)

        return whole(by_q, above), whole(by_v, above_v)


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


@eqx.filter_custom_jvp
def inverse_by_rows(
    chain: Chain,
    bodies: Float[Array, "joints 10"],
    q: Float[Array, " joints"],
    v: Float[Array, " joints"],
    a: Float[Array, " joints"],
) -> Float[Array, " joints"]:
    """`Chain.inverse`, with derivatives by its regressor.

    Many tangents of the bodies are then one product of matrices. Not for a simulation's loop, whose
    kernel has scalars only.
    """
    return chain.inverse(bodies, q, v, a)


@inverse_by_rows.def_jvp
def _inverse_by_rows_jvp(primals, tangents):
    chain, bodies, q, v, a = primals
    d_chain, d_bodies, d_q, d_v, d_a = tangents
    tau, change = chain.inverse(bodies, q, v, a), jnp.zeros_like(q)
    if d_bodies is not None:
        change = change + chain.regressor(q, v, a) @ d_bodies.reshape(-1)
    if d_q is not None or d_v is not None:
        for slope, along in zip(chain.inverse_slopes(bodies, q, v, a), (d_q, d_v), strict=True):
            if along is not None:
                change = change + slope @ along
    if d_a is not None:
        change = change + chain.mass_matrix(bodies, q) @ d_a
    if jax.tree.leaves(d_chain):
        _, by_chain = eqx.filter_jvp(lambda x: x.inverse(bodies, q, v, a), (chain,), (d_chain,))
        change = change + by_chain
    return tau, change


def _by_inertia(x: Float[Array, "joints 3"]) -> Float[Array, "joints 3 6"]:
    """The matrices that map moments of inertia, XX to ZZ, to the inertia times a vector."""
    x, y, z = x[:, 0], x[:, 1], x[:, 2]
    o = jnp.zeros_like(x)
    rows = ((x, y, z, o, o, o), (o, x, o, y, z, o), (o, o, x, o, y, z))
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _cross_matrix(x: Float[Array | np.ndarray, "3"]) -> Float[Array, "3 3"]:
    """The matrix of the cross product with a vector on its left."""
    return jnp.cross(np.eye(3), x)


def _about_base(
    bodies: Float[Array, "joints 10"],
    turns: Float[Array, "joints 3 3"],
    places: Float[Array, "joints 3"],
) -> tuple[Float[Array, "joints 3 3"], Float[Array, "joints 3"], Float[Array, "joints 1"]]:
    """Inertia, first moment and mass of each link about the base's origin (parallel axes)."""
    inertia, moment, mass = _in_base(bodies, turns)
    shift = 2 * jnp.einsum("ki,ki->k", places, moment)[:, None, None] * np.eye(3)
    both = jnp.einsum("ki,kj->kij", places, moment)
    square = jnp.einsum("ki,ki->k", places, places)[:, None, None] * np.eye(3)
    own = square - jnp.einsum("ki,kj->kij", places, places)
    inertia = inertia + shift - both - both.mT + mass[:, :, None] * own
    return inertia, moment + mass * places, mass


def _beyond(*of_links: Float[Array, "joints ..."]) -> tuple[Float[Array, "joints ..."], ...]:
    """Sums over the links beyond each joint."""
    return tuple(jnp.cumsum(x[::-1], axis=0)[::-1] for x in of_links)


def _previous(x: Float[Array, "joints 6"], first: Float[Array | np.ndarray, "6"]):
    """The value of the link before each joint, that of the base first."""
    return jnp.concatenate([jnp.asarray(first)[None], x[:-1]])


# --- spatial vectors and matrices: motions (angular, linear), forces (moment, force) -----------


def _across(x: Float[Array, "joints 6"], m: Float[Array, "joints 6"]) -> Float[Array, "joints 6"]:
    """Cross product of motions."""
    turning, passing = x[:, :3], x[:, 3:]
    linear = jnp.cross(turning, m[:, 3:]) + jnp.cross(passing, m[:, :3])
    return jnp.concatenate([jnp.cross(turning, m[:, :3]), linear], axis=1)


def _across_force(
    x: Float[Array, "joints 6"], f: Float[Array, "joints 6"]
) -> Float[Array, "joints 6"]:
    """Cross product of motions with forces."""
    turning, passing = x[:, :3], x[:, 3:]
    moment = jnp.cross(turning, f[:, :3]) + jnp.cross(passing, f[:, 3:])
    return jnp.concatenate([moment, jnp.cross(turning, f[:, 3:])], axis=1)


def _times(
    matrices: Float[Array, "joints 6 6"], vectors: Float[Array, "joints 6"]
) -> Float[Array, "joints 6"]:
    """Each matrix times its vector."""
    return jnp.einsum("kij,kj->ki", matrices, vectors)


def _motion_matrix(x: Float[Array, "6"]) -> Float[Array, "6 6"]:
    """The matrix of `_across`; that of `_across_force` is its negative transpose."""
    turning, passing = _cross_matrix(x[:3]), _cross_matrix(x[3:])
    return jnp.block([[turning, np.zeros((3, 3))], [passing, turning]])


def _force_matrix(f: Float[Array, "joints 6"]) -> Float[Array, "joints 6 6"]:
    """The matrices that map motions x to `_across_force(x, f)`."""
    units = jnp.eye(6)
    return jax.vmap(lambda f: _across_force(units, jnp.broadcast_to(f, (6, 6))).T)(f)


def _spatial(
    inertia: Float[Array, "joints 3 3"],
    moment: Float[Array, "joints 3"],
    mass: Float[Array, "joints 1"],
) -> Float[Array, "joints 6 6"]:
    """Spatial inertia of each link, from the results of `_about_base`."""
    across = jax.vmap(_cross_matrix)(moment)
    linear = mass[:, :, None] * np.eye(3)
    return jnp.block([[inertia, across], [-across, linear]])


def _in_base(
    bodies: Float[Array, "joints 10"], turns: Float[Array, "joints 3 3"]
) -> tuple[Float[Array, "joints 3 3"], Float[Array, "joints 3"], Float[Array, "joints 1"]]:
    """Inertia about its origin, first moment and mass of each link, along the base's axes."""
    xx, xy, xz, yy, yz, zz = (bodies[:, k] for k in range(6))
    rows = [jnp.stack(row, axis=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
    own = jnp.stack(rows, axis=-2)
    inertia = jnp.einsum("kij,kjl,kml->kim", turns, own, turns)
    return inertia, jnp.einsum("kij,kj->ki", turns, bodies[:, 6:9]), bodies[:, 9:]
