"""Inertia of an arm at recorded positions."""

import jax
import numpy as np
from jaxtyping import Array, Float

from ..arms import AbstractArm
from ..compiling import compiled

# Number of positions: always so many, for one program.
_POSITIONS = 64


def mass_matrices(
    arm: AbstractArm, q: Float[np.ndarray, "samples joints"]
) -> Float[np.ndarray, "positions joints joints"]:
    """Inertia at evenly spaced samples of positions, kg·m² or kg."""
    chosen = np.linspace(0, len(q) - 1, _POSITIONS).astype(int)
    return np.asarray(_mass_matrices(arm, jax.device_put(q[chosen])))


@compiled
def _mass_matrices(
    arm: AbstractArm, q: Float[Array, "positions joints"]
) -> Float[Array, "positions joints joints"]:
    return jax.vmap(arm.mass_matrix)(q)
