"""Long computations that are killed, interrupted, or large.

python -m benchmarks.reliability [--part kills|discoveries|interrupts|size] [--quick] [--json FILE]

kills: bootstrap draws of a regression as a campaign, ended by SIGKILL at 50 random moments and
restarted each time; the result must be bit-identical to an undisturbed run. discoveries: the same
for `jaxid discover --resume` with 20 kills, and runs on one core and on all. interrupts: Ctrl-C at
random moments of `jaxid fit`, and the time until the process ends. size: 1024 recordings of 20 s in
one fit, and 10 000 bootstrap draws by its Jacobian; peak memory and time.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import jaxid
from jaxid.storage.campaign import Campaign
from tests import independent as sim

PARTS = ("kills", "discoveries", "interrupts", "size")
DEMO = Path(jaxid.__file__).parent / "demo" / "hidden"


# --- killed ---------------------------------------------------------------------------------------


def _regression(rows: int = 400, columns: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    x = rng.normal(size=(rows, columns))
    return x, x @ np.arange(1.0, columns + 1) + rng.normal(size=rows)


def _draws(piece: int, size: int = 200) -> dict[str, Any]:
    """A few bootstrap draws of a regression, from the piece's own seed."""
    x, y = _regression()
    rng = np.random.default_rng([7, piece])
    found = []
    for _ in range(size):
        rows = rng.integers(len(y), size=len(y))
        found.append(np.linalg.lstsq(x[rows], y[rows], rcond=None)[0])
    return {"piece": piece, "draws": np.array(found)}


def _work(folder: Path | None, pieces: int, log: int | None) -> Iterator[tuple[str, Any]]:
    def logged(piece: int) -> dict[str, Any]:
        if log is not None:
            os.write(log, f"{piece}\n".encode())
        return _draws(piece)

    with Campaign(folder, {"seed": 7, "data": _regression()}) as campaign:
        yield from campaign.run(logged, {f"draws {k}": k for k in range(pieces)})


def _wait_for_work(process: int, seconds: float) -> None:
    """Waits until a process has used that much processor time, or has ended."""
    while True:
        with open(f"/proc/{process}/schedstat", encoding="ascii") as file:
            worked = int(file.read().split()[0]) / 1e9
        with open(f"/proc/{process}/stat", encoding="ascii") as file:
            gone = file.read().rpartition(")")[2].split()[0] == "Z"
        if worked >= seconds or gone:
            return
        time.sleep(0.0005)


def _digest(found: Iterator[tuple[str, Any]]) -> str:
    values = [f"{name} {value['draws'].tobytes().hex()}" for name, value in sorted(found)]
    return hashlib.sha256("\n".join(values).encode()).hexdigest()


def kills(quick: bool) -> dict[str, Any]:
    """Ends a campaign at random moments, and counts lost and repeated pieces."""
    times, pieces = (8, 40) if quick else (50, 200)
    seed = secrets.randbits(31)
    moments = random.Random(seed)
    folder = Path(tempfile.mkdtemp(prefix="reliability_"))
    log_path = folder / "log"
    log = os.open(log_path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    done, ended_early = 0, 0
    while done < times:
        # Restarted if it finished before it was killed often enough.
        target = folder / f"campaign_{ended_early}"
        child = os.fork()
        if child == 0:
            for _ in _work(target, pieces, log):
                pass
            os._exit(0)
        _wait_for_work(child, moments.uniform(0.0, 0.12))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status):
            done += 1
        else:
            ended_early += 1
    os.close(log)
    begun = len(log_path.read_text().splitlines())
    folders = [folder / f"campaign_{k}" for k in range(ended_early + 1)]
    before = [len(list(one.glob("*.piece"))) for one in folders]
    digests = {_digest(_work(one, pieces, None)) for one in folders}
    undisturbed = _digest(_work(None, pieces, None))
    return {
        "seed": seed,
        "killed": done,
        "campaigns": ended_early + 1,
        "pieces": pieces,
        # Pieces that were begun more often than finished were interrupted.
        "begun": begun,
        "finished": sum(before),
        "pieces_at_the_end": [len(list(one.glob("*.piece"))) for one in folders],
        "same_to_the_bit": digests == {undisturbed},
    }


# --- discoveries ----------------------------------------------------------------------------------


def discoveries(quick: bool) -> dict[str, Any]:
    """Ends `jaxid discover` at random moments, resumes it, and compares the results."""
    seed = secrets.randbits(31)
    moments = random.Random(seed)
    folder = Path(tempfile.mkdtemp(prefix="reliability_"))
    _discovered(folder / "first")
    started = time.perf_counter()
    undisturbed = _discovered(folder / "second")
    took = time.perf_counter() - started
    same, times = 0, 1 if quick else 20
    for k in range(times):
        _discovered(folder / f"killed {k}", moments.uniform(1.5, 0.95 * took))
        same += _discovered(folder / f"killed {k}") == undisturbed
    alone = _discovered(folder / "one core", cores={min(os.sched_getaffinity(0))})
    assert alone is not None
    assert undisturbed is not None
    scores = [np.array([m["score"] for m in x["models"]]) for x in (alone, undisturbed)]
    return {
        "seed": seed,
        "killed": times,
        "same_to_the_bit": same,
        "same_models_on_one_core": [m["model"] for m in alone["models"]]
        == [m["model"] for m in undisturbed["models"]],
        "largest_difference_of_scores": float(np.abs(scores[0] - scores[1]).max()),
    }


def _discovered(
    steps: Path, kill_after: float | None = None, cores: set[int] | None = None
) -> dict[str, Any] | None:
    """The result of `jaxid discover` without its durations; None if it is killed.

    **Arguments:**

    - `steps`: folder of saved steps. `kill_after`: s. `cores`: all if None.
    """
    out = steps.with_suffix(".json")
    command = [sys.executable, "-c", "from jaxid.cli import main; main()", "discover", "--quiet"]
    command += [str(DEMO / f"fit_{k}.csv") for k in (1, 2)]
    command += ["--validate", str(DEMO / "held_out.csv"), "--robot", "scara"]
    command += ["--resume", str(steps), "--json", str(out)]
    pinned = os.sched_getaffinity(0) if cores is None else cores
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, pinned),
    )
    try:
        process.communicate(timeout=kill_after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return None
    return _without_seconds(json.loads(out.read_text(encoding="utf-8")))


def _without_seconds(found: Any) -> Any:
    if isinstance(found, dict):
        return {k: _without_seconds(x) for k, x in found.items() if "seconds" not in k}
    return [_without_seconds(x) for x in found] if isinstance(found, list) else found


# --- interrupted ----------------------------------------------------------------------------------


def interrupts(quick: bool) -> dict[str, Any]:
    """Sends Ctrl-C to `jaxid fit` at random moments, and measures the time until it ends."""
    command = [sys.executable, "-c", "from jaxid.cli import main; main()", "fit"]
    command += [str(DEMO / f"fit_{k}.csv") for k in (1, 2)]
    # Background jobs of a shell ignore Ctrl-C, and so do their child processes.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    seed = secrets.randbits(31)
    moments = random.Random(seed)
    waits, codes = [], []
    with tempfile.TemporaryDirectory() as cache:
        # Without cached programs, most interrupts happen during compilation.
        settings = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache}
        for _ in range(3 if quick else 20):
            process = subprocess.Popen(
                command, env=settings, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            # In the first second Python itself handles Ctrl-C.
            time.sleep(moments.uniform(1.0, 15.0))
            if process.poll() is not None:
                continue
            sent = time.perf_counter()
            process.send_signal(signal.SIGINT)
            process.communicate()
            waits.append(time.perf_counter() - sent)
            codes.append(process.returncode)
    return {
        "seed": seed,
        "interrupted": len(waits),
        "slowest_s": max(waits, default=float("nan")),
        "median_s": float(np.median(waits)) if waits else float("nan"),
        "exit_codes": sorted(set(codes)),
    }


# --- large ----------------------------------------------------------------------------------------


def size(quick: bool) -> dict[str, Any]:
    """Fits many simulated recordings at once, each with its own noise."""
    count, seconds, draws = (16, 5.0, 500) if quick else (1024, 20.0, 10_000)
    case = sim.make_case(41, duration=seconds)
    rng = np.random.default_rng(7)
    recordings = []
    for k in range(count):
        rows = case.recordings[("fit_1", "fit_2")[k % 2]]
        noise = 0.02 * rows["tau_true"].std(axis=0) * rng.normal(size=rows["tau_true"].shape)
        recordings.append(
            jaxid.Recording.from_arrays(
                rows["time"], rows["q_true"], rows["tau_true"] + noise, q_ref=rows["q_ref"]
            )
        )
    started = time.perf_counter()
    fit = jaxid.fit(jaxid.scara(), recordings, jaxid.OEM(progress=False))
    fitted = time.perf_counter() - started
    truth = np.array([getattr(case.plant, n) for n in fit.names])
    started = time.perf_counter()
    spread = _recording_bootstrap(fit, draws)
    return {
        "recordings": count,
        "seconds_each": seconds,
        "status": fit.status.name,
        "iterations": fit.iterations,
        "away_in_deviations": float(np.abs((fit.theta - truth) / fit.std).max()),
        "fit_s": fitted,
        "draws": draws,
        "bootstrap_s": time.perf_counter() - started,
        "bootstrap_over_reported_std": [float(x) for x in spread / fit.std],
        "peak_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "swapped_pages": resource.getrusage(resource.RUSAGE_SELF).ru_nswap,
    }


def _recording_bootstrap(fit: jaxid.Fit, draws: int) -> np.ndarray:
    """Spread of the estimate for recordings drawn with replacement, with one Newton step each."""
    grams, slopes = [], []
    for recording in fit.recordings:
        gram, slope = _normal_equations(fit, recording)
        grams.append(gram)
        slopes.append(slope)
    grams, slopes = np.array(grams), np.array(slopes)
    rng = np.random.default_rng(7)
    found = np.empty((draws, len(fit.names)))
    for k in range(draws):
        often = rng.multinomial(len(grams), np.full(len(grams), 1 / len(grams)))
        gram, slope = np.tensordot(often, grams, 1), np.tensordot(often, slopes, 1)
        found[k] = np.linalg.solve(gram, slope)
    return found.std(axis=0)


def _normal_equations(fit: jaxid.Fit, recording: jaxid.Recording) -> tuple[np.ndarray, np.ndarray]:
    import jax.numpy as jnp

    from jaxid.estimate.minimise import sensitivity
    from jaxid.simulation.batch import prepare

    one = jaxid.Recordings.of(recording)
    batch = prepare(fit.loop, one)
    weights = 1 / np.concatenate(fit.residuals).std(axis=0)
    white = jnp.zeros((len(weights), 1)).at[:, 0].set(1.0)
    found = sensitivity(fit.loop, batch, jnp.asarray(weights), white, ("tau",), False)
    j = np.asarray(found.jacobian).reshape(-1, len(fit.names))
    return j.T @ j, -j.T @ np.asarray(found.residual).reshape(-1)


def main() -> None:
    """Runs the parts; see the module's first lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--quick", action="store_true", help="a smaller run of the same kind")
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    given = parser.parse_args()
    works = {"kills": kills, "discoveries": discoveries, "interrupts": interrupts, "size": size}
    results = {}
    for part in given.part or PARTS:
        results[part] = works[part](given.quick)
        print(f"{part}\n{pd.Series(results[part], dtype=object).to_string()}\n", flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
