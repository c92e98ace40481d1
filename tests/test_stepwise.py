"""The baseline of the blind bench: stepwise regression on filtered derivatives."""

import sys
from pathlib import Path

import independent as sim
import numpy as np
import pytest

import jaxid

# The benchmarks are not part of the package; a checkout has them beside the tests.
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import stepwise


def recordings(*effects: tuple[str, int | None]) -> jaxid.Recordings:
    case = sim.make_case(11, effects)
    return jaxid.Recordings.of(
        [
            jaxid.Recording.from_arrays(r["time"], r["q"], r["tau"], q_ref=r["q_ref"], name=name)
            for name, r in case.recordings.items()
            if name != "held_out"
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("stribeck", 2),
        ("actuator_lag", 1),
        ("encoder_eccentricity", 2),
        ("hysteresis", 1),
        ("gravity", None),
    ],
)
def test_effect_enters_first(name, joint):
    found = stepwise.first_effect(jaxid.scara(), recordings((name, joint)))
    # To first order a lag is a delay: a regression cannot tell them apart.
    alike = {"actuator_lag": ("actuator_lag", "time_delay")}.get(name, (name,))
    assert found is not None
    assert found[0] in alike
    assert found[1] == joint


def test_nothing_enters_where_nothing_is_allowed_to():
    assert stepwise.first_effect(jaxid.scara(), recordings(), p_to_enter=0.0) is None


def test_selection_stops_at_the_given_number():
    entered = stepwise.select(jaxid.scara(), recordings(("stribeck", 2)), most=2)
    assert 1 <= len(entered) <= 2
    assert entered[0].key == ("stribeck", 2)


def test_basis_is_orthonormal_and_beside_the_other():
    rng = np.random.default_rng(0)
    base = stepwise._basis(rng.standard_normal((50, 3)))
    block = np.column_stack([base @ [1.0, 2.0, 3.0], rng.standard_normal(50)])
    own = stepwise._basis(block, base)
    # The first column lies in the base already.
    assert own.shape == (50, 1)
    # Rounding of 50 products of order one.
    assert np.abs(base.T @ own).max() < 1e-13
    assert own.T @ own == pytest.approx(1.0, abs=1e-13)


def test_delay_column_is_the_torque_less_the_late_one():
    time = np.linspace(0, 1, 101)
    tau = np.column_stack([np.sin(time), np.cos(time)])
    column = stepwise._late(jaxid.effects.TimeDelay(joint=2, delay=0.02), time, tau)
    # The delay is two samples, where interpolation is exact.
    assert column[2:, 1, 0] == pytest.approx(tau[2:, 1] - tau[:-2, 1], abs=1e-12)
    assert not column[:, 0].any()
