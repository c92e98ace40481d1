"""Linear least squares with bounds."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from .data import places_among
from .hypotheses import Hypothesis
from .score import WEAK, Gram


def least_squares(
    left: Float[np.ndarray, " rows"],
    columns: Float[np.ndarray, "rows columns"],
    limits: tuple[Float[np.ndarray, " bounded"], Float[np.ndarray, " bounded"]],
) -> tuple[Float[np.ndarray, " columns"], Bool[np.ndarray, " columns"]]:
    """Coefficients of a bounded least-squares problem, and which of them are not at a bound.

    **Arguments:**

    - `left`: right-hand side. `columns`: matrix, with few rows (coordinates in a basis).
    - `limits`: lower and upper bounds of the first columns; the others have none.
    """
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    scaled = columns / size
    lower, upper = (np.full(len(size), x) for x in (-np.inf, np.inf))
    lower[: len(limits[0])], upper[: len(limits[1])] = limits
    taken = np.linalg.lstsq(scaled, left, rcond=1e-9)[0]
    low, high = lower * size, upper * size
    if np.all((taken >= low) & (taken <= high)):
        return taken / size, np.ones(len(size), bool)
    import scipy

    # The solver needs an interval of positive length, also for a value that may not change.
    room = 1e-9 * (1 + np.abs(taken).max())
    found = scipy.optimize.lsq_linear(scaled, left, (low - room, high + room), method="bvls")
    return np.clip(found.x, low, high) / size, found.active_mask == 0


def bounded_amplitudes(
    gram: Float[np.ndarray, "columns columns"],
    score: Float[np.ndarray, " columns"],
    size: Float[np.ndarray, " columns"],
    limits: tuple[Sequence[float], Sequence[float]],
) -> tuple[Float[np.ndarray, " columns"], float]:
    """Amplitudes of signatures within their bounds, and the squared error that they explain.

    Signatures that the base absorbs have zero amplitude. If all amplitudes are at a bound, they
    explain nothing.

    **Arguments:**

    - `gram`: products of the scaled signatures with each other. `score`: with the residual.
    - `size`: norms by which the signatures were divided.
    - `limits`: lower and upper bounds of the amplitudes, in their own units.
    """
    heard = np.diag(gram) > WEAK
    found = np.zeros(len(score))
    if not heard.any():
        return found, 0.0
    values, vectors = np.linalg.eigh(gram[np.ix_(heard, heard)])
    strong = values > WEAK
    root, along = np.sqrt(values[strong]), vectors[:, strong].T
    low, high = (np.asarray(x)[heard] * size[heard] for x in limits)
    left, columns = along @ score[heard] / root, root[:, None] * along
    found[heard], free = least_squares(left, columns, (low, high))
    explained = float(2 * score @ found - found @ gram @ found) if free.any() else 0.0
    found[heard] /= size[heard]
    return found, explained


def within_bounds(
    gram: Gram, hypothesis: Hypothesis
) -> tuple[Float[np.ndarray, " columns"], float]:
    """Amplitudes of a hypothesis within their bounds, and the squared error that they explain.

    It explains nothing if all of them are at a bound, such as a negative drag.
    """
    at = places_among(hypothesis.columns, gram.kept)
    limits, inner = (hypothesis.lower, hypothesis.upper), gram.gram[np.ix_(at, at)]
    return bounded_amplitudes(inner, gram.score[at], gram.size[at], limits)
