"""The fit of all speed benchmarks, and its timing."""

import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxid
from jaxid.estimate.minimise import Problem
from jaxid.parameters import Bounds
from jaxid.simulation.batch import Batch, prepare
from jaxid.simulation.runs import simulate
from jaxid.simulation.steps import set_substeps

SUBSTEPS = 4
PERIOD = 0.01
# Estimates of separable PEM for the SCARA, Brunot et al. 2016.
TRUTH = {
    "ZZ1r": 3.45,
    "ZZ2": 0.062,
    "MX2": 0.121,
    "MY2": 0.007,
    "Fv1": 0.03,
    "Fc1": 0.82,
    "Fv2": 0.013,
    "Fc2": 0.137,
}
NOISE = 0.02


def cad() -> jaxid.ClosedLoop:
    """The loop at its CAD start, with the same steps between samples as all peers."""
    return set_substeps(jaxid.scara(), SUBSTEPS)


def truth() -> jaxid.ClosedLoop:
    """The loop that was recorded."""
    return cad().with_values(**TRUTH)


def recordings(
    count: int, seconds: float, seed: int = 0, period: float = PERIOD
) -> jaxid.Recordings:
    """Simulated recordings of multi-sines that start at rest, with noise in the torque."""
    rng = np.random.default_rng(seed)
    time_ = period * np.arange(round(seconds / period) + 1)
    fade = np.clip(time_ / 1.5, 0, 1)[:, None]
    fade = fade**3 * (10 - 15 * fade + 6 * fade**2)
    bare = []
    for k in range(count):
        rate, phase = rng.uniform(0.5, 4.0, (5, 2)), rng.uniform(0, 2 * np.pi, (5, 2))
        size = np.array([0.5, 0.9]) / 5**0.5
        q_ref = fade * np.sum(size * np.sin(time_[:, None, None] * rate + phase), axis=1)
        # Only its reference and its start are used; the torque is overwritten.
        bare.append(jaxid.Recording.from_arrays(time_, q_ref, q_ref, q_ref=q_ref, name=f"r{k}"))
    runs = simulate(truth(), jaxid.Recordings.of(bare))
    return jaxid.Recordings.of(
        [
            jaxid.Recording.from_arrays(
                r.time,
                np.asarray(run.q),
                np.asarray(run.tau) + NOISE * rng.standard_normal(run.tau.shape),
                q_ref=r.q_ref,
                name=r.name,
            )
            for r, run in zip(bare, runs, strict=True)
        ]
    )


def problem(loop: jaxid.ClosedLoop, batch: Batch, mesh: jax.sharding.Mesh | None = None) -> Problem:
    """The problem that `OEM` minimises, with white noise and starts at rest."""
    bounds, count = Bounds.of(loop.free_parameters), batch.q0.shape[0]
    white = jnp.zeros((loop.joints, 16)).at[:, 0].set(1.0)
    ends = bounds.lower, bounds.upper
    kinds = ("tau",), False, mesh
    ones, rest = jnp.ones(loop.joints), jnp.zeros(count)
    return Problem(loop, batch, ones, white, rest, *ends, *kinds)


def arrays(recs: jaxid.Recordings) -> list[dict[str, np.ndarray]]:
    """Data of each recording for peers, without padding: intervals, cubics, start, torque."""
    batch = prepare(cad(), recs)
    return [
        {
            "time": np.asarray(batch.time[k, :n]),
            "h": np.ascontiguousarray(batch.intervals.h[k, :n]),
            "reference": np.ascontiguousarray(batch.intervals.reference[k, :n]),
            "start": np.concatenate([batch.q0[k], batch.v0[k]]),
            "tau": np.asarray(batch.tau[k, :n]),
        }
        for k, n in enumerate(r.samples for r in recs)
    ]


def once(fun: Callable[[], Any]) -> float:
    """Wall-clock seconds of one call."""
    started = time.perf_counter()
    jax.block_until_ready(fun())
    return time.perf_counter() - started


def interleaved(
    funs: dict[str, Callable[[], Any]], budget: float, most: int = 200
) -> dict[str, float]:
    """Shortest of many calls of each function, in turns, so other load affects all equally, s.

    **Arguments:**

    - `budget`: seconds for all functions together; each is called at least twice.
    - `most`: largest number of calls of each function.
    """
    best = dict.fromkeys(funs, np.inf)
    started = time.perf_counter()
    for turn in range(most):
        for name, fun in funs.items():
            best[name] = min(best[name], once(fun))
        if turn > 0 and time.perf_counter() - started > budget:
            break
    return best


def peak_memory() -> float:
    """Largest resident set of this process, MiB."""
    # `resource` would include the memory of the parent when it started this process.
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024


def machine() -> str:
    """Processor and versions, one line."""
    names = [
        line.split(":")[1].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return (
        f"{names[0] if names else platform.processor()}, {len(names)} cores; "
        f"Python {platform.python_version()}, jax {jax.__version__}, jaxid {_version()}"
    )


def _version() -> str:
    from importlib.metadata import version

    return version("jaxid-robotics")
