"""Random torques that depend on the motion of a joint: examples of what an effect may look like."""

import numpy as np
from jaxtyping import Float

# Standard deviation of wave numbers, in radians over the standard deviation of the coordinate.
_WAVES = 1.5


def random_function(
    q: Float[np.ndarray, " rows"],
    v: Float[np.ndarray, " rows"],
    rng: np.random.Generator,
    odd: bool,
) -> Float[np.ndarray, " rows"]:
    """A wave over position and velocity.

    **Arguments:**

    - `q`, `v`: position and velocity, rad and rad/s, or m and m/s.
    - `odd`: whether it has the sign of the velocity, like friction.
    """
    waves, phase = rng.normal(size=2) * _WAVES, rng.uniform(0, 2 * np.pi)
    x, y = (z / (np.std(z) or 1.0) for z in (q, v))
    return np.cos(waves[0] * x + waves[1] * y + phase) * (np.sign(v) if odd else 1.0)


def random_resonance(
    x: Float[np.ndarray, " rows"], rng: np.random.Generator
) -> Float[np.ndarray, " rows"]:
    """The answer of a resonance of random frequency, which rings for ten rows or longer.

    **Arguments:**

    - `x`: what excites it.
    """
    from scipy.signal import lfilter

    angle, decay = rng.uniform(0.1, 0.8) * np.pi, np.exp(-1 / rng.uniform(10, 40))
    return np.asarray(lfilter([1.0], [1.0, -2 * decay * np.cos(angle), decay**2], x))
