"""Padding of unknowns, so the solver is compiled for few sizes."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .arrow import Arrow, Unknowns
from .descent import Products
from .problem import Problem, Sums

# Unknowns are padded to multiples of this number, so few programs serve all models.
_FILL = 8


class Filling(eqx.Module):
    """Pads unknowns with dummy unknowns, on which nothing depends and which do not change."""

    parameters: int = eqx.field(static=True)
    recordings: int = eqx.field(static=True)
    estimated: int = eqx.field(static=True)

    @classmethod
    def of(cls, problem: Problem) -> "Filling":
        count = problem.free.shape[0] if problem.free_start else 0
        each = 2 * problem.loop.joints if problem.free_start else 0
        return cls(problem.lower.shape[0], count, each)

    def _room(self) -> tuple[int, int]:
        return -self.parameters % _FILL, -self.recordings % _FILL

    def ends(self, bound: Float[Any, " parameters"], beyond: float) -> Float[np.ndarray, " filled"]:
        """Bounds of all unknowns, with padding."""
        return np.append(bound, np.full(self._room()[0], beyond))

    def unknowns(
        self, y: Unknowns
    ) -> tuple[Float[Array, " filled"], Float[Array, "places estimated"]]:
        """Values of all unknowns, with padding."""
        p, r = self._room()
        theta, start = np.pad(y[0], (0, p)), np.pad(y[1], ((0, r), (0, 0)))
        return jax.device_put((theta, start))

    def emptied(
        self, y: tuple[Float[Any, " filled"], Float[Any, "places estimated"]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values without the padding."""
        return np.asarray(y[0])[: self.parameters], np.asarray(y[1])[: self.recordings]

    def products(self, sums: Sums, loss: Float[Any, ""]) -> Products:
        """Padded products from sums on the host.

        **Arguments:**

        - `loss`: infinite if the point is not acceptable.
        """
        p, r = self._room()
        _, gram, slope, start_gram, start_slope, cross = sums.added()
        grad = np.pad(slope, (0, p)), np.pad(start_slope, ((0, r), (0, 0)))
        dense, blocks = np.pad(gram, (0, p)), np.pad(start_gram, ((0, r), (0, 0), (0, 0)))
        return Products(
            loss / 2, grad, Arrow(dense, blocks, np.pad(cross, ((0, r), (0, 0), (0, p))))
        )
