"""Measurements that need a separate process: first calls, and peaks of memory."""

import multiprocessing
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import jax

Job = TypeVar("Job")
Result = TypeVar("Result")


def each_afresh(
    fun: Callable[[Job], Result], jobs: Iterable[Job], at_once: int = 1
) -> list[Result]:
    """The function of each job in a new process, where nothing is compiled yet.

    **Arguments:**

    - `fun`: a function of a module, which another process finds by its name.
    - `at_once`: number of processes; more than one only if times do not matter.
    """
    context = multiprocessing.get_context("spawn")
    with context.Pool(at_once, _without_cache, maxtasksperchild=1) as pool:
        return pool.map(fun, jobs, chunksize=1)


def _without_cache() -> None:
    # Otherwise the first call could use a program that another process has compiled.
    jax.config.update("jax_enable_compilation_cache", False)


def cold_and_warm(fun: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """The result of a function, seconds of its first call, and of the shortest later call."""
    found, cold = _timed(fun)
    return found, cold, min(_timed(fun)[1] for _ in range(repeats))


def _timed(fun: Callable[[], Any]) -> tuple[Any, float]:
    started = time.perf_counter()
    found = jax.block_until_ready(fun())
    return found, time.perf_counter() - started


def peak_memory() -> float:
    """Largest resident memory of this process so far, MiB; NaN if the system is not Linux.

    The peak in `getrusage` is not usable, because a process inherits that of its parent.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    peaks = [int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")]
    return peaks[0] if peaks else float("nan")
