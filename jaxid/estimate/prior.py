"""What is known of a loop's free parameters before the recordings."""

import numpy as np
from jaxtyping import Float

from ..parameters import Parameter
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from .minimise import Prior
from .result import Fit


def prior_of(loop: ClosedLoop, recordings: Recordings) -> Prior | None:
    """The prior of a loop's free parameters; None if nothing is known of them.

    Parameters of the links are near those of the drawn bodies if the arm knows how uncertain these
    are (`AbstractArm.expected`). Other values are near zero if their effect or the control law
    declares a deviation for them (`likely`).

    **Arguments:**

    - `recordings`: the fitted recordings; their torque and period are the scale of deviations.
    """
    torque = np.concatenate([np.asarray(r.tau) for r in recordings])
    size, period = np.sqrt(np.mean(np.square(torque), axis=0)), max(r.period for r in recordings)
    drawn, count = loop.arm.expected(), len(loop.theta)
    blocks, expected, at = [np.zeros((0, count))], np.zeros(count), 0
    for p in loop.free_parameters:
        here = slice(at, at + p.size)
        at += p.size
        own = np.zeros((0, p.size))
        if p.place[0] == "arm" and drawn is not None:
            expected[here], covariance = map(np.asarray, drawn)
            own = _root(covariance)
        elif deviation := _likely(loop, p, size, period):
            own = np.eye(p.size) / deviation
        rows = np.zeros((len(own), count))
        rows[:, here] = own
        blocks.append(rows)
    rows = np.concatenate(blocks)
    return Prior(rows, expected) if len(rows) else None


def drawing_notes(found: Fit) -> list[str]:
    """Notes on parameters of the links that the drawing determines, or that contradict it.

    **Arguments:**

    - `found`: a fit of an arm whose parameters may have a prior.
    """
    drawn = found.loop.arm.expected()
    names = [n for p in found.loop.free_parameters if p.place[0] == "arm" for n in p.names]
    if drawn is None or not names:
        return []
    expected, covariance = map(np.asarray, drawn)
    before = np.sqrt(np.diag(covariance))
    at = [found.names.index(name) for name in names]
    same = [n for n, x, y in zip(names, found.std[at], before, strict=True) if x > _SAME * y]
    return _told(names, same) + _far(names, (found.theta[at] - expected) / before)


def _told(names: list[str], same: list[str]) -> list[str]:
    """A note on parameters that the drawing determines, and not the recordings."""
    if not same:
        return []
    others = [n for n in names if n not in same]
    which = ", ".join(same)
    if len(others) < len(same):
        which = f"all but {', '.join(others)}" if others else "all of them"
    return [
        f"{len(same)} of {len(names)} parameters of the links are those of the drawing, because "
        f"the recordings tell little of them: {which}"
    ]


def _far(names: list[str], moved: Float[np.ndarray, " values"]) -> list[str]:
    """A note if the links are farther from the drawing than its uncertainty allows.

    An estimate varies less than the true value does around the drawing, so the largest of all
    changes is compared with that of as many normal numbers (Bonferroni).

    **Arguments:**

    - `moved`: change of each parameter from the drawing, in its standard deviations.
    """
    from scipy import stats

    if 2 * len(moved) * stats.norm.sf(np.abs(moved).max()) > _CHANCE:
        return []
    order = np.argsort(-np.abs(moved))[:_NAMED]
    which = ", ".join(f"{names[k]} by {moved[k]:.3g}" for k in order)
    return [
        "the links differ from the drawing by more than its uncertainty allows, most of all, in "
        f"its standard deviations, {which}: the drawing is wrong there, or the links have absorbed "
        'an effect that the model lacks; bodies="drawn" makes it visible'
    ]


# Probability of a distance from the drawing above which it is no news; parameters that are named.
_CHANCE, _NAMED = 0.01, 3
# Ratio of the deviations after and before the recordings, from which a value is the drawing's.
_SAME = 0.7


def _likely(
    loop: ClosedLoop, p: Parameter, torque: Float[np.ndarray, " joints"], period: float
) -> float:
    """The declared deviation of a value; zero if there is none."""
    owner, *_, name = p.place
    if owner == "controller":
        return loop.controller.likely(period).get(str(name), 0.0)
    if owner == "effects":
        return loop.effects[int(p.place[1])].likely(torque).get(str(name), 0.0)
    return 0.0


def _root(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A matrix of which R'R is the inverse of a covariance."""
    size = np.sqrt(np.diag(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(size, size))
    return np.linalg.solve(lower, np.diag(1 / size))
