"""The closed loop: how it is put together."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from loops import QuadraticDrag

import jaxid
from jaxid.arms import SCARA
from jaxid.control import Reading, Reference
from jaxid.effects import (
    AbstractEffect,
    Backlash,
    Coulomb,
    JointElasticity,
    LoadDependentFriction,
    Motion,
    RotorInertia,
    TorqueOffset,
    TorqueRipple,
    Viscous,
    on_joint,
)
from jaxid.errors import ModelError
from jaxid.parameters import Scalar, parameter
from jaxid.simulation.dynamics import Outside, instant
from jaxid.simulation.loads import inverse
from jaxid.simulation.state import rest


def test_add_and_without():
    loop = jaxid.scara()
    more = loop.add(TorqueOffset(joint=2), QuadraticDrag(joint=1))
    names = [e.effect_name() for e in more.effects]
    assert names[-2:] == ["torque_offset", "quadratic_drag"]
    assert len(loop.effects) == 4
    assert [e.effect_name() for e in more.without("torque_offset").effects] == [
        *names[:4],
        "quadratic_drag",
    ]
    assert len(more.without("coulomb").effects) == 4
    kept = more.without("coulomb", joint=1).effects
    assert [e.joint for e in kept if e.effect_name() == "coulomb"] == [2]


def test_without_what_is_not_there_says_what_is():
    loop = jaxid.scara()
    with pytest.raises(ModelError, match="no effect 'spring' to remove: .* coulomb, viscous"):
        loop.without("spring")
    with pytest.raises(ModelError, match="no effect 'coulomb' on joint 3"):
        loop.without("coulomb", joint=3)


@pytest.mark.parametrize("joint", [-1, 0, 3])
def test_joint_out_of_range_says_which_there_are(joint):
    with pytest.raises(ModelError) as raised:
        jaxid.scara().add(QuadraticDrag(joint=joint))
    message = str(raised.value)
    for part in (f"quadratic_drag is on joint {joint}", "scara has joints 1 to 2", "from 1"):
        assert part in message


def test_a_joint_has_one_transmission():
    loop = jaxid.scara().add(JointElasticity(joint=2, compliance=0.01))
    loop.add(Backlash(joint=1, gap=0.01))
    with pytest.raises(ModelError, match="two transmissions on joint 2"):
        loop.add(Backlash(joint=2))


def test_what_is_held_stays_so_under_another_name():
    ripples = TorqueRipple(joint=1, harmonic=3.0), TorqueRipple(joint=1, harmonic=7.0)
    loop = jaxid.scara().add(*ripples).hold("n1_2", "ZZ2").free("n1", "eps2")
    less = loop.with_effects(e for e in loop.effects if e is not ripples[0])
    assert less.held_names == {"n1", "ZZ2"}
    assert less.freed_names == {"eps2"}
    assert loop.without("torque_ripple").held_names == {"ZZ2"}
    turned = loop.with_effects(reversed(loop.effects))
    assert turned.held_names == {"n1", "ZZ2"}
    assert turned.freed_names == {"n1_2", "eps2"}


def test_what_is_held_and_what_it_is_called_stays_as_effects_are_added():
    loop = jaxid.scara().hold("Fc1", Fv2=0.01).free("eps2")
    more = loop.add(Coulomb(joint=1), Viscous(joint=2), TorqueRipple(joint=1, harmonic=3.0))
    assert [p.name for p in more.parameters][: len(loop.parameters)] == [
        p.name for p in loop.parameters
    ]
    assert (more.held, more.freed) == (loop.held, loop.freed)
    assert (more.held_names, more.freed_names) == ({"Fc1", "Fv2"}, {"eps2"})
    assert {"Fc1_2", "Fv2_2"} <= set(more.names)
    # One effect twice is two: each keeps what is its own.
    twice = Viscous(joint=1)
    both = jaxid.scara().add(twice, twice).hold("Fv1_2")
    assert both.with_effects(both.effects).held_names == {"Fv1_2"}


def test_names_are_places_as_soon_as_they_are_given():
    law = jaxid.scara().controller
    loop = jaxid.ClosedLoop(SCARA(), law, [Viscous(joint=1)], held={"Fv1"}, freed=["ZZ2"])
    assert loop.held == {("effects", 0, "coefficient")}
    assert loop.freed == {("arm", "ZZ2")}
    assert loop.names == ("ZZ1r", "ZZ2", "MX2", "MY2")
    with pytest.raises(ModelError, match="no parameter 'Fc1' in this model"):
        dataclasses.replace(loop, held={"Fc1"})


class Jerky(AbstractEffect):
    """A torque by acceleration that does not say so."""

    joint: int = eqx.field(static=True)
    size: Scalar = parameter(0.0, symbol="J", unit="kg·m²")

    def torque(self, motion):
        return on_joint(self.joint, self.size * motion.a[self.joint - 1], motion)


def test_acceleration_that_is_not_asked_for_is_refused():
    loop = jaxid.scara().add(Jerky(joint=2))
    q = np.zeros((20, 2))
    record = jaxid.Recording(np.arange(20) * 0.01, q, q, q_ref=q)
    with pytest.raises(ModelError, match="jerky uses motion.a.*`inertial = True`"):
        jaxid.fit(loop, record)


class Scalarly(AbstractEffect):
    """A torque that is one number, which numpy would add to every joint."""

    size: Scalar = parameter(0.0, symbol="size", unit="N·m")

    def torque(self, motion):
        return self.size * motion.q[0]


class Foreign(AbstractEffect):
    """A torque that calls numpy."""

    size: Scalar = parameter(0.0, symbol="size", unit="N·m")

    def torque(self, motion):
        return self.size * np.sin(motion.q)


@pytest.mark.parametrize(
    ("effect", "says"),
    [
        (Scalarly(), r"scalarly has shape \(\), but the arm has 2 joints: .*on_joint"),
        (Foreign(), "foreign passes a JAX array to numpy: use the functions of jax.numpy"),
    ],
)
def test_torques_of_own_effects_are_one_array_per_joint(effect, says):
    q = np.zeros((20, 2))
    record = jaxid.Recording(np.arange(20) * 0.01, q, q, q_ref=q)
    with pytest.raises(ModelError, match=says):
        jaxid.fit(jaxid.scara().add(effect), record)


def test_simulation_and_inverse_agree_on_the_load():
    """Beside a rotor, whose acceleration is solved for."""
    loop = jaxid.scara().add(
        RotorInertia(joint=2, inertia=0.02), LoadDependentFriction(joint=2, ratio=0.3)
    )
    q, v, tau = jnp.array([0.2, 0.4]), jnp.array([1.0, -2.0]), jnp.array([3.0, 2.0])
    driven = dataclasses.replace(loop, controller=jaxid.control.OpenLoop())
    none = jnp.zeros(2)
    state = dataclasses.replace(rest(driven, q, none), v=v)
    now = instant(
        driven,
        jnp.zeros(()),
        state,
        Reference(none, none, none, tau),
        Outside(none, none, Reading(none, none), none),
        jnp.asarray(0),
    )
    motion = Motion(jnp.zeros(()), q, v, now.a, tau, jnp.zeros(0), jnp.asarray(0))
    np.testing.assert_allclose(inverse(driven, motion, state.effects), now.tau, rtol=1e-12)


def test_hold_and_free():
    loop = jaxid.scara()
    held = loop.hold("ZZ2", MX2=0.3)
    assert "ZZ2" not in held.names
    assert "MX2" not in held.names
    assert float(held.arm.MX2) == 0.3
    assert float(held.arm.ZZ2) == float(loop.arm.ZZ2)
    assert len(held.theta) == 6
    np.testing.assert_array_equal(held.with_theta(held.theta + 1).arm.MX2, 0.3)
    assert held.free("MX2", "ZZ2").names == loop.names
    # What is not free by declaration can be freed, and held again.
    freed = loop.free("eps2")
    assert freed.names == (*loop.names, "eps2")
    assert freed.hold("eps2").names == loop.names
    assert loop.hold(eps1=0.02).names == loop.names
    for wrong in (lambda: loop.hold("ZZ3"), lambda: loop.hold(ZZ3=1.0), lambda: loop.free("ZZ3")):
        with pytest.raises(ModelError, match="no parameter 'ZZ3' in this model: it has ZZ1r, ZZ2"):
            wrong()


def test_with_values_and_repr():
    loop = jaxid.scara().with_values(ZZ1r=3.25, eps2=0.014)
    assert float(loop.arm.ZZ1r) == 3.25
    assert float(loop.effects[3].smoothing) == 0.014
    with pytest.raises(ModelError, match="no parameter 'mass' in this model: it has ZZ1r"):
        loop.with_values(mass=1.0)
    text = repr(loop)
    for part in ("scara", "SCARA", "viscous(1)", "coulomb(2)", "PD", "ZZ1r 3.25"):
        assert part in text
