"""The base parameters of a chain of joints: combinations of link parameters that torque shows."""

from collections.abc import Sequence
from functools import lru_cache

import jax
import numpy as np
from jaxtyping import Float

from ..chain import BODY, Chain


def base_parameters(
    chain: Chain, lower: tuple[float, ...], upper: tuple[float, ...]
) -> tuple[tuple[int, ...], tuple[str, ...], Float[np.ndarray, "base parameters"]]:
    """The combinations of the bodies' parameters on which torque depends (Gautier 1991).

    **Arguments:**

    - `lower`, `upper`: limits of the joints, rad or m.

    **Returns:** for each combination, the place of its leading parameter and its name (with an R if
    other parameters are added), and the combinations, `(base, 10 · joints)`.
    """
    return _base_parameters(_geometry(chain), chain.slides, lower, upper)


def random_regressor(
    chain: Chain, lower: tuple[float, ...], upper: tuple[float, ...]
) -> tuple[Float[np.ndarray, "rows parameters"], Float[np.ndarray, "states joints"]]:
    """Regressor of all bodies' parameters at random states, a row per joint; accelerations.

    **Arguments:**

    - `lower`, `upper`: limits of the joints, rad or m.
    """
    return _random_regressor(_geometry(chain), chain.slides, lower, upper)


Geometry = tuple[tuple[float, ...], ...]


def _geometry(chain: Chain) -> Geometry:
    """A chain's numbers in hashable form, for a cache."""
    arrays = chain.rotations, chain.offsets, chain.axes, chain.gravity
    return tuple(tuple(np.asarray(x).ravel().tolist()) for x in arrays)


def _chain(geometry: Geometry, slides: tuple[bool, ...]) -> Chain:
    n = len(slides)
    turns, places, axes, gravity = (np.asarray(x) for x in geometry)
    return Chain(turns.reshape(n, 3, 3), places.reshape(n, 3), axes.reshape(n, 3), gravity, slides)


@lru_cache(maxsize=64)
def _base_parameters(
    geometry: Geometry,
    slides: tuple[bool, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> tuple[tuple[int, ...], tuple[str, ...], Float[np.ndarray, "base parameters"]]:
    import scipy

    chain = _chain(geometry, slides)
    rows, _ = _random_regressor(geometry, slides, lower, upper)
    order = sorted(range(rows.shape[1]), key=lambda k: _led(k, chain))
    kept = sorted(independent(rows, order, 1e-7))
    combined = scipy.linalg.lstsq(rows[:, kept], rows)[0]
    combined[np.abs(combined) < 1e-9] = 0.0
    names = []
    for row, k in zip(combined, kept, strict=True):
        several = np.count_nonzero(np.abs(row) > 1e-6) > 1
        names.append(f"{BODY[k % 10]}{k // 10 + 1}{'R' if several else ''}")
    return tuple(kept), tuple(names), combined


def independent(
    rows: Float[np.ndarray, "rows columns"], order: Sequence[int], tolerance: float
) -> list[int]:
    """Columns that do not depend linearly on earlier ones, in the given order."""
    size = np.linalg.norm(rows, axis=0)
    kept: list[int] = []
    basis = np.zeros((len(rows), 0))
    for k in order:
        if size[k] <= 1e-9 * size.max():
            continue
        column = rows[:, k] / size[k]
        for _ in range(2):
            column = column - basis @ (basis.T @ column)
        left = np.linalg.norm(column)
        if left > tolerance:
            basis = np.column_stack([basis, column / left])
            kept.append(k)
    return kept


def _led(place: int, chain: Chain) -> tuple[bool, int]:
    """The rank of a parameter among those that may lead a combination.

    Mass, the first moment along the axis and one moment across it are combined with parameters of
    the previous link (Khalil, Dombre 2002). They lead a combination only without such parameters.
    """
    axis = int(np.argmax(np.abs(np.asarray(chain.axes)[place // 10])))
    across = (axis + 2) % 3
    led = (("XX", "YY", "ZZ")[across], ("MX", "MY", "MZ")[axis], "M")
    return BODY[place % 10] in led, place


@lru_cache(maxsize=8)
def _random_regressor(
    geometry: Geometry,
    slides: tuple[bool, ...],
    lower: tuple[float, ...],
    upper: tuple[float, ...],
) -> tuple[Float[np.ndarray, "rows parameters"], Float[np.ndarray, "states joints"]]:
    chain, n = _chain(geometry, slides), len(slides)
    rng = np.random.default_rng(0)
    q = rng.uniform(lower, upper, (20 * n, n))
    v, a = rng.normal(size=(2, 20 * n, n))
    rows = jax.jit(jax.vmap(chain.regressor))(q, v, a)
    return np.asarray(rows).reshape(-1, 10 * n), a
