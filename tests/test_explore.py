"""Sets of effects that a search may examine, and their order."""

import dataclasses

import numpy as np

import jaxid
from jaxid.discovery.explore import Candidate, _allowed, _fitted, key_of, largest_first
from jaxid.discovery.hypotheses import Hypothesis
from jaxid.discovery.landscape import Entry, crowded, shares_a_joint
from jaxid.discovery.predict import Prediction
from jaxid.effects import (
    Backlash,
    JointElasticity,
    RotorInertia,
    Spring,
    TorqueOffset,
    TorqueRipple,
)


def test_a_joint_has_a_largest_number_of_each_effect():
    ripple, spring = TorqueRipple(joint=1, harmonic=2.0), Spring(joint=1)
    entry = Entry(Hypothesis(ripple, (0, 1), (-np.inf,) * 2, (np.inf,) * 2), 100.0, ripple)
    assert _allowed([entry], [ripple, spring]) == [entry]
    assert _allowed([entry], [ripple, spring]) == [entry]
    assert _allowed([entry], [ripple, spring, ripple]) == []
    # Two at once, beside one that the model has.
    assert crowded([ripple, ripple], [ripple])
    assert not crowded([ripple, ripple], [dataclasses.replace(ripple, joint=2)])
    assert crowded([spring, spring], [])
    # What a user has declared does not exclude other effects.
    assert not crowded([spring], [ripple] * 3)


def test_what_is_held_may_be_added_to():
    """A rotor of a data sheet may be wrong, so another may be found on its joint."""
    loop = jaxid.scara().add(RotorInertia(joint=2, inertia=0.1))
    assert any(isinstance(e, RotorInertia) for e in _fitted(loop))
    assert not any(isinstance(e, RotorInertia) for e in _fitted(loop.hold("Ia2")))


def test_a_joint_has_one_transmission():
    gap, shaft = Backlash(joint=1, gap=0.01), JointElasticity(joint=1, compliance=0.01)
    assert shares_a_joint([gap, TorqueOffset(joint=1), shaft])
    assert not shares_a_joint([gap, dataclasses.replace(shaft, joint=2)])


def test_sets_are_the_same_in_any_order_and_at_any_values():
    one, other = TorqueOffset(joint=1, level=0.1), Spring(joint=2, stiffness=3.0)
    assert key_of([one, other]) == key_of([Spring(joint=2), TorqueOffset(joint=1)])
    assert key_of([one]) != key_of([TorqueOffset(joint=2)])
    assert key_of([one, one]) != key_of([one])


def test_effects_that_are_added_together_are_listed_by_what_they_explain():
    ripple, spring = TorqueRipple(joint=1, harmonic=4.0), Spring(joint=2)

    def of(effects, value):
        rest, unused = np.zeros((1, 1, 1)), object.__new__(Prediction)
        return Candidate(tuple(effects), value, (), unused, rest, np.zeros(0))

    pair = ripple, spring
    both = of(pair, -90.0)
    examined = [both, of([spring], -60.0), of([ripple], -20.0), of([], 0.0)]
    assert largest_first(pair, examined) == (spring, ripple)
    assert largest_first(pair, examined[:3:2]) == (ripple, spring)
