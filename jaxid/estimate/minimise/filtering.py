"""Noise filters along the samples, and derivatives by their coefficients."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


def known_rows(
    noise: Float[Array, "..."],
    kept: Bool[Array, "recordings samples"],
    before: Int[Array, " recordings"],
) -> Bool[Array, "recordings samples outputs"]:
    """Filtered rows that do not depend on values before the first sample.

    **Arguments:**

    - `kept`: samples that count. `before`: number of earlier samples.
    """
    used = noise != 0 if noise.ndim == 2 else jnp.any(noise != 0, axis=1)
    taps = used.shape[1] - jnp.argmax(used[:, ::-1], axis=1) - 1
    row = before[:, None] + jnp.cumsum(kept, axis=1) - 1
    return kept[..., None] & (row[..., None] >= taps)


class Coefficients(eqx.Module):
    """Taps of the noise filter that are estimated with the parameters, padded to few lengths.

    A coefficient multiplies output `column`, `lag` samples earlier, in row `row`; `there` is False
    for padding. The residual is linear in the coefficients: their columns are its own past.
    """

    row: Int[Array, " coefficients"]
    column: Int[Array, " coefficients"]
    lag: Int[Array, " coefficients"]
    there: Bool[Array, " coefficients"]

    @classmethod
    def of(cls, orders: Sequence[int], full: bool) -> "Coefficients":
        """The coefficients of filters of these orders; with `full`, of matrices of filters."""
        n = len(orders)
        places = [
            (i, j, lag)
            for i in range(n)
            for j in (range(n) if full else (i,))
            for lag in range(1, orders[i] + 1)
        ]
        size = 8 * -(-len(places) // 8)
        padded = np.array(places + [(0, 0, 0)] * (size - len(places)), int).reshape(size, 3)
        row, column, lag = (jnp.asarray(x) for x in padded.T)
        return cls(row, column, lag, jnp.arange(size) < len(places))

    def into(
        self, noise: Float[Array, "..."], values: Float[Array, " coefficients"]
    ) -> Float[Array, "..."]:
        """The filter with these values for its coefficients."""
        at = (self.row, self.lag) if noise.ndim == 2 else (self.row, self.column, self.lag)
        return noise.at[at].add(jnp.where(self.there, values, 0.0))

    def known(
        self, kept: Bool[Array, "recordings samples"], before: Int[Array, " recordings"]
    ) -> Bool[Array, "recordings samples 1"]:
        """`known_rows` of these coefficients, the same for all outputs."""
        row = before[:, None] + jnp.cumsum(kept, axis=1) - 1
        return (kept & (row >= jnp.max(self.lag, initial=0)))[..., None]

    def derivative(
        self, raw: Float[Array, "recordings samples outputs"]
    ) -> Float[Array, "recordings samples outputs coefficients"]:
        """Derivative of the filtered residual by the coefficients."""
        at = jnp.arange(raw.shape[1])[:, None] - self.lag
        past = raw[:, jnp.maximum(at, 0), self.column] * ((at >= 0) & self.there)
        rows = self.row == jnp.arange(raw.shape[2])[:, None]
        return past[:, :, None, :] * rows


def filtered_by(
    noise: Float[Array, "..."], x: Float[Array, "recordings samples outputs columns"]
) -> Float[Array, "recordings samples outputs columns"]:
    """A(z) x along the samples; earlier samples count as zero."""

    def passed(lag, x):
        a = noise[..., lag]
        return a[:, None] * x if noise.ndim == 2 else jnp.einsum("ij,rkjc->rkic", a, x)

    def body(lag, total):
        earlier = jnp.roll(x, lag, axis=1)
        known = jnp.arange(x.shape[1]) >= lag
        return total + passed(lag, jnp.where(known[:, None, None], earlier, 0.0))

    # Only taps that are used are computed; white noise, the usual case, has one.
    used = jnp.max(jnp.where(noise != 0, jnp.arange(noise.shape[-1]), 0))
    return jax.lax.fori_loop(1, used + 1, body, passed(0, x))
