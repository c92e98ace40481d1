"""Filters s^k F(s) of a whole regression, which replace differentiation."""

import itertools

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..errors import FitError
from ..recording import Recording


class Operator(eqx.Module):
    """F(s) = product of λ/(s + λ) over its poles, at a sample period.

    **Arguments:**

    - `poles`: λ of each, 1/s. `step`: sample period, s.
    """

    poles: tuple[float, ...] = eqx.field(static=True)
    step: float = eqx.field(static=True)

    @classmethod
    def of(cls, poles: tuple[float, ...], recording: Recording) -> "Operator":
        """The operator at a recording's sample rate.

        **Raises:** `FitError` for poles that are not positive, above the Nyquist rate, or too slow
            for the recording.
        """
        for pole in poles:
            if not np.isfinite(pole) or pole <= 0:
                raise FitError(f"a filter pole of {pole:g} 1/s is not stable: give a positive one")
            if pole >= np.pi * recording.rate:
                raise FitError(
                    f"a filter pole of {pole:g} 1/s is above the Nyquist rate of {recording.name} "
                    f"({np.pi * recording.rate:.4g} 1/s at {recording.rate:.4g} Hz): lower it, or "
                    "sample faster"
                )
        if min(poles) * recording.duration < 10:
            raise FitError(
                f"{recording.name} lasts {recording.duration:.3g} s, less than ten time constants "
                f"of a filter pole of {min(poles):.3g} 1/s: raise the pole, or record longer"
            )
        return cls(tuple(float(p) for p in poles), recording.period)

    def __call__(
        self, k: int, x: Float[np.ndarray, "samples *axes"], held: bool = False
    ) -> Float[np.ndarray, "samples *axes"]:
        """s^k F(s) on samples, integrated exactly over each sample.

        The initial state is the steady state of the first sample.

        **Arguments:**

        - `k`: at most the number of poles.
        - `x`: samples, interpolated by a cubic spline. Linear interpolation would cause errors of
          relative size (λ step)² that differ between differentiated and other terms.
        - `held`: True if each sample is constant until the next instead.
        """
        import scipy

        flat = x.reshape(len(x), -1)
        pieces = np.zeros((4, len(flat) - 1, flat.shape[1]))
        pieces[0] = flat[:-1]
        if not held:
            spline = scipy.interpolate.CubicSpline(self.step * np.arange(len(flat)), flat)
            pieces = spline.c[::-1] * np.array([1.0, 1.0, 2.0, 6.0])[:, None, None]
        stages = self._stages(pieces, flat[0])
        # A stage is y' = λ (u - y), where u is the output of the stage before.
        chain = [flat, *stages]
        for _ in range(k):
            poles = self.poles[-len(chain) + 1 :]
            pairs = itertools.pairwise(chain)
            chain = [pole * (u - y) for pole, (u, y) in zip(poles, pairs, strict=True)]
        return chain[-1].reshape(x.shape)

    def _stages(
        self, pieces: Float[np.ndarray, "4 pieces columns"], start: Float[np.ndarray, " columns"]
    ) -> list[Float[np.ndarray, "samples columns"]]:
        """Outputs of the chain of first-order low-passes, at the samples."""
        import scipy

        n = len(self.poles)
        # The input's value and derivatives obey u' = u1, u1' = u2, ... within a piece.
        rate = np.zeros((n + 4, n + 4))
        for j, pole in enumerate(self.poles):
            rate[j, j] = -pole
            rate[j, n if j == 0 else j - 1] = pole
        rate[range(n, n + 3), range(n + 1, n + 4)] = 1.0
        step = scipy.linalg.expm(rate * self.step)[:n]
        stages: list[np.ndarray] = []
        for j in range(n):
            force = np.tensordot(step[j, n:], pieces, 1)
            for i, earlier in enumerate(stages):
                force = force + step[j, i] * earlier[:-1]
            state = (step[j, j] * start)[None]
            after, _ = scipy.signal.lfilter([1.0], [1.0, -step[j, j]], force, axis=0, zi=state)
            stages.append(np.concatenate([start[None], after]))
        return stages

    def transient(self, time: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "samples poles"]:
        """Columns that span the response to any initial state."""
        t = time - time[0]
        columns, seen = [], []
        for pole in self.poles:
            # The responses of nearly equal poles are replaced by one response and its derivative.
            same = sum(abs(pole - other) < 1e-3 * pole for other in seen)
            columns.append((pole * t) ** same * np.exp(-pole * t))
            seen.append(pole)
        return np.stack(columns, axis=1)

    @property
    def memory(self) -> int:
        """Samples after which a disturbance has decayed below 1e-6."""
        return int(np.ceil(18 / min(self.poles) / self.step))

    @property
    def factor(self) -> int:
        """Decimation that keeps the pass band: four samples per period of the fastest pole."""
        return max(1, int(2 * np.pi / max(self.poles) / self.step / 4))
