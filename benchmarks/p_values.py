"""Distribution of p-values and coverage of intervals on clean recordings.

python -m benchmarks.p_values [--seed N] [--law known|unknown] [--quick] [--json FILE] [--jobs 2]

A robot's motions are simulated once and its noise is drawn several times. If no effect is missing,
the smallest corrected p-value of a diagnosis should be uniform between 0 and 1, and nominal 95 %
intervals should contain the true values in 95 % of pairs. If the law is unknown, torque is compared
along the recorded motion.
"""

import argparse
import json
import multiprocessing
import secrets
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

import jaxid
from tests import independent as sim

from ._hidden_cases import COLOURS
from .hidden_effects import configure_jax

FITTING = ("fit_1", "fit_2")
QUANTILES = (0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9)


@dataclass(frozen=True)
class Robot:
    """One robot with its motions, one colour of noise, the number of draws, and what is known."""

    seed: int
    colour: str
    draws: int
    law: str


def draw_robots(master: int, law: str, quick: bool = False) -> list[Robot]:
    """Robots, with the colours of noise in turn."""
    rng = np.random.default_rng(master)
    robots, draws = (5, 2) if quick else (25, 8)
    seeds = rng.integers(1, 2**31, robots).tolist()
    first = int(rng.integers(len(COLOURS)))
    colours = [COLOURS[(first + k) % len(COLOURS)] for k in range(robots)]
    return [Robot(s, c, draws, law) for s, c in zip(seeds, colours, strict=True)]


def pairs(case: sim.Case, robot: Robot) -> list[jaxid.Recordings]:
    """Clean recordings of one robot that differ only in their noise."""
    rng = np.random.default_rng([robot.seed, 1])
    made = []
    for _ in range(robot.draws):
        # The filter is also drawn anew; otherwise all pairs of a robot would share one.
        noise = sim.draw_noise(rng, robot.colour, case.plant.joints, case.noise.level)
        signals = []
        for name in FITTING:
            r = case.recordings[name]
            tau = r["tau_true"] + noise.samples(r["tau_true"], rng)
            signals.append(jaxid.Recording(r["time"], r["q"], tau, q_ref=r["q_ref"], name=name))
        made.append(jaxid.Recordings.of(signals))
    return made


def judge_robot(robot: Robot) -> list[dict[str, Any]]:
    """The smallest p-value of each pair's diagnosis with its hypothesis, and errors of values."""
    rows, loop = [], jaxid.scara()
    case = sim.make_case(robot.seed, (), robot.colour)
    truth = {**vars(case.plant), "delay": 0.0}
    if robot.law == "unknown":
        loop = jaxid.scara(jaxid.control.Tracking())
    for number, recordings in enumerate(pairs(case, robot)):
        started = time.perf_counter()
        start = "auto" if number == 0 else "given"
        fit = jaxid.fit(loop, recordings, jaxid.OEM(start=start, progress=False))
        # The same robot with other noise, so the next fit starts near its optimum.
        loop = fit.loop
        off = (fit.theta - np.array([truth[name] for name in fit.names])) / fit.std
        diagnosis = jaxid.diagnose(fit, progress=False)
        least = min((*diagnosis.ranking, *diagnosis.where), key=lambda v: v.p_value)
        rows.append(
            {
                "seed": robot.seed,
                "colour": robot.colour,
                "draw": number,
                "p": least.p_value,
                "effect": getattr(least.hypothesis.effect, "label", least.hypothesis.name),
                "joint": least.hypothesis.joint,
                "ranking_p": min(v.p_value for v in diagnosis.ranking),
                "curves_p": min(v.p_value for v in diagnosis.where),
                "others_p": min(
                    v.p_value
                    for v in (*diagnosis.ranking, *diagnosis.where)
                    if not isinstance(v.hypothesis.effect, jaxid.effects.AbstractTransmission)
                ),
                "adequate": diagnosis.adequate,
                "off": dict(zip(fit.names, off.tolist(), strict=True)),
                "seconds": time.perf_counter() - started,
            }
        )
    return rows


def summary(table: pd.DataFrame) -> dict[str, Any]:
    """Fractions and quantiles, in total and by colour."""
    least = table["p"]
    inside = pd.DataFrame.from_records(table["off"].to_list()).abs() <= 1.959964
    return {
        "pairs": len(table),
        "below_0.05_percent": 100 * float(np.mean(least < 0.05)),
        "below_0.01_percent": 100 * float(np.mean(least < 0.01)),
        "adequate_percent": 100 * float(table["adequate"].mean()),
        "quantiles": {str(q): float(np.quantile(least, q)) for q in QUANTILES},
        "uniform_p": float(stats.kstest(least, "uniform").pvalue),
        "below_0.05_by_colour": {
            str(colour): 100 * float(np.mean(part["p"] < 0.05))
            for colour, part in table.groupby("colour")
        },
        "below_0.05_ranking_percent": 100 * float(np.mean(table["ranking_p"] < 0.05)),
        "below_0.05_curves_percent": 100 * float(np.mean(table["curves_p"] < 0.05)),
        "below_0.05_without_transmissions_percent": 100 * float(np.mean(table["others_p"] < 0.05)),
        "covered_percent": (100 * inside.mean()).to_dict(),
        "worst": table.nsmallest(8, "p").to_dict(orient="records"),
    }


def show_summary(result: dict[str, Any]) -> None:
    """Prints the fractions with their goal, and the quantiles with their expected values."""
    print(
        f"{result['below_0.05_percent']:.1f} % of {result['pairs']} pairs below 0.05 (aim 1 to 9 %)"
    )
    print(f"{result['below_0.01_percent']:.1f} % below 0.01; adequate", end=" ")
    print(f"{result['adequate_percent']:.1f} %; uniform with p {result['uniform_p']:.2g}")
    print(f"by colour, %: {result['below_0.05_by_colour']}")
    print(
        f"effects alone {result['below_0.05_ranking_percent']:.1f} %, "
        f"curves alone {result['below_0.05_curves_percent']:.1f} %, all without transmissions "
        f"{result['below_0.05_without_transmissions_percent']:.1f} %"
    )
    shown = ", ".join(f"{n} {x:.1f}" for n, x in result["covered_percent"].items())
    print(f"95 % intervals that contain the truth, %: {shown}")
    for should, is_ in result["quantiles"].items():
        print(f"quantile {should:5s} {is_:.4f}")
    for row in result["worst"]:
        print(
            f"  p {row['p']:.2g}: {row['effect']}, joint {row['joint']}, {row['colour']} noise, "
            f"seed {row['seed']}, draw {row['draw']}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the bench; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="of everything; drawn anew if not given")
    parser.add_argument("--law", choices=("known", "unknown"), default="known")
    parser.add_argument("--quick", action="store_true", help="ten pairs")
    parser.add_argument("--json", type=Path, help="file for all results")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args(arguments)
    seed = secrets.randbits(31) if given.seed is None else given.seed
    robots = draw_robots(seed, given.law, given.quick)
    print(f"seed {seed}, {sum(r.draws for r in robots)} pairs, law {given.law}", flush=True)
    configure_jax()
    rows: list[dict[str, Any]] = []
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=spawn) as pool:
        for future in as_completed([pool.submit(judge_robot, r) for r in robots]):
            rows += (found := future.result())
            shown = ", ".join(f"{r['p']:.3g}" for r in found)
            print(f"{found[0]['colour']:9s}seed {found[0]['seed']:10d}: {shown}", flush=True)
    result = summary(pd.DataFrame(rows))
    show_summary(result)
    if given.json is not None:
        content = {"seed": seed, "law": given.law, **result, "rows": rows}
        given.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
