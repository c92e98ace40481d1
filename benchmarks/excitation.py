"""An optimised reference: compared with random ones, checked against limits and predictions.

The arm and its limits are those of benchmarks/li2023. The first comparison is between the optimised
reference and the best of 1000 random feasible ones, by the geometric mean of the predicted
deviations. Then the limits are checked at ten times the sample rate. Finally the loop that tracks
the reference is simulated (independent simulator of tests/independent) with torque noise of a
hundredth of the limits, 400 draws (100 draws have 7 % of scatter). The result is the ratio of the
deviations of the regression, or of OEM, to the predicted ones.

python -m benchmarks.excitation [--quick] [--json FILE]
"""

import time

import jax.numpy as jnp
import numpy as np
import pandas as pd

import jaxid
from jaxid.excitation import Excitation
from jaxid.excitation.descent import random_references
from jaxid.excitation.design import information_along, make_design
from jaxid.excitation.reference import margins_on

from . import li2023
from ._output import options, report
from .li2023 import LIMITS, PERIOD, TICK, TRUTH, sim

HARMONICS = 8


def geometric(std: np.ndarray) -> float:
    """Geometric mean."""
    return float(np.exp(np.mean(np.log(std))))


def best_random(kind: str, count: int) -> float:
    """The smallest geometric mean of deviations among random references within the limits."""
    design, centre = make_design(
        li2023.loop(), LIMITS, period=PERIOD, harmonics=HARMONICS, rate=1 / TICK, kind=kind
    )
    drawn, scores = random_references(design, centre, count, seed=7)
    # Chosen by the measure that is compared, not by the criterion of the search.
    found = [
        geometric(np.sqrt(np.diag(np.linalg.inv(information_along(design, drawn[k])))))
        for k in np.argsort(scores)[:20]
    ]
    return min(found)


def tracked(reference: Excitation) -> sim.Batch:
    """One period tracked from rest, without noise and with ideal encoders."""
    when = TICK * np.arange(round(PERIOD / TICK) + 1)
    asked = np.asarray(reference.series(when))
    law = sim.SampledComputedTorque(li2023.model_of_the_law(), **li2023.GAINS, period=TICK)
    return sim.simulate_batch([li2023.TRUE], asked, law, np.zeros(1), substeps=4)


def estimates(reference: Excitation, runs: sim.Batch, kind: str, draws: int) -> np.ndarray:
    """Estimates from noisy torque, (draws, parameters)."""
    rng = np.random.default_rng(11)
    noise = 0.01 * LIMITS.torque * rng.standard_normal((draws, *runs.tau.shape[1:]))
    noisy = runs.tau + noise
    if kind == "closed-loop":
        part = slice(0, runs.tau.shape[1])
        return np.asarray(li2023.chord(reference.series, runs, part).solve(jnp.asarray(noisy)))
    model, method = li2023.loop(), jaxid.DifferenceLS(jaxid.Differences("central"))
    found = []
    # The command is constant between ticks; at a tick the mean of before and after is recorded.
    seen = (runs.tau + np.roll(runs.tau, 1, axis=1)) / 2 + noise
    for tau in seen:
        recording = jaxid.Recording.from_arrays(runs.time[1:], runs.q[0, 1:], tau[1:])
        found.append(jaxid.fit(model, recording, method).theta)
    return np.array(found)


def study(kind: str, quick: bool) -> dict[str, float]:
    """For one kind of information: gain, limits and predictions of the optimised reference."""
    started = time.perf_counter()
    settings = {"tries": 40, "starts": 1, "rounds": 4} if quick else {"tries": 200, "starts": 4}
    if kind == "closed-loop" and not quick:
        settings = {"tries": 100, "starts": 3}
    found = jaxid.optimal_excitation(
        li2023.loop(),
        LIMITS,
        period=PERIOD,
        harmonics=HARMONICS,
        rate=1 / TICK,
        kind=kind,
        **settings,
    )
    seconds = time.perf_counter() - started
    random = best_random(kind, 50 if quick else 1000)
    runs = tracked(found)
    theta = estimates(found, runs, kind, 30 if quick else 400)
    names = list(li2023.loop().names)
    order = [names.index(n) for n in found.names]
    std = theta[:, order].std(axis=0, ddof=1)
    bias = theta[:, order].mean(axis=0) - np.array([TRUTH[n] for n in found.names])
    ratio = std / found.std
    fine = np.arange(round(10 * PERIOD / TICK)) * TICK / 10
    moved = {"q": runs.q_true[0], "tau": runs.tau[0]}
    return {
        "deviation, geometric mean": geometric(found.std),
        "best random": random,
        "optimised / random": geometric(found.std) / random,
        "least margin at ten times the rate, %": 100 * float(margins_on(found, fine).min()),
        "tracked torque / limit": float((np.abs(moved["tau"]) / LIMITS.torque).max()),
        "tracked position within": bool(
            np.all((moved["q"] > LIMITS.low - 0.02) & (moved["q"] < LIMITS.high + 0.02))
        ),
        "found / predicted, geometric mean": geometric(ratio),
        "found / predicted, least": float(ratio.min()),
        "found / predicted, largest": float(ratio.max()),
        "bias in deviations, largest": float(np.abs(bias / found.std).max()),
        "seconds": seconds,
    }


def table(quick: bool = False) -> pd.DataFrame:
    """One column for each kind of information."""
    kinds = ("inverse-dynamics",) if quick else ("inverse-dynamics", "closed-loop")
    return pd.DataFrame({kind: study(kind, quick) for kind in kinds}).rename_axis("what")


def main() -> None:
    """Prints the table."""
    given = options(__doc__)
    report(table(given.quick), given.json, ".4g")


if __name__ == "__main__":
    main()
