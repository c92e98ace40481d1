"""Encoders from 2^10 to 2^18 counts per turn: comparison of the methods of Li, Peng and Juang 2023.

A two-link arm under gravity (the independent simulator of tests/independent, with friction) tracks
an optimised reference by computed torque with a model that is 20 % too light, sampled at 500 Hz
with encoders only. The encoders' edges differ between draws. Torque is exact, so all errors are due
to the encoders. The paper's settings are not public; these are chosen: a period of 5 s, of which
the second and third are used (for OEM, which starts at rest, the first two); poles of 40 1/s for
filtered and integral regressions; velocities by backward differences (Appendix C), and by a
zero-phase low-pass in the rows with that name.

python -m benchmarks.li2023 [--quick] [--bits 10 11 ...] [--json FILE] [--figure FILE]
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import plotly.graph_objects as go

import jaxid
from jaxid.control import ComputedTorque
from jaxid.display import figures
from jaxid.excitation import Excitation
from jaxid.signals.fourier import FourierSeries
from jaxid.simulation.batch import prepare
from jaxid.simulation.integration import initial
from jaxid.simulation.runs import run, run_with_sensitivities
from jaxid.simulation.steps import with_substeps

from ._output import report

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import independent as sim

BITS = tuple(range(10, 19))
DRAWS = 100
TICK = 0.002
PERIOD = 5.0
POLE = 40.0
GAINS = {"Kp": (192.0, 192.0), "Ki": (512.0, 512.0), "Kd": (24.0, 24.0)}
TRUE = sim.TwoLink()
TRUTH = {name: getattr(TRUE, name) for name in TRUE.base}
INERTIAL = ("p1", "p2", "p3", "p4", "p5")
FRICTION = ("Fv1", "Fc1", "Fv2", "Fc2")
LIMITS = jaxid.Limits(
    low=[-2.0, -2.0],
    high=[2.0, 2.0],
    speed=[6.0, 8.0],
    acceleration=[40.0, 60.0],
    torque=[6.0, 2.0],
)
_poles = {"lambda1": POLE, "lambda2": POLE}
_backward = {"states": jaxid.Differences("backward")}
METHODS: dict[str, jaxid.estimate.AbstractMethod] = {
    "difference": jaxid.DifferenceLS(),
    "filtered": jaxid.FilteredLS(POLE, **_backward),
    "integral": jaxid.IntegralLS(**_poles, **_backward),
    "weighted integral": jaxid.IntegralLS(**_poles, **_backward, weights="encoder"),
    "filtered, low-passed v": jaxid.FilteredLS(POLE),
    "integral, low-passed v": jaxid.IntegralLS(**_poles),
    "weighted integral, low-passed v": jaxid.IntegralLS(**_poles, weights="encoder"),
    "Fourier": jaxid.FourierLS(period=PERIOD),
    "weighted Fourier": jaxid.FourierLS(period=PERIOD, weights="encoder"),
}


def model_of_the_law() -> sim.TwoLink:
    """The controller's model of the arm, a fifth too light."""
    light = {name: 0.8 * value for name, value in TRUTH.items() if name.startswith("p")}
    return dataclasses.replace(TRUE, **light)


def loop() -> jaxid.ClosedLoop:
    """The closed loop in jaxid, at the true values."""
    light = {name: getattr(model_of_the_law(), name) for name in INERTIAL}
    law = ComputedTorque(jaxid.arms.TwoLink(**light), **GAINS, every=TICK, window=5)
    return jaxid.two_link(law).with_values(**TRUTH)


def excitation(quick: bool = False) -> Excitation:
    """The reference that every run tracks."""
    return jaxid.optimal_excitation(
        loop(), LIMITS, period=PERIOD, rate=1 / TICK, tries=20 if quick else 200, starts=1
    )


def draw(series: FourierSeries, bits: tuple[int, ...], chosen: range) -> dict[int, sim.Batch]:
    """Recordings of every resolution, all simulated at once; `chosen` are the draws."""
    draws = len(chosen)
    offset = np.random.default_rng(2023).uniform(-0.5, 0.5, (DRAWS, 2))[chosen]
    offset = np.tile(offset, (len(bits), 1))
    time = TICK * np.arange(round(3 * PERIOD / TICK) + 1)
    asked = np.asarray(series(time))
    resolution = np.repeat([2 * np.pi / 2.0**b for b in bits], draws)
    law = sim.SampledComputedTorque(model_of_the_law(), **GAINS, period=TICK)
    runs = sim.simulate_batch([TRUE] * len(resolution), asked, law, resolution, offset, substeps=2)
    signals = (runs.q, runs.q_true, runs.tau)
    parts = [slice(k * draws, (k + 1) * draws) for k in range(len(bits))]
    return {
        b: sim.Batch(runs.time, *(x[part] for x in signals))
        for b, part in zip(bits, parts, strict=True)
    }


def recording(runs: sim.Batch, k: int, bits: int, series: FourierSeries, part: slice):
    """One draw as a recording."""
    q_ref = np.asarray(series(runs.time))[0]
    return jaxid.Recording.from_arrays(
        runs.time[part],
        runs.q[k, part],
        runs.tau[k, part],
        q_ref=q_ref[part],
        resolution=2 * np.pi / 2.0**bits,
        name=f"{bits} bits, {k}",
    )


PERIOD_SAMPLES = round(PERIOD / TICK)
SETTLED = slice(PERIOD_SAMPLES, 3 * PERIOD_SAMPLES)
FROM_REST = slice(0, 2 * PERIOD_SAMPLES)


class Chord(eqx.Module):
    """OEM of many draws at once: Gauss-Newton steps with the derivative at the true values."""

    loop: jaxid.ClosedLoop
    intervals: object
    starts: jax.Array
    jacobian: jax.Array

    @eqx.filter_jit
    def solve(self, tau: jax.Array, steps: int = 4) -> jax.Array:
        """Estimates from measured torques, (draws, samples, 2), as (draws, parameters)."""

        def residual(theta, measured):
            at = self.loop.with_theta(theta)
            _, seen, _ = run(at, self.intervals, initial(at, self.intervals, *self.starts))
            return measured - seen[:, 0]

        def one(measured):
            theta = self.loop.theta
            weight = jnp.ones(2)
            for _ in range(steps):
                left = residual(theta, measured)
                weight = 1 / jnp.std(left, axis=0)
                wide = (self.jacobian * weight[:, None]).reshape(-1, theta.shape[0])
                size = jnp.linalg.norm(wide, axis=0)
                normal = (wide / size).T @ (wide / size)
                step = jnp.linalg.solve(normal, (wide / size).T @ (left * weight).reshape(-1))
                theta = theta + step / size
            return theta

        return jax.lax.map(one, tau, batch_size=25)


def chord(series: FourierSeries, runs: sim.Batch, part: slice = FROM_REST) -> Chord:
    """The common part of all draws, for a part of their recordings that starts at rest."""
    one = recording(runs, 0, 18, series, part)
    model = with_substeps(loop(), jaxid.Recordings.of(one))
    batch = prepare(model, [one])
    intervals = jax.tree.map(lambda x: x[0], batch.intervals)
    starts = jnp.asarray(np.asarray(series(np.zeros(1)))[:2, 0])
    x0 = initial(model, intervals, *starts)
    zero = jnp.zeros((len(x0), len(model.theta)))
    by = run_with_sensitivities(model, intervals, x0, zero, (0,)).slopes
    return Chord(model, intervals, starts, by[:, 0])


def errors(names: tuple[str, ...], theta: np.ndarray) -> dict[str, float]:
    """Root mean square of relative errors over draws, %, of inertial parameters and friction."""
    table = pd.DataFrame(np.atleast_2d(theta), columns=list(names))
    truth = pd.Series(TRUTH)
    relative = 100 * (table[list(truth.index)] / truth - 1)

    def size(chosen: tuple[str, ...]) -> float:
        return float(np.sqrt(np.mean(relative[list(chosen)].to_numpy() ** 2)))

    return {"inertial": size(INERTIAL), "friction": size(FRICTION)}


Estimates = dict[tuple[str, int], tuple[np.ndarray, float]]


def estimate(series: FourierSeries, runs: dict[int, sim.Batch]) -> Estimates:
    """By method and resolution: estimates, (draws, parameters), and seconds for one."""
    model = loop()
    shared = chord(series, next(iter(runs.values())))
    found: Estimates = {}
    for b, batch in runs.items():
        draws = len(batch.q)
        for name, method in METHODS.items():
            started = time.perf_counter()
            fits = [
                jaxid.fit(model, recording(batch, k, b, series, SETTLED), method)
                for k in range(draws)
            ]
            seconds = (time.perf_counter() - started) / draws
            found[name, b] = np.array([f.theta for f in fits]), seconds
        started = time.perf_counter()
        theta = np.asarray(shared.solve(jnp.asarray(batch.tau[:, FROM_REST])))
        found["OEM", b] = theta, (time.perf_counter() - started) / draws
    return found


def table(found: Estimates) -> pd.DataFrame:
    """Rows: method and resolution; errors over the draws, and seconds for one estimate."""
    names = loop().names
    return pd.DataFrame(
        [
            {"method": name, "bits": b, "draws": len(theta)}
            | errors(names, theta)
            | {"seconds": seconds}
            for (name, b), (theta, seconds) in found.items()
        ]
    )


def figure(found: pd.DataFrame) -> go.Figure:
    """Error over resolution: one colour per family, dashed if weighted, open if low-passed."""
    drawn = go.Figure()
    families = {"difference": 0, "filtered": 1, "integral": 2, "Fourier": 3, "OEM": 4}
    colours = figures.theme().layout.colorway
    for name, rows in found.groupby("method", sort=False):
        family = next(k for word, k in families.items() if word in str(name))
        drawn.add_scatter(
            x=rows["bits"],
            y=rows["inertial"],
            name=str(name),
            mode="lines+markers",
            line={"color": colours[family], "dash": "dot" if "weighted" in str(name) else "solid"},
            marker={"symbol": "circle-open" if "low-passed" in str(name) else "circle", "size": 9},
        )
    drawn.update_layout(
        template=figures.theme(),
        width=860,
        height=520,
        xaxis_title="encoder, bits a turn",
        yaxis_title="error of the five inertial parameters, %",
    )
    drawn.update_yaxes(type="log")
    return drawn


def verdict(found: pd.DataFrame) -> str:
    """Resolutions that confirm the paper: integral better than filtered better than difference."""
    table = found.pivot_table(index="bits", columns="method", values="inertial")
    integral, filtered, difference = (table[m] for m in ("integral", "filtered", "difference"))

    def where(good: pd.Series) -> str:
        return ", ".join(str(b) for b in good.index[good]) or "none"

    return (
        f"integral better than filtered at {where(integral < filtered)} bits; filtered better than "
        f"difference at {where(filtered < difference)} bits"
    )


def main() -> None:
    """Prints both tables and the verdict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smaller run of the same kind")
    parser.add_argument("--json", type=Path, help="also write the table to this file")
    parser.add_argument("--figure", type=Path, help="also draw it: .png or .html")
    parser.add_argument("--bits", type=int, nargs="+", default=list(BITS), help="which encoders")
    given = parser.parse_args()
    bits = (10, 14) if given.quick else tuple(given.bits)
    series = excitation(given.quick).series
    found = table(estimate(series, draw(series, bits, range(3 if given.quick else DRAWS))))
    report(found, given.json)
    for what in ("inertial", "friction"):
        wide = found.pivot_table(index="method", columns="bits", values=what, sort=False)
        print(f"\nroot mean square error, {what}, %:")
        print(wide.to_string(float_format=lambda x: f"{x:.3g}"))
    print(verdict(found))
    if given.figure is not None:
        drawn = figure(found)
        if given.figure.suffix == ".html":
            drawn.write_html(given.figure)
        else:
            drawn.write_image(given.figure)


if __name__ == "__main__":
    main()
