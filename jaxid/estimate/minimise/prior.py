"""Knowledge of values before the recordings, as further rows of a least-squares problem."""

from types import ModuleType
from typing import Any

import equinox as eqx
from jaxtyping import Float


class Prior(eqx.Module):
    """Gaussian knowledge of a loop's free parameters.

    The products of `rows` with the error of the expected values are independent, with a standard
    deviation of one.

    **Arguments:**

    - `rows`: `(known, parameters)`, in the inverse units of the parameters.
    - `expected`: `(parameters,)`, in the units of the parameters.
    """

    rows: Float[Any, "known parameters"]
    expected: Float[Any, " parameters"]

    def left(self, theta: Float[Any, " values"]) -> Float[Any, " known"]:
        """Expected minus estimated values in standard deviations.

        **Arguments:**

        - `theta`: the parameters, and possibly values of which nothing is known.
        """
        return self.rows @ (self.expected - theta[: len(self.expected)])

    def products(
        self, theta: Float[Any, " values"], xp: ModuleType
    ) -> tuple[Float[Any, ""], Float[Any, "values values"], Float[Any, " values"]]:
        """r'r, J'J and J'r of its rows at parameter values.

        **Arguments:**

        - `xp`: `numpy` or `jax.numpy`.
        """
        left = self.left(theta)
        rows = xp.pad(self.rows, ((0, 0), (0, len(theta) - self.rows.shape[1])))
        return left @ left, rows.T @ rows, -left @ rows
