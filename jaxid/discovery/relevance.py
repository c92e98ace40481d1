"""Which changes of a joint's torque are relevant."""

import numpy as np
from jaxtyping import Float

from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from .diagnosis import over_recordings
from .explore import Candidate
from .models import Model

# Smallest relevant effect as a share of the residual. If the law is unknown, filters on motion and
# torque, ticks and stiction cause errors of this size even in good recordings. If it is known, laws
# of friction and encoder steps that differ a little from the model do.
_SMALL, _SMALL_KNOWN = 0.25, 0.1
# For these reasons an error of 1.3 times that of noise is allowed then, or an excess of 0.2 %.
_BLURRED, _BLUR = 1.30, 0.2
# The same ratio if the law is known. The noise of recordings of one arm differs by a few per cent;
# an error that is a tenth larger is visible in a figure.
REFUTED = 1.10
# Share of the residual's power above the noise that effects must explain, if a curve has a better
# score.
_AS_MUCH = 0.9


def matters(at: Model, c: Candidate, plain: Candidate, worth: float) -> bool:
    """Whether a set changes a joint's residual by more than the smallest relevant change.

    **Arguments:**

    - `at`: the fitted model. `c`: the set in addition to it. `plain`: the empty set.
    - `worth`: smallest relevant change of a joint's torque, %.
    """
    assert at.fit is not None
    if at.fit.error_percent.to_numpy().max() < 1e-3:
        # Recordings without noise: the residual is the error of the integration.
        return False
    # Relative to the residual of the fit, whose relative error is known.
    left = np.linalg.norm(np.concatenate(at.fit.residuals), axis=0)
    changed = np.linalg.norm((c.rest - plain.rest).reshape(-1, c.rest.shape[-1]), axis=0)
    percent = over_recordings(at.fit.error_percent.to_numpy())
    least = _least(at, percent, worth)
    if c.curve is not None and imposed(at.fit.loop):
        # Otherwise a curve would refute a model whose error is allowed.
        ratio, excess = allowed(at.fit.loop, worth)
        least = np.maximum(excess, np.sqrt(1 - 1 / ratio**2) * percent)
    return bool(np.any(changed * percent > least * left))


def allowed(loop: ClosedLoop, worth: float) -> tuple[float, float]:
    """Largest allowed ratio of an error to that of noise, and allowed excess, in % of the torque.

    **Arguments:**

    - `worth`: smallest relevant change of a joint's torque, %.
    """
    return (_BLURRED, max(worth, _BLUR)) if imposed(loop) else (REFUTED, worth)


def matches_curve(
    before: Float[np.ndarray, " joints"] | None,
    effects: Float[np.ndarray, " joints"] | None,
    curve: Float[np.ndarray, " joints"] | None,
    floor: Float[np.ndarray, " joints"],
    joint: int,
) -> bool:
    """Whether effects explain most of the residual of the joint of a curve.

    Then they are not mere approximations of the curve, although it may have a better score. If the
    noise is low, the score compares what is left after both, which can be due to filters, ticks
    and stiction. The errors of other joints also change, but less directly.

    **Arguments:**

    - `before`, `effects`, `curve`: relative errors by joint, %, before, with the effects and with
      the curve. `floor`: that of noise.
    - `joint`: of the curve, from 1.
    """
    if before is None or effects is None or curve is None:
        return False
    explained = before**2 - np.minimum(curve, floor) ** 2
    own = joint - 1
    return bool(before[own] ** 2 - effects[own] ** 2 >= _AS_MUCH * explained[own])


def loses(less: Model, at: Model, worth: float) -> bool:
    """Whether a smaller model raises a joint's error by a relevant amount.

    **Arguments:**

    - `worth`: smallest relevant change of a joint's torque, %.
    """
    assert less.left is not None
    assert at.left is not None
    lost = np.sqrt(np.maximum(less.left**2 - at.left**2, 0.0))
    return bool(np.any(lost > _least(at, at.left, worth)))


def _least(
    at: Model, percent: Float[np.ndarray, " joints"], worth: float
) -> Float[np.ndarray, " joints"]:
    """Smallest relevant change of each joint's torque, %.

    **Arguments:**

    - `percent`: relative error of each joint's torque, %.
    """
    assert at.fit is not None
    share = _SMALL if imposed(at.fit.loop) else _SMALL_KNOWN
    return np.maximum(worth, share * percent)
