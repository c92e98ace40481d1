"""The resolution of readings: encoder counts, or the digits of a file."""

import numpy as np
from jaxtyping import Float64


def quantum(q: Float64[np.ndarray, "samples joints"]) -> Float64[np.ndarray, " joints"] | None:
    """The encoder step of each joint, or None if it is not visible for some joint.

    **Arguments:**

    - `q`: positions, `(samples, joints)`, rad or m.
    """
    steps = [step_of(column) for column in q.T]
    # A power of ten comes from the decimals of the file, not from the encoder.
    if any(step is None or is_decimal(step) for step in steps):
        return None
    return np.array(steps, dtype=np.float64)


def is_decimal(step: float) -> bool:
    """Whether a step is a power of ten, as for numbers in a text file."""
    decade = np.log10(step)
    return bool(abs(decade - np.round(decade)) < 1e-6)


def step_of(x: Float64[np.ndarray, " samples"]) -> float | None:
    """The step such that all differences of a signal are multiples of it; None without one.

    **Arguments:**

    - `x`: readings, `(samples,)`, in any unit.
    """
    with np.errstate(all="ignore"):
        # A fast joint never moves by one count, but some of its values are one count apart.
        moves = np.abs(np.concatenate([np.diff(x), np.diff(np.unique(x))]))
        moves = np.sort(moves[moves > 1e-12 * np.abs(x).max(initial=0.0)])
        if moves.size < 20:
            return None
        step, upto = float(moves[0]), 0
        # Rounding in the file blurs the smallest move, so longer moves refine the step first.
        while upto < moves.size:
            upto = int(np.searchsorted(moves, max(30 * moves[upto], 30 * step), side="right"))
            counts = np.round(moves[:upto] / step)
            # A hundredth of a count is far above rounding. The probability that 20 moves are all
            # within it by chance is 50**-20.
            if not (np.abs(moves[:upto] / step - counts) < 0.01).all():
                return None
            step = (
                float(np.median(moves[:upto] / counts))
                if upto == moves.size
                else _fitted(moves[:upto], counts)
            )
        return step


def _fitted(moves: Float64[np.ndarray, " moves"], counts: Float64[np.ndarray, " moves"]) -> float:
    """The least-squares step for moves and their counts."""
    return float(moves @ counts / (counts @ counts))
