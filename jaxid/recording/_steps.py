"""Steps that readings are multiples of: encoder counts, or the digits of a file."""

import numpy as np
from jaxtyping import Float64


def quantum(q: Float64[np.ndarray, "samples joints"]) -> Float64[np.ndarray, " joints"] | None:
    """The encoder step of each joint, or None where one of them shows none.

    **Arguments:**

    - `q`: positions, `(samples, joints)`, rad or m.
    """
    steps = [step_of(column) for column in q.T]
    # A power of ten is where the file's decimals end, not the encoder's counts.
    if any(step is None or is_decimal(step) for step in steps):
        return None
    return np.array(steps, dtype=np.float64)


def is_decimal(step: float) -> bool:
    """Whether a step is a power of ten, as numbers of a text file have."""
    decade = np.log10(step)
    return bool(abs(decade - np.round(decade)) < 1e-6)


def step_of(x: Float64[np.ndarray, " samples"]) -> float | None:
    """The step that all differences of a signal are whole multiples of, or None without one.

    **Arguments:**

    - `x`: readings, `(samples,)`, in any unit.
    """
    with np.errstate(all="ignore"):
        # A fast joint never moves by one count, and yet reads values that are one apart.
        moves = np.abs(np.concatenate([np.diff(x), np.diff(np.unique(x))]))
        moves = np.sort(moves[moves > 1e-12 * np.abs(x).max(initial=0.0)])
        if moves.size < 20:
            return None
        step, upto = float(moves[0]), 0
        # Digits of a file blur the smallest move, so longer ones make the step more exact first.
        while upto < moves.size:
            upto = int(np.searchsorted(moves, max(30 * moves[upto], 30 * step), side="right"))
            counts = np.round(moves[:upto] / step)
            # A hundredth of a count is far above rounding, and 20 moves that all meet it by chance
            # have odds of 1 to 50**20.
            if not (np.abs(moves[:upto] / step - counts) < 0.01).all():
                return None
            step = (
                float(np.median(moves[:upto] / counts))
                if upto == moves.size
                else _fitted(moves[:upto], counts)
            )
        return step


def _fitted(moves: Float64[np.ndarray, " moves"], counts: Float64[np.ndarray, " moves"]) -> float:
    """The step by which moves are nearest to their counts."""
    return float(moves @ counts / (counts @ counts))
