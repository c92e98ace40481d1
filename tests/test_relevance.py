"""Which effects and curves are worth adding."""

import numpy as np
import pytest

from jaxid.discovery.relevance import matches_curve

FLOOR = np.array([0.3, 0.5])
BEFORE = np.array([0.3, 2.4])


def left(joint: float) -> np.ndarray:
    return np.array([0.3, joint])


@pytest.mark.parametrize(
    ("effects", "curve", "expected"),
    [
        # A curve that reaches the noise floor, and an effect that nearly does.
        (0.6, 0.5, True),
        (1.2, 0.5, False),
        # A curve too coarse for what is missing does not make a coarse effect right.
        (1.2, 1.3, False),
        # A curve may be better than the estimated floor.
        (0.85, 0.5, True),
        (0.85, 0.1, False),
    ],
)
def test_effects_that_explain_as_much_as_a_curve_are_no_approximation(effects, curve, expected):
    assert matches_curve(BEFORE, left(effects), left(curve), FLOOR, 2) is expected


def test_only_the_joint_of_the_curve_counts():
    other = np.array([0.1, 2.4])
    assert not matches_curve(BEFORE, other, left(0.5), FLOOR, 2)


def test_a_larger_change_on_another_joint_is_not_compared():
    """Bodies that are estimated anew change the error of another joint by more than the curve's."""
    before, effects, curve = np.array([3.4, 1.7]), np.array([2.93, 0.82]), np.array([2.92, 0.78])
    floor = np.array([2.85, 0.78])
    assert matches_curve(before, effects, curve, floor, 2)
    assert not matches_curve(before, effects, curve, floor, 1)


def test_errors_that_are_not_known_show_nothing():
    assert not matches_curve(None, left(0.5), left(0.5), FLOOR, 2)
    assert not matches_curve(BEFORE, None, left(0.5), FLOOR, 2)
    assert not matches_curve(BEFORE, left(0.5), None, FLOOR, 2)
