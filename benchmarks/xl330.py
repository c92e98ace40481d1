"""A hobby servo with a pendulum (XL330, measured): friction models, and a discovery.

The five models of friction are those of the recordings' README. Their error is given at the values
of the README, after a fit by least squares, and after a minimisation of the error itself by the
method of Nelder and Mead, as in the README. A model starts from the values of the one that it
contains, so it cannot end worse. The error is the mean absolute position error over twelve
recordings, each simulated from its first sample to its end. Then `discover` starts from M1 on the
recordings at kp 100 and 800, tested on those at kp 400. Finally the models are expressed in a
simulator's parameters.

python -m benchmarks.xl330 [--quick] [--json FILE]
"""

import dataclasses
import time

import jax.numpy as jnp
import numpy as np
import pandas as pd
import scipy

import jaxid
from jaxid.effects import GearFriction

from ._output import options, records, show, write
from ._xl330 import error_mrad, models, recordings

# Errors in the README, fits at the nominal voltage.
README = {"M1": 59.5, "M2": 58.4, "M3": 45.8, "M4": 35.7, "M5": 34.6}
# The model from which each fit starts.
FROM = {"M2": "M1", "M3": "M1", "M4": "M3", "M5": "M4"}
# Values of the README, whose Fs is zero in M4; those of the other two are not given.
GIVEN = {
    "M1": {"kt1": 0.331, "R1": 4.31, "Ia1": 0.0017, "q0": 0.004, "Fc1": 0.020, "Fv1": 0.0103},
    "M3": {"kt1": 0.343, "R1": 3.99, "Ia1": 0.0020, "q0": 0.018, "Fc1": 0.0, "Fv1": 0.0089}
    | {"Km1": 0.162},
    "M4": {"kt1": 0.403, "R1": 4.35, "Ia1": 0.0018, "q0": 0.017, "Fc1": 0.002, "Fv1": 0.0043}
    | {"Km1": 0.190, "Kms1": 0.128, "vs1": 0.33, "power1": 1.2, "Fs1": 0.0},
}
# Width of the sign of velocity, rad/s, for fits (stuck arms need some width) and for the error.
SHARP, EVALUATIONS = 0.003, 400
# Steps between samples during the minimisation by Nelder and Mead. They change the error by less
# than 0.1 mrad; the loop's fastest time constant requires up to 82, with which errors are reported.
COARSE = jaxid.Stepping(substeps=10)
METHOD = jaxid.OEM(start="given", initial="rest", max_steps=40, progress=False)


def started(loop: jaxid.ClosedLoop, before: jaxid.ClosedLoop | None) -> jaxid.ClosedLoop:
    """A loop with the values of another for the parameters that both have."""
    if before is None:
        return loop
    known = dict(zip(before.names, map(float, before.theta), strict=True))
    both = {name: value for name, value in known.items() if name in loop.names}
    # Parameters that differ in M5 are equal in M4.
    twins = {"Ke1": "Km1", "Kes1": "Kms1"}
    both |= {new: known[old] for new, old in twins.items() if new in loop.names and old in known}
    return loop.with_values(**both)


def polished(
    loop: jaxid.ClosedLoop, given: dict[str, jaxid.Recording], evaluations: int
) -> jaxid.ClosedLoop:
    """The loop at the values of smallest mean absolute error near its own."""
    low, high = (
        np.array([getattr(p.declaration, side) for p in loop.free_parameters])
        for side in ("lower", "upper")
    )
    at = np.asarray(loop.theta)
    scale = np.array([p.declaration.scale for p in loop.free_parameters])
    size = np.maximum(np.abs(at), 0.1 * scale)
    coarse = dataclasses.replace(loop, stepping=COARSE)

    def error(x: np.ndarray) -> float:
        theta = jnp.asarray(np.clip(at + size * x, low, high))
        found = mean(error_mrad(coarse.with_theta(theta), given))
        return found if np.isfinite(found) else np.inf

    simplex = np.concatenate([np.zeros((1, len(at))), 0.1 * np.eye(len(at))])
    done = scipy.optimize.minimize(
        error,
        np.zeros(len(at)),
        method="Nelder-Mead",
        options={"maxfev": evaluations, "initial_simplex": simplex, "adaptive": True},
    )
    return loop.with_theta(jnp.asarray(np.clip(at + size * done.x, low, high)))


def fits(
    given: dict[str, jaxid.Recording], names: list[str], evaluations: int
) -> tuple[pd.DataFrame, dict[str, jaxid.ClosedLoop]]:
    """A row for each model: its error, mrad, by both methods of fitting; and the loops."""
    rows: dict[str, dict[str, float]] = {}
    squares: dict[str, jaxid.ClosedLoop] = {}
    best: dict[str, jaxid.ClosedLoop] = {}
    for name, loop in models(SHARP).items():
        if name not in names:
            continue
        began = time.perf_counter()
        before = FROM.get(name, "")
        fit = jaxid.fit(started(loop, squares.get(before)), list(given.values()), METHOD)
        squares[name] = fit.loop
        row = {"README": README[name], "least squares": mean(error_mrad(fit.loop, given))}
        if name in GIVEN:
            row["README's values"] = mean(error_mrad(loop.with_values(**GIVEN[name]), given))
        starts = [fit.loop, *([started(loop, best[before])] if before in best else [])]
        start = min(starts, key=lambda one: mean(error_mrad(one, given)))
        best[name] = polished(start, given, evaluations)
        each = error_mrad(best[name], given)
        row["mean absolute"] = mean(each)
        for kp in ("kp100", "kp400", "kp800"):
            row[kp] = mean({n: x for n, x in each.items() if n.startswith(kp)})
        row["free fall"] = mean({n: x for n, x in each.items() if "lift_and_drop" in n})
        rows[name] = row | {"seconds": time.perf_counter() - began}
        print(name, f"{row['mean absolute']:.1f} mrad", best[name], flush=True)
    return pd.DataFrame(rows).T.rename_axis("model"), best


def mean(errors: dict[str, float]) -> float:
    """Mean over the recordings, mrad."""
    return float(np.mean(list(errors.values())))


def discovery(given: dict[str, jaxid.Recording]) -> pd.DataFrame:
    """A row for each step of a discovery from M1: position error at kp 400, held out, mrad."""
    seen = [r for name, r in given.items() if "kp400" not in name]
    unseen = {name: r for name, r in given.items() if "kp400" in name}
    story = jaxid.discover(
        models(SHARP)["M1"],
        seen,
        list(unseen.values()),
        catalogue=(*jaxid.catalogue, GearFriction),
        method=jaxid.OEM(initial="rest", progress=False),
        progress=False,
    )
    print(story, "\n")
    rows = {}
    for step in story.steps:
        errors = error_mrad(step.fit.loop, unseen)
        rows[step.label] = {"kp 400, mrad": mean(errors), **errors, "verdict": story.verdict}
    return pd.DataFrame(rows).T.rename_axis("step")


def in_terms(loop: jaxid.ClosedLoop, given: dict[str, jaxid.Recording]) -> pd.DataFrame:
    """A row for each choice of a simulator's parameters: its position error, mrad."""
    said = jaxid.simulator_terms(loop, list(given.values()), method=METHOD)
    print(said, "\n")
    rows = {choice: mean(error_mrad(one, given)) for choice, one in said.loops.items()}
    return pd.DataFrame({"mean absolute": rows}).rename_axis("choice")


def main() -> None:
    """Prints the tables."""
    given = options(__doc__)
    measured = recordings()
    names = ["M1", "M3"] if given.quick else list(README)
    table, loops = fits(measured, names, 30 if given.quick else EVALUATIONS)
    show(table, ".1f")
    found = records(table, about="models")
    if not given.quick:
        steps = discovery(measured)
        show(steps, ".1f")
        found += records(steps, about="discovery")
        choices = in_terms(loops["M4"], measured)
        show(choices, ".1f")
        found += records(choices, about="terms")
    write(found, given.json)


if __name__ == "__main__":
    main()
