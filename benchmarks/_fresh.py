"""Measurements that need a process of their own: first calls, and peaks of memory."""

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

    - `fun`: of a module, so that another process finds it by its name.
    - `at_once`: how many processes; more than one where times do not matter.
    """
    context = multiprocessing.get_context("spawn")
    with context.Pool(at_once, _without_cache, maxtasksperchild=1) as pool:
        return pool.map(fun, jobs, chunksize=1)


def _without_cache() -> None:
    # A program that another process has compiled would make the first call a second one.
    jax.config.update("jax_enable_compilation_cache", False)


def cold_and_warm(fun: Callable[[], Any], repeats: int) -> tuple[Any, float, float]:
    """What a function gives, seconds of its first call, and of the shortest of more calls."""
    found, cold = _timed(fun)
    return found, cold, min(_timed(fun)[1] for _ in range(repeats))


def _timed(fun: Callable[[], Any]) -> tuple[Any, float]:
    started = time.perf_counter()
    found = jax.block_until_ready(fun())
    return found, time.perf_counter() - started


def peak_memory() -> float:
    """Largest resident memory of this process so far, MiB; not a number where Linux is not.

    The peak in `getrusage` would not do: a process inherits that of the one that started it.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    peaks = [int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")]
    return peaks[0] if peaks else float("nan")
