"""Tables 2 and 3 of Brunot et al. 2016 compared with jaxid, and joint PEM, which failed there.

python -m benchmarks.brunot2016 [--quick] [--json FILE] [--figures FOLDER] [--draws 20] [--fd 50]

A SCARA with the parameters of Table 2 under the PD law of Table 1, simulated at 100 Hz by
tests/independent (no code of jaxid), with AR noise of orders 13 and 37 at the levels of Table 3.
LS, OEM, SEP-PEM and joint PEM start from the CAD values of the paper. Then joint PEM on other noise
draws, and the same minimisation by SciPy with finite differences from the same starts.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy import optimize

import jaxid
from jaxid.display import figures
from jaxid.estimate import minimise as ls
from jaxid.noise import autocorrelation, innovations

from ._brunot import (
    NAMES,
    ORDERS,
    PAPER,
    PAPER_ERRORS,
    Motion,
    draw,
    motion,
    recording,
    truth,
)

GIVEN = jaxid.OEM(start="given", progress=False)
JOINT = jaxid.JointPEM(GIVEN, orders=ORDERS)
SEPARABLE = jaxid.SeparablePEM(GIVEN, orders=ORDERS)


def noisy(m: Motion, seed: int) -> jaxid.Recording:
    """A recording of a motion under one noise draw."""
    return recording(m, draw(m.run.tau, np.random.default_rng(seed), 1)[0])


def fits(fitted: jaxid.Recording) -> dict[str, jaxid.Fit]:
    """Every method of the paper, and joint PEM, from the CAD start."""
    methods = {
        "LS": jaxid.IDIM(weights="ordinary"),
        "OEM": GIVEN,
        "SEP-PEM (paper's first step)": jaxid.SeparablePEM(GIVEN, first_step="plain"),
        "SEP-PEM": jaxid.SeparablePEM(GIVEN),
        "joint PEM": JOINT,
    }
    return {name: jaxid.fit(jaxid.scara(), fitted, method) for name, method in methods.items()}


def table_2(found: dict[str, jaxid.Fit]) -> pd.DataFrame:
    """Values and relative deviations in %, those of the paper and of jaxid."""
    names = list(found["OEM"].names)
    columns: dict[Any, Any] = {"truth": truth(names)}
    for name in ("LS", "OEM/PEM", "dev LS", "dev OEM", "dev PEM"):
        values = dict(zip(NAMES, PAPER[name], strict=True))
        columns[f"paper: {name}"] = [values[n] for n in names]
    for name, fit in found.items():
        columns[name] = fit.theta
        columns[f"{name}, dev %"] = 100 * fit.std / np.abs(fit.theta)
    for name in ("OEM", "SEP-PEM"):
        printed = jaxid.deviations(found[name])["paper"].to_numpy()
        columns[f"{name}, dev % as printed"] = 100 * printed / np.abs(found[name].theta)
    return pd.DataFrame(columns, index=names).T


def table_3(found: dict[str, jaxid.Fit], unseen: jaxid.Recording) -> pd.DataFrame:
    """Relative errors in % on the fitted recording and on the unseen one."""
    unknown = (np.nan, np.nan)
    rows = {f"paper: {name}": (*errors, *unknown) for name, errors in PAPER_ERRORS.items()}
    rows["paper: cross-validation"] = (*unknown, *PAPER_ERRORS["cross-validation"])
    for name, fit in found.items():
        fitted = jaxid.compare(fit, fit.recordings).error_percent.to_numpy()[0]
        other = jaxid.compare(fit, unseen).error_percent.to_numpy()[0]
        rows[name] = (*fitted, *other)
    columns = ["joint 1", "joint 2", "unseen, joint 1", "unseen, joint 2"]
    return pd.DataFrame.from_dict(rows, orient="index").set_axis(columns, axis=1)


def log_determinant(fit: jaxid.Fit) -> float:
    """Log-likelihood of a fit's prediction error, without constants."""
    rows = np.concatenate([e[max(ORDERS) :] for e in fit.innovations])
    return -0.5 * len(rows) * float(np.linalg.slogdet(rows.T @ rows / len(rows))[1])


def from_cad(m: Motion, draws: int) -> pd.DataFrame:
    """Joint and separable PEM for several noise draws, from the CAD start."""
    rows = []
    for seed in range(draws):
        fitted = noisy(m, 1000 + seed)
        started = time.perf_counter()
        joint = jaxid.fit(jaxid.scara(), fitted, JOINT)
        seconds = time.perf_counter() - started
        apart = jaxid.fit(jaxid.scara(), fitted, SEPARABLE)
        away = (joint.theta - truth(joint.names)) / joint.std
        rows.append(
            {
                "converged": joint.succeeded,
                "iterations": joint.iterations,
                "seconds": seconds,
                "gain over SEP-PEM": log_determinant(joint) - log_determinant(apart),
                "SEP-PEM rounds": apart.rounds,
                "worst of 8 deviations": float(np.abs(away).max()),
            }
        )
        print(f"draw {seed}: {rows[-1]}", flush=True)
    return pd.DataFrame(rows)


def finite_differences(m: Motion, runs: int, draws: int) -> pd.DataFrame:
    """The same squared error by SciPy, 58 values, two-point differences, CAD start.

    It gets joint PEM's final weights, so it minimises the same squared error.
    """
    rows = []
    for k in range(runs):
        fit = jaxid.fit(jaxid.scara(), noisy(m, 1000 + k % draws), JOINT)
        problem, count = fit.optimum.problem, 8 + sum(ORDERS)
        goal = float(np.sum(np.asarray(_residual(problem, fit.optimum.theta)) ** 2))
        start = np.zeros(count)
        start[:8] = jaxid.scara().theta
        if k >= draws:
            # Beyond the draws, starts are varied by about a third.
            start[:8] *= np.random.default_rng(k).uniform(0.7, 1.3, 8)
        begun, calls = time.perf_counter(), 0

        def error(x, problem=problem):
            nonlocal calls
            calls += 1
            wide = np.pad(x, (0, len(problem.lower) - len(x)))
            value = np.asarray(_residual(problem, jnp.asarray(wide))).reshape(-1)
            # lsqnonlin also refuses values that are not finite.
            return np.where(np.isfinite(value), value, 1e6)

        low, high = (np.asarray(x)[:count] for x in (problem.lower, problem.upper))
        ended = optimize.least_squares(error, start, bounds=(low, high), max_nfev=100)
        rows.append(
            {
                "reaches joint PEM's": bool(2 * ended.cost < goal * 1.001),
                "error over joint PEM's": 2 * ended.cost / goal,
                "simulations": calls,
                "seconds": time.perf_counter() - begun,
            }
        )
        print(f"run {k}: {rows[-1]}", flush=True)
    return pd.DataFrame(rows)


@eqx.filter_jit
def _residual(problem: ls.Problem, theta: jax.Array) -> jax.Array:
    start = jnp.concatenate([problem.batch.q0, problem.batch.v0], axis=1)
    return ls.residual_at(problem, theta, start)


def jacobian_cost(found: dict[str, jaxid.Fit], repeats: int = 15) -> dict[str, float]:
    """Milliseconds for one Jacobian of joint PEM (58 values) and one of OEM (8), in turn."""

    @eqx.filter_jit
    def jacobian(problem: ls.Problem, theta: jax.Array) -> jax.Array:
        own = problem.loop.theta.shape[0]
        loop = problem.loop.with_theta(theta[:own])
        return problem.linearised(loop, problem.batch, theta[own:]).jacobian

    spent: dict[str, list[float]] = {"OEM": [], "joint PEM": []}
    for k in range(repeats + 1):
        for name, times in spent.items():
            optimum = found[name].optimum
            begun = time.perf_counter()
            jax.block_until_ready(jacobian(optimum.problem, jnp.asarray(optimum.theta)))
            if k:
                times.append(1e3 * (time.perf_counter() - begun))
    least = {f"{name} ms": min(times) for name, times in spent.items()}
    return least | {"ratio": least["joint PEM ms"] / least["OEM ms"]}


def draw_figures(found: dict[str, jaxid.Fit], unseen: jaxid.Recording) -> dict[str, Any]:
    """Figures 4 to 8 of the paper, by name."""
    pem = found["SEP-PEM"]
    assert pem.noise is not None
    drawn = {"fig_4_and_6_torque": jaxid.compare(found["OEM"], pem.recordings).plot()}
    held = jaxid.compare(pem, unseen)
    series = {
        "oem": found["OEM"].residuals[0],
        "pem": pem.innovations[0],
        "pem_unseen": innovations(held.residuals[0], pem.noise),
    }
    for name, rows in series.items():
        for joint in range(2):
            order = 0 if name == "oem" else pem.noise[joint].order  # type: ignore[union-attr]
            acf, bound = autocorrelation([rows[order:, joint]])
            figure = "fig_8" if "unseen" in name else f"fig_{5 + 2 * joint}"
            title = f"joint {joint + 1}, {name.replace('_', ', ')}"
            drawn[f"{figure}_{name}_joint_{joint + 1}"] = figures.autocorrelation(
                np.arange(1, len(acf)), acf[1:], bound, title=title
            )
    return drawn


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one draw, no finite differences")
    parser.add_argument("--json", type=Path, help="also write the tables to this file")
    parser.add_argument("--figures", type=Path, help="folder for figures 4 to 8 as HTML")
    parser.add_argument("--draws", type=int, default=20, help="noise draws for joint PEM")
    parser.add_argument("--fd", type=int, default=50, help="runs with finite differences")
    given = parser.parse_args()
    draws, runs = (1, 0) if given.quick else (given.draws, given.fd)
    fit_motion, other = motion(1, "fit"), motion(2, "unseen")
    fitted, unseen = noisy(fit_motion, 0), noisy(other, 1)
    found = fits(fitted)
    content: dict[str, Any] = {}

    def show(title: str, table: pd.DataFrame) -> None:
        print(f"\n{title}\n{table.to_string(float_format=lambda x: f'{x:.4g}')}", flush=True)
        content[title] = json.loads(table.to_json(orient="split"))

    show("Table 2", table_2(found))
    show("Table 3, %", table_3(found, unseen))
    how = {
        name: {
            "status": fit.status.name,
            "iterations": fit.iterations,
            "rounds": fit.rounds,
            "orders": str([f.order for f in fit.noise]) if fit.noise else "",  # type: ignore[union-attr]
            "seconds": fit.seconds,
        }
        for name, fit in found.items()
    }
    show("how they ended (the paper: two rounds, orders 13 and 37)", pd.DataFrame(how).T)
    printed = [jaxid.deviations(found[n])["paper"] for n in ("OEM", "SEP-PEM")]
    ratio = pd.DataFrame({"OEM over SEP-PEM": printed[0] / printed[1]}).T
    show("deviations as printed (the paper: 9.7 to 10)", ratio)
    show("whiteness of SEP-PEM, p of Ljung and Box", found["SEP-PEM"].whiteness())
    show("time of one Jacobian", pd.DataFrame(jacobian_cost(found), index=["now"]))
    show("joint PEM from CAD, by noise draw", from_cad(fit_motion, draws))
    if runs:
        show("finite differences from the same starts", finite_differences(fit_motion, runs, draws))
    if given.figures is not None:
        given.figures.mkdir(parents=True, exist_ok=True)
        for name, figure in draw_figures(found, unseen).items():
            figure.write_html(given.figures / f"{name}.html")
    if given.json is not None:
        given.json.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
