"""What a parameter is called, how it is read and written, and how it is kept within bounds."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

import jaxid
from jaxid.arms import SCARA
from jaxid.effects import AbstractEffect, Coulomb, Viscous
from jaxid.errors import ModelError
from jaxid.parameters import (
    Bounds,
    Declaration,
    Parameter,
    Scalar,
    list_parameters,
    parameter,
    read_values,
    set_by_name,
    sliding_unit,
    write_values,
)


class Curve(AbstractEffect):
    """Several values in one parameter."""

    joint: int = eqx.field(static=True)
    heights: Float[Array, " knots"] = parameter(
        (1.0, 2.0, 3.0), symbol="height", unit="N·m", lower=-5.0, upper=5.0, scale=0.5
    )


class Tilt(AbstractEffect):
    """A parameter of no joint, and one without a default."""

    pull: Scalar = parameter(symbol="pull", unit="m/s²", scale=9.81)
    turn: Scalar | None = parameter(None, symbol="turn", unit="rad")


class Box(eqx.Module):
    """Parameters of parameters of tuples."""

    things: tuple
    size: Scalar = parameter(2.0, symbol="size", unit="m")
    shape: str = eqx.field(static=True, default="round")


# --- names ------------------------------------------------------------------------------------


def test_names_are_symbols_with_the_joint_in_the_order_of_the_fields():
    names = [p.name for p in jaxid.scara().parameters]
    arm = ["ZZ1r", "ZZ2", "MX2", "MY2"]
    friction = ["Fv", "Fc", "eps", "form", "lead"]
    assert names == [*arm, *(f"{name}{j}" for j in (1, 2) for name in friction)]
    assert jaxid.scara().names == (*arm, "Fv1", "Fc1", "Fv2", "Fc2")
    assert [p.joint for p in jaxid.scara().parameters][3:6] == [None, 1, 1]


def test_two_of_the_same_are_numbered_and_apart():
    loop = jaxid.scara().add(Viscous(joint=2), Viscous(joint=2, coefficient=0.3))
    names = [p.name for p in loop.parameters]
    assert len(set(names)) == len(names)
    assert names[-2:] == ["Fv2_2", "Fv2_3"]
    changed = loop.with_values(Fv2_2=0.7)
    values = {p.name: float(p.where(changed)) for p in changed.parameters}
    assert (values["Fv2"], values["Fv2_2"], values["Fv2_3"]) == (0.0, 0.7, 0.3)


class _Numbered(AbstractEffect):
    """A symbol that another's number would make."""

    own: Scalar = parameter(0.0, symbol="Fv1_2", unit="N·m")


def test_a_number_gives_no_name_that_is_taken():
    box = Box(things=(Viscous(joint=1), _Numbered(), Viscous(joint=1)))
    assert [p.name for p in list_parameters(box)] == ["Fv1", "Fv1_2", "Fv1_3", "size"]


def test_nested_modules_and_tuples_are_walked():
    box = Box(things=(Viscous(joint=1), (Curve(joint=2), Tilt(pull=1.5))))
    assert [p.name for p in list_parameters(box)] == ["Fv1", "height2", "pull", "size"]


def test_parameter_that_is_none_is_not_there():
    assert [p.name for p in list_parameters(Tilt(pull=1.0))] == ["pull"]
    assert [p.name for p in list_parameters(Tilt(pull=1.0, turn=0.1))] == ["pull", "turn"]
    with pytest.raises(TypeError, match="pull"):
        Tilt()


# --- declarations -----------------------------------------------------------------------------


def test_declaration_is_what_the_field_says():
    (pull,) = list_parameters(Tilt(pull=1.0))
    assert pull.declaration == Declaration("pull", "m/s²", -math.inf, math.inf, 9.81, True, True)
    eps = next(p for p in list_parameters(Coulomb(joint=1)) if p.name == "eps1")
    assert (eps.declaration.free, eps.declaration.linear) == (False, False)
    assert (eps.declaration.lower, eps.declaration.scale) == (0.0, 0.01)


@pytest.mark.parametrize("given_value", [2, 2.0, np.float32(2.0), np.array(2), jnp.array(2.0)])
def test_values_become_float64(given_value):
    value = Viscous(joint=1, coefficient=given_value).coefficient
    assert isinstance(value, jax.Array)
    assert value.dtype == jnp.float64
    assert value.shape == ()
    assert float(value) == 2.0


def test_scales_and_bounds_of_every_parameter_make_sense():
    for loop in (jaxid.scara(), jaxid.two_link(), jaxid.two_link(link_length=0.3), jaxid.emps()):
        for p in loop.parameters:
            d = p.declaration
            assert d.symbol, p.name
            assert d.scale > 0, p.name
            assert d.lower < d.upper, p.name
            assert d.lower <= float(p.where(loop)) <= d.upper, p.name


def test_units_of_joints_that_slide():
    assert sliding_unit("N·m·s/rad") == "N·s/m"
    assert sliding_unit("N·m") == "N"
    assert sliding_unit("kg·m²") == "kg"
    assert sliding_unit("rad/(N·m)") == "m/N"
    assert sliding_unit("N·m/(rad/s)") == "N/(m/s)"
    loop = jaxid.emps()
    units = {p.name: unit for p in loop.parameters for unit in loop.units(p)}
    assert units == {
        "M": "kg",
        "Fv1": "N·s/m",
        "Fc1": "N",
        "eps1": "m/s",
        "form1": "1",
        "lead1": "s",
        "offset1": "N",
    }
    assert jaxid.scara().units(jaxid.scara().parameters[4]) == ("N·m·s/rad",)


# --- reading and writing ----------------------------------------------------------------------


def test_values_that_are_not_as_many_are_refused():
    loop = jaxid.scara()
    with pytest.raises(ModelError, match="8 free parameters: give one value for each"):
        loop.with_theta(loop.theta[:-1])


def test_several_values_are_one_parameter_with_a_name_each():
    loop = jaxid.scara().add(Curve(joint=2))
    curve = loop.parameters[-1]
    assert (curve.size, curve.several) == (3, True)
    assert loop.names[-3:] == ("height2[1]", "height2[2]", "height2[3]")
    assert len(loop.theta) == len(loop.names) == 8 + 3
    np.testing.assert_array_equal(loop.theta[-3:], [1.0, 2.0, 3.0])
    changed = loop.with_theta(loop.theta.at[-2].set(7.0))
    np.testing.assert_array_equal(changed.effects[-1].heights, [1.0, 7.0, 3.0])


def test_one_value_in_a_vector_is_still_a_vector():
    loop = jaxid.scara().add(Curve(joint=1, heights=[4.0]))
    assert loop.names[-1] == "height1[1]"
    assert loop.with_theta(loop.theta).effects[-1].heights.shape == (1,)


def test_reading_and_writing_are_inverse():
    loop = jaxid.two_link().add(Curve(joint=1), Curve(joint=1))
    values = jnp.arange(len(loop.theta)) + 0.5
    written = loop.with_theta(values)
    np.testing.assert_array_equal(written.theta, values)
    assert jax.tree.structure(written) == jax.tree.structure(loop)
    assert [p.name for p in written.parameters] == [p.name for p in loop.parameters]
    one = list_parameters(loop)[2:3]
    np.testing.assert_array_equal(read_values(write_values(loop, one, jnp.array([9.0])), one), 9.0)


def test_no_parameters_are_no_values():
    assert read_values(SCARA(), ()).shape == (0,)
    arm = SCARA()
    assert write_values(arm, (), jnp.zeros(0)) is arm


def test_writing_is_differentiable_and_touches_nothing_else():
    loop = jaxid.scara()
    matrix = jax.jacfwd(lambda theta: loop.with_theta(2 * theta).theta)(loop.theta)
    np.testing.assert_array_equal(matrix, 2 * np.eye(len(loop.theta)))
    eps = [p for p in loop.parameters if p.name == "eps1"]
    written = loop.with_theta(loop.theta + 1)
    np.testing.assert_array_equal(read_values(written, eps), read_values(loop, eps))


def test_setting_by_name():
    changed = set_by_name(jaxid.scara(), MY2=0.3, Fc1=2.0)
    values = {p.name: float(p.where(changed)) for p in changed.parameters}
    assert (values["MY2"], values["Fc1"], values["ZZ1r"]) == (0.3, 2.0, 3.0)
    with pytest.raises(ModelError, match="no parameter 'Fc3'.*it has ZZ1r, ZZ2, MX2"):
        set_by_name(jaxid.scara(), Fc3=1.0)


def test_setting_several_values_by_one_is_refused():
    with pytest.raises(ModelError, match="height2"):
        jaxid.scara().add(Curve(joint=2)).with_values(height2=1.0)


# --- bounds -----------------------------------------------------------------------------------

KINDS = {
    "free": (-math.inf, math.inf),
    "from below": (-0.5, math.inf),
    "from above": (-math.inf, 0.7),
    "both": (-0.5, 0.7),
}
SCALE = 0.2


def bounds_of(kind):
    """The bounds of one parameter of a kind."""
    lower, upper = KINDS[kind]
    declared = Declaration("x", "1", lower, upper, SCALE)
    return Bounds.of([Parameter("x", declared, float)])


def values_inside(kind, share):
    """A value within the bounds: `share` of what there is, from 0 to 1, not close to a bound."""
    lower, upper = np.clip(KINDS[kind], -20.0, 20.0)
    return lower + (upper - lower) * (0.01 + 0.98 * share)


@settings(deadline=None, max_examples=25)
@given(st.sampled_from(sorted(KINDS)), st.lists(st.floats(0, 1), min_size=8, max_size=8))
def test_inside_undoes_outside(kind, shares):
    bounds = bounds_of(kind)
    values = jnp.asarray(values_inside(kind, np.asarray(shares)))
    # The coordinates lie within some 100; the difference of two such loses two digits.
    np.testing.assert_allclose(bounds.inside(bounds.outside(values)), values, atol=1e-12)


@settings(deadline=None, max_examples=25)
@given(st.sampled_from(sorted(KINDS)), st.lists(st.floats(-30, 30), min_size=8, max_size=8))
def test_inside_is_inside_and_monotone(kind, coordinates):
    bounds, (lower, upper) = bounds_of(kind), KINDS[kind]
    z = jnp.sort(jnp.asarray(coordinates))
    values = np.asarray(bounds.inside(z))
    # At the far end of a bound the last digit may be the bound itself.
    assert np.all((values >= lower) & (values <= upper))
    assert np.all(np.diff(values) >= 0)
    slope = jax.vmap(jax.grad(lambda z: bounds.inside(z[None])[0]))(z)
    assert np.all(np.asarray(slope) > 0)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_on_a_bound_or_beyond_is_moved_just_inside(kind):
    bounds, ends = bounds_of(kind), KINDS[kind]
    for end, beyond in zip(ends, (-1e-6, 1e-6), strict=True):
        if math.isinf(end):
            continue
        for value in (end, end + beyond, end + 1e6 * beyond):
            z = bounds.outside(jnp.array([value]))
            back = float(bounds.inside(z)[0])
            assert np.isfinite(z).all()
            assert ends[0] < back < ends[1]
            # A thousandth of the scale at most.
            assert abs(back - end) < 2e-3 * SCALE


@pytest.mark.parametrize("kind", KINDS)
def test_only_what_is_not_inside_is_moved_inside(kind):
    """The compliance of a heavy machine in m/N is a millionth of its scale."""
    bounds, (lower, upper) = bounds_of(kind), KINDS[kind]
    near = 1e-6 * SCALE
    inside = (lower if math.isfinite(lower) else -1.0) + near
    ends = [end for end in (lower, upper) if math.isfinite(end)]
    moved = np.asarray(bounds.moved_inside(jnp.array([inside, *ends])))
    assert moved[0] == inside
    assert np.all((moved > lower) & (moved < upper))


@pytest.mark.parametrize("kind", ["free", "from below", "from above"])
def test_next_to_the_identity_away_from_a_bound(kind):
    bounds, (lower, upper) = bounds_of(kind), KINDS[kind]
    away = np.array([2.0, 5.0, 20.0]) * SCALE
    values = lower + away if math.isfinite(lower) else (upper if upper < 9 else 0.0) - away
    z = bounds.outside(jnp.asarray(values))
    slope = jax.vmap(jax.grad(lambda z: bounds.inside(z[None])[0]))(z)
    # The corner is rounded over 1e-3 scales: at two scales its square, (1e-3 / 2)² = 2.5e-7.
    np.testing.assert_allclose(slope / SCALE, 1.0, atol=3e-7)


def test_each_value_has_the_bounds_of_its_parameter():
    loop = jaxid.scara().add(Curve(joint=2))
    bounds = Bounds.of(loop.free_parameters)
    np.testing.assert_array_equal(bounds.lower[:4], [0, 0, -np.inf, -np.inf])
    np.testing.assert_array_equal(bounds.upper[-3:], 5.0)
    np.testing.assert_array_equal(bounds.scale[-4:], [0.1, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(bounds.inside(bounds.outside(loop.theta + 0.1)), loop.theta + 0.1)
