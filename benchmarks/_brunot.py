"""The SCARA of Brunot et al. 2016 with similar noise, from the independent simulator."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import jaxid

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import independent as sim

# Table 2 (SEP-PEM), Table 3 and section 4.3 of the paper.
NAMES = ("ZZ1r", "Fv1", "Fc1", "ZZ2", "MX2", "MY2", "Fv2", "Fc2")
PAPER = {
    "LS": (3.50, 0.03, 0.25, 0.06, 0.24, 0.01, 0.005, 0.05),
    "OEM/PEM": (3.44, 0.07, 0.23, 0.06, 0.24, 0.01, 0.003, 0.05),
    "dev LS": (0.007, 2.1, 0.13, 0.040, 0.013, 0.29, 1.8, 0.49),
    "dev OEM": (0.024, 3.7, 0.55, 0.13, 0.056, 1.2, 8.4, 1.7),
    "dev PEM": (0.0024, 0.38, 0.056, 0.013, 0.0057, 0.12, 0.86, 0.17),
}
PAPER_ERRORS = {"LS": (2.98, 4.35), "OEM/PEM": (2.39, 4.57), "cross-validation": (3.21, 4.42)}
LEVELS = (0.0239, 0.0457)
ORDERS = (13, 37)
SAMPLES = 2001


def polynomial(order: int, seed: int) -> np.ndarray:
    """A stable AR polynomial; the noise has about sixty times the variance of its innovation.

    The paper prints orders and deviations only. By its formulas, its ratio of 9.7 to 10 between the
    deviations of OEM and PEM is the square root of that factor; here it is 8.
    """
    rng = np.random.default_rng(seed)
    reflection = 0.12 * rng.uniform(-1, 1, order)
    reflection[:2], reflection[-1] = (-0.97, 0.85), 0.15
    a = np.ones(1)
    for k in reflection:
        a = np.append(a, 0.0)
        a = a + k * a[::-1]
    return a


AR = tuple(polynomial(order, seed) for order, seed in zip(ORDERS, (1, 2), strict=True))


@dataclass(frozen=True)
class Motion:
    """One noise-free run: the simulated signals, and the reference."""

    name: str
    reference: sim.MultiSine
    run: sim.Simulation


def motion(seed: int, name: str) -> Motion:
    """20 s at 100 Hz under the PD law of Table 1, with the parameters of Table 2."""
    reference = sim.draw_multisine(np.random.default_rng(seed), 20.0)
    return Motion(name, reference, sim.simulate(sim.Scara(), reference, sim.PD(), (), 20.0, 0.01))


def draw(
    torque: np.ndarray, rng: np.random.Generator, draws: int, coloured: bool = True
) -> np.ndarray:
    """Noise of the levels of Table 3 for a torque, `(draws, samples, joints)`."""
    columns = []
    for polynomial, level, tau in zip(AR, LEVELS, torque.T, strict=True):
        a = polynomial if coloured else np.ones(1)
        white = rng.standard_normal((draws, len(tau) + 3000))
        noise = lfilter([1.0], a, white, axis=1)[:, 3000:]
        deviation = np.sqrt(np.sum(lfilter([1.0], a, np.eye(1, 20_000)[0]) ** 2))
        columns.append(noise / deviation * level * np.sqrt(np.mean(tau**2)))
    return np.stack(columns, axis=-1)


def recording(m: Motion, noise: np.ndarray | float) -> jaxid.Recording:
    """A recording of a motion with noise on its torque."""
    r = m.run
    return jaxid.Recording.from_arrays(r.time, r.q, r.tau + noise, q_ref=r.q_ref, name=m.name)


def truth(names: Sequence[str]) -> np.ndarray:
    """The simulated arm's parameters."""
    return np.array([getattr(sim.Scara(), name) for name in names])
