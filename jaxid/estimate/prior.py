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

    Base parameters are near those of the drawn bodies if the arm has a covariance. Other values are
    near zero if their effect or the control law declares a deviation for them (`likely`).

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
        if p.place == ("arm", "base") and drawn is not None:
            expected[here], covariance = map(np.asarray, drawn)
            own = _root(covariance)
        elif deviation := _likely(loop, p, size, period):
            own = np.eye(p.size) / deviation
        rows = np.zeros((len(own), count))
        rows[:, here] = own
        blocks.append(rows)
    rows = np.concatenate(blocks)
    return Prior(rows, expected) if len(rows) else None


def drawing_note(found: Fit) -> list[str]:
    """A note on base parameters that the drawing determines, and not the recordings.

    **Arguments:**

    - `found`: a fit of an arm whose base parameters may have a prior.
    """
    drawn, base = found.loop.arm.expected(), ("arm", "base")
    names = [n for p in found.loop.free_parameters if p.place == base for n in p.names]
    if drawn is None or not names:
        return []
    before = np.sqrt(np.diag(np.asarray(drawn[1])))
    at = [found.names.index(name) for name in names]
    same = [n for n, x, y in zip(names, found.std[at], before, strict=True) if x > _SAME * y]
    if not same:
        return []
    return [
        f"{len(same)} of {len(names)} base parameters are those of the drawing, because the "
        f"recordings tell little of them: {', '.join(same)}"
    ]


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
