"""Coverage of deviations: how often nominal 95 % intervals contain the simulated truth.

python -m benchmarks.coverage [--quick] [--json FILE]

Noise of the levels of Brunot et al. 2016, white and coloured (AR of orders 13 and 37), is drawn
400 times on the torque of one 20 s motion of the independent simulator of tests/independent. The
first draw is fitted from CAD. The others are fitted from its estimate by a few Gauss-Newton steps,
vmapped (`jaxid.estimate.refit`). Further results are the actual spread of PEM and OEM, and the
bias of five methods if encoder noise is fed back in the loop.
"""

import dataclasses
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

import jaxid
from jaxid.estimate.covariance import Reduced, score_covariance, spent_by
from jaxid.estimate.idim import Stacked, solve, stack
from jaxid.estimate.refit import Refitted, refit_signals
from jaxid.estimate.regression import Filtering, decimator

from ._brunot import LEVELS, ORDERS, Motion, draw, motion, recording, sim, truth
from ._output import options

DRAWS = 400
CHUNK = 16
GIVEN = jaxid.OEM(start="given", progress=False)
Draws = dict[str, tuple[np.ndarray, np.ndarray]]


def intervals(fit: jaxid.Fit, found: Refitted, kind: str) -> np.ndarray:
    """Deviations of each draw, by (A.1) or the sandwich."""
    problem, p = fit.optimum.problem, len(fit.names)
    spent, full = spent_by(problem), problem.mix is not None
    deviations = []
    for residual, jacobian in zip(
        np.asarray(found.residual), np.asarray(found.jacobian), strict=True
    ):
        reduced = Reduced(list(residual), list(jacobian), spent)
        flat = jacobian.reshape(-1, p)
        if kind == "sandwich":
            information = flat.T @ flat
            bread = np.linalg.inv(information)
            meat = score_covariance(reduced.residuals, reduced.jacobians, information)
            covariance = bread @ meat @ bread
        else:
            whiten = np.linalg.inv(np.linalg.cholesky(reduced.spread(full)))
            wide = np.einsum("ij,rkjp->rkip", whiten, jacobian).reshape(-1, p)
            covariance = np.linalg.inv(wide.T @ wide)
        deviations.append(np.sqrt(np.diag(covariance)))
    return np.array(deviations)


def literal(fit: jaxid.Fit, found: Refitted) -> np.ndarray:
    """The paper's printed formula in every draw: its lambda with the unfiltered gradient."""
    base = jaxid.deviations(fit)["paper"].to_numpy()
    own = np.concatenate(Reduced.of(fit.optimum).residuals)
    scale = _in_units(fit)

    def variance(e: np.ndarray) -> np.ndarray:
        return np.sum((e @ scale.T) ** 2, axis=(-2, -1))

    each = np.asarray(found.residual).reshape(len(found.theta), -1, own.shape[1])
    return np.sqrt(variance(each) / variance(own))[:, None] * base


def _in_units(fit: jaxid.Fit) -> np.ndarray:
    """Factor from whitened residuals to N·m."""
    problem = fit.optimum.problem
    mix = np.eye(len(problem.weights)) if problem.mix is None else np.asarray(problem.mix)
    return np.diag(1 / np.asarray(problem.weights)) @ np.linalg.inv(mix)


def least_squares(m: Motion, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """IDIM-LS as in equation (5), whose deviations assume that filtered torque is white."""
    clean = jaxid.Recordings.of(recording(m, 0.0))
    loop = jaxid.scara()
    stacked = stack(loop, clean, Filtering())
    reduce = decimator(clean[0], Filtering())
    thetas, deviations = [], []
    for rows in noise:
        right = stacked.right + reduce(rows)
        own = Stacked(stacked.columns, right, stacked.scales, stacked.lengths)
        solved = solve(own, loop.names, "ordinary")
        thetas.append(solved.theta)
        deviations.append(np.sqrt(np.diag(solved.covariance)))
    return np.array(thetas), np.array(deviations)


@dataclass
class Study:
    """One colour of noise: estimates and deviations of every draw, by method and formula."""

    names: tuple[str, ...]
    found: Draws
    unsettled: dict[str, int]

    def coverage(self) -> pd.DataFrame:
        """Share of draws whose 95 % interval contains the truth, %, by method and parameter."""
        t = truth(self.names)
        rows = {
            name: 100 * np.mean(np.abs(theta - t) <= 1.959964 * std, axis=0)
            for name, (theta, std) in self.found.items()
        }
        return pd.DataFrame(rows, index=list(self.names)).T

    def honesty(self) -> pd.DataFrame:
        """Root mean square of the error in its own deviations: 1 if these are correct."""
        t = truth(self.names)
        rows = {
            name: np.sqrt(np.mean(((theta - t) / std) ** 2, axis=0))
            for name, (theta, std) in self.found.items()
        }
        return pd.DataFrame(rows, index=list(self.names)).T

    def efficiency(self) -> pd.DataFrame:
        """Actual spread of PEM over that of OEM, by parameter."""
        spread = {name: theta.std(axis=0) for name, (theta, _) in self.found.items()}
        rows = {
            name: spread[name] / spread["OEM sandwich"]
            for name in ("SEP-PEM (A.1)", "joint PEM (A.1)", "LS")
        }
        return pd.DataFrame(rows, index=list(self.names)).T


def study(m: Motion, draws: int, coloured: bool, seed: int = 0) -> Iterator[Study]:
    """All methods on the same draws, some draws at a time; results are cumulative."""
    noise = draw(m.run.tau, np.random.default_rng(seed), draws, coloured)
    first = recording(m, noise[0])
    signals = (m.run.tau + noise)[:, None]
    # White noise gets the same filters: too high orders must do no harm.
    methods = {
        "OEM": GIVEN,
        "SEP-PEM": jaxid.SeparablePEM(GIVEN, orders=ORDERS),
        "joint PEM": jaxid.JointPEM(GIVEN, orders=ORDERS),
    }
    fits = {name: jaxid.fit(jaxid.scara(), first, method) for name, method in methods.items()}
    pieces: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    unsettled = dict.fromkeys(methods, 0)
    for begin in range(0, draws, CHUNK):
        for name, fit in fits.items():
            found = refit_signals(fit, signals[begin : begin + CHUNK])
            theta = np.asarray(found.theta)[:, : len(fit.names)]
            unsettled[name] += int(np.sum(~(np.asarray(found.last) < 1e-2)))
            kinds = {f"{name} (A.1)": intervals(fit, found, "white")}
            if name == "OEM":
                kinds["OEM sandwich"] = intervals(fit, found, "sandwich")
            if name != "joint PEM":
                kinds[f"{name} as printed"] = literal(fit, found)
            for kind, deviations in kinds.items():
                pieces.setdefault(kind, []).append((theta, deviations))
        own = noise[begin : begin + CHUNK]
        pieces.setdefault("LS", []).append(least_squares(m, own))
        found_so_far = {
            kind: (np.concatenate([t for t, _ in x]), np.concatenate([d for _, d in x]))
            for kind, x in pieces.items()
        }
        yield Study(fits["OEM"].names, found_so_far, dict(unsettled))


# --- encoder noise that is fed back in the loop ---------------------------------------------------


@dataclass(frozen=True)
class NoisyPD:
    """The PD law with an encoder error that is linear from sample to sample, rad."""

    law: sim.PD
    error: np.ndarray
    sample: float = 0.01
    period = None

    def torque(self, ref, q, v, t):
        """Commanded torques, N m."""
        k = min(int(t / self.sample + 1e-9), len(self.error) - 2)
        slope = (self.error[k + 1] - self.error[k]) / self.sample
        now = self.error[k] + slope * (t - k * self.sample)
        return self.law.torque(ref, np.add(q, now).tolist(), np.add(v, slope).tolist(), t)


def bias(m: Motion, draws: int, deviation: float = 7e-5, seed: int = 0) -> pd.DataFrame:
    """Mean relative error of each method in %, and in units of its standard error."""
    rng = np.random.default_rng([seed, 1])
    methods = {
        "IDIM-LS": jaxid.IDIM(),
        "IDIM-IV": jaxid.IDIMIV(),
        "DIDIM": jaxid.DIDIM(),
        "OEM": GIVEN,
        "SEP-PEM": jaxid.SeparablePEM(GIVEN, orders=ORDERS),
        "joint PEM": jaxid.JointPEM(GIVEN, orders=ORDERS),
    }
    found: dict[str, list[np.ndarray]] = {name: [] for name in methods}
    names: tuple[str, ...] = ()
    for _ in range(draws):
        error = deviation * rng.standard_normal(m.run.q.shape)
        # Arm and loop are at rest at the start.
        error[0] = 0.0
        run = sim.simulate(
            sim.Scara(), m.reference, NoisyPD(sim.PD(), error), (), 20.0, 0.01, rtol=1e-7, atol=1e-9
        )
        seen = dataclasses.replace(m, run=dataclasses.replace(run, q=run.q + error))
        start = None
        for name, method in methods.items():
            loop = jaxid.scara()
            if start is not None and name in ("IDIM-IV", "DIDIM", "OEM"):
                # These need a start that can be simulated; LS gives one.
                loop = loop.with_theta(np.maximum(start, 1e-4))
            fit = jaxid.fit(loop, recording(seen, 0.0), method)
            start = fit.theta if start is None else start
            names = fit.names
            found[name].append(fit.theta)
    t = truth(names)
    rows = {}
    for name, values in found.items():
        error = (np.array(values) - t) / t
        standard = error.std(axis=0, ddof=1) / np.sqrt(draws)
        rows[name, "bias %"] = 100 * error.mean(axis=0)
        rows[name, "in standard errors"] = error.mean(axis=0) / standard
    return pd.DataFrame(rows, index=list(names)).T


def tables(result: Study) -> dict[str, pd.DataFrame]:
    """The tables of a study, by title."""
    return {
        "coverage of 95 % intervals, %": result.coverage(),
        "error in its own deviations (root mean square)": result.honesty(),
        "actual spread over that of OEM": result.efficiency(),
    }


def main() -> None:
    """Prints the tables."""
    given = options(__doc__)
    draws = CHUNK if given.quick else DRAWS
    m = motion(1, "fit")
    content: dict[str, object] = {"draws": draws, "levels": LEVELS}
    for colour in ("coloured", "white"):
        for result in study(m, draws, colour == "coloured"):
            done = len(result.found["LS"][0])
            print(f"{colour} noise: {done} of {draws} draws", file=sys.stderr, flush=True)
        print(f"\n{colour} noise, {draws} draws; not settled: {result.unsettled}")
        for title, table in tables(result).items():
            print(f"\n{title}\n{table.to_string(float_format=lambda x: f'{x:.2f}')}")
        content[colour] = {title: table.to_dict() for title, table in tables(result).items()}
    table = bias(m, 2 if given.quick else 20)
    print("\nencoder noise round the loop")
    print(table.to_string(float_format=lambda x: f"{x:.2f}"))
    content["bias"] = [{"row": list(k), **v} for k, v in table.T.to_dict().items()]
    if given.json is not None:
        given.json.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
