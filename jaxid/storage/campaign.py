"""Long computations in pieces: each finished piece is saved, so a killed run can continue."""

import contextlib
import hashlib
import json
import multiprocessing
import os
import re
import reprlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import TracebackType
from typing import Any

import equinox as eqx
import numpy as np

from ..errors import JaxidError, SaveError, sentence
from . import archive
from .classes import classes_of
from .files import write_whole
from .saved import registry

try:
    import fcntl
except ImportError:  # on Windows, which has other locks, a second process is not detected
    fcntl = None

# Errors that depend on the input only and recur in every run; other errors are not results.
_VERDICTS = (JaxidError, ArithmeticError, np.linalg.LinAlgError)
# A worker is replaced after this number of pieces, because it keeps every program that it compiled.
# (The executor's max_tasks_per_child can deadlock, CPython issue 115634.)
LIFE = 10


class Failed(eqx.Module):
    """Result of a piece that could not be computed: the reason."""

    reason: str = eqx.field(static=True)


class Campaign:
    """A folder with the finished pieces of one long computation.

    Every finished piece is written with checksums under a temporary name, and then renamed. A saved
    piece is not computed again. A damaged piece is renamed and computed again. Only one process at
    a time may use a folder.

    Used as a context:

    ```python
    with Campaign("draws", {"seed": 7, "loop": loop, "recordings": recordings}) as campaign:
        draws = dict(campaign.run(draw, {f"draw {k}": k for k in range(1000)}))
    ```

    **Arguments:**

    - `folder`: created if it does not exist; None to save nothing.
    - `plan`: everything that determines the pieces: seeds, settings, models, recordings. A folder
      can be continued only with the same plan and the same versions of jaxid and its dependencies.
    - `classes`: your own modules that pieces may contain.

    **Raises:** `SaveError` if the folder belongs to another plan or is in use.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str] | None,
        plan: Mapping[str, Any],
        classes: Iterable[type] = (),
    ) -> None:
        self.folder = None if folder is None else Path(folder)
        self.plan = plan
        self.damaged: list[str] = []
        self._classes = set(classes)
        self._lock: int | None = None
        self._key = ""

    def __enter__(self) -> "Campaign":
        if self.folder is None:
            return self
        try:
            self.folder.mkdir(exist_ok=True)
        except (OSError, ValueError) as error:
            raise _problem(
                self.folder, f"cannot be used ({error})", "give a folder, or the name of a new one"
            ) from error
        self._take_lock()
        try:
            self._check_plan()
            for draft in self.folder.glob(".*.part"):
                draft.unlink(missing_ok=True)
        except BaseException:
            self._drop_lock()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._drop_lock()

    def piece(self, name: str, work: Callable[[], Any]) -> Any:
        """The result of a piece: read if it was saved, otherwise computed and saved.

        **Arguments:**

        - `name`: different for every piece.
        - `work`: computes the piece; the result is a module, or numbers, text, arrays and
          containers of these.
        """
        found, value = self._stored(name)
        return value if found else self._keep(name, work())

    def run(
        self,
        work: Callable[[Any], Any],
        pieces: Mapping[str, Any],
        *,
        jobs: int = 1,
        executor: Executor | None = None,
    ) -> Iterator[tuple[str, Any]]:
        """Name and result of every piece: saved ones first, then the others as they finish.

        A piece that raises an error of jaxid or of arithmetic gives a `Failed`; others continue.

        **Arguments:**

        - `work`: a function of one argument; with several jobs, one defined in a module.
        - `pieces`: arguments by name.
        - `jobs`: number of parallel processes.
        - `executor`: used instead of processes; pieces whose worker fails give a `Failed`.
        """
        left = {}
        for name, argument in pieces.items():
            found, value = self._stored(name)
            if found:
                yield name, value
            else:
                left[name] = argument
        if executor is not None:
            yield from self._in_executor(work, left, executor)
        elif jobs == 1:
            for name, argument in left.items():
                yield name, self._keep(name, _tried(work, argument))
        elif left:
            yield from self._in_processes(work, left, jobs)

    # --- one piece ------------------------------------------------------------------------------

    def path(self, name: str) -> Path:
        """The file of a piece."""
        assert self.folder is not None
        readable = re.sub(r"[^A-Za-z0-9+._-]+", "_", name)[:80].strip(".")
        return self.folder / f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:12]}.piece"

    def _stored(self, name: str) -> tuple[bool, Any]:
        if self.folder is None:
            return False, None
        path = self.path(name)
        if not path.exists():
            return False, None
        try:
            held = archive.unpack(path.read_bytes(), str(path), registry(self._classes))
            if held["piece"] != name or held["plan"] != self._key:
                raise SaveError("of another plan")
        except (SaveError, KeyError, TypeError):
            # Kept under another name for inspection.
            path.replace(path.with_suffix(".damaged"))
            self.damaged.append(name)
            return False, None
        return True, held["value"]

    def _keep(self, name: str, value: Any) -> Any:
        # Registers classes made by functions of a catalogue, so that the piece can be read.
        self._classes |= classes_of(value)
        if self.folder is not None and not isinstance(value, _Died):
            content = archive.pack({"piece": name, "plan": self._key, "value": value})
            write_whole(self.path(name), content)
        return value

    # --- several processes ----------------------------------------------------------------------

    def _in_executor(
        self, work: Callable[[Any], Any], left: Mapping[str, Any], executor: Executor
    ) -> Iterator[tuple[str, Any]]:
        """Only this process writes; if a worker is lost, only its own piece fails."""
        running = {executor.submit(_tried, work, given): name for name, given in left.items()}
        try:
            for future in as_completed(running):
                error = future.exception()
                value = future.result() if error is None else _Died(f"its worker failed: {error!r}")
                yield running[future], self._keep(running[future], value)
        finally:
            for future in running:
                future.cancel()

    def _in_processes(
        self, work: Callable[[Any], Any], left: Mapping[str, Any], jobs: int
    ) -> Iterator[tuple[str, Any]]:
        """Only this process writes, so workers left over from a killed run cannot interfere."""
        ended: set[str] = set()
        try:
            names = list(left)
            for at in range(0, len(names), LIFE * jobs):
                batch = {name: left[name] for name in names[at : at + LIFE * jobs]}
                for name, value in _from_pool(work, batch, jobs):
                    ended.add(name)
                    yield name, self._keep(name, value)
        except BrokenProcessPool:
            # One of them ended its process; each is tried alone to find it.
            for name in [name for name in left if name not in ended]:
                try:
                    [(_, value)] = _from_pool(work, {name: left[name]}, 1)
                except BrokenProcessPool:
                    value = _Died("its process was ended from outside")
                yield name, self._keep(name, value)

    # --- the folder -----------------------------------------------------------------------------

    def _take_lock(self) -> None:
        assert self.folder is not None
        if fcntl is None:
            return
        handle = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(handle)
            raise _problem(
                self.folder, "another process works in this folder", "wait for it, or end it"
            ) from error
        self._lock = handle

    def _drop_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _check_plan(self) -> None:
        assert self.folder is not None
        plan = {
            "format": archive.FORMAT,
            "versions": archive.versions(),
            "plan": {name: _described(value) for name, value in self.plan.items()},
        }
        text = json.dumps(plan, indent=1, sort_keys=True) + "\n"
        self._key = hashlib.sha256(text.encode()).hexdigest()
        path = self.folder / "plan.json"
        if not path.exists():
            if any(self.folder.glob("*.piece")):
                raise _problem(self.folder, "has pieces but no plan.json", "give an empty folder")
            write_whole(path, text.encode())
            return
        try:
            had = json.loads(path.read_text(encoding="utf-8"))
            changed = [
                *_changed(had["plan"], plan["plan"]),
                *_changed(had["versions"], plan["versions"]),
            ]
            changed += ["format"] if had["format"] != plan["format"] else []
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise _problem(
                path, f"is not a plan of a campaign ({error!r})", "give another folder"
            ) from error
        if changed:
            raise _problem(
                self.folder,
                f"has the pieces of another computation (different: {', '.join(changed)})",
                "give another folder, or the inputs with which it was begun",
            )


class _Died(Failed):
    """A failure that is not caused by the piece: the next run tries it again."""


def _problem(path: Path, what: str, remedy: str) -> SaveError:
    return SaveError(sentence(str(path), what, remedy))


def _described(value: Any) -> dict[str, str]:
    """A short, comparable text for a part of a plan."""
    return {
        "sha256": hashlib.sha256(archive.pack(value)).hexdigest(),
        "shown": reprlib.Repr().repr(value),
    }


def _changed(had: Mapping[str, Any], has: Mapping[str, Any]) -> list[str]:
    def digest(entry: Any) -> Any:
        return entry.get("sha256") if isinstance(entry, dict) else entry

    names = [*has, *(name for name in had if name not in has)]
    return [n for n in names if digest(had.get(n, "")) != digest(has.get(n, ""))]


def _tried(work: Callable[[Any], Any], argument: Any) -> Any:
    try:
        return work(argument)
    except _VERDICTS as error:
        return Failed(f"{type(error).__name__}: {error}")


def _from_pool(
    work: Callable[[Any], Any], left: Mapping[str, Any], jobs: int
) -> Iterator[tuple[str, Any]]:
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_end_with_parent)
    waiting = iter(left.items())
    running: dict[Future[Any], str] = {}
    try:
        while True:
            while len(running) < jobs and (following := next(waiting, None)) is not None:
                running[pool.submit(_tried, work, following[1])] = following[0]
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                name = running.pop(future)
                yield name, future.result()
    finally:
        processes = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        if running:
            for process in processes:
                process.kill()


def _end_with_parent() -> None:
    """Ends this worker when its parent process ends, and leaves Ctrl-C to the parent."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
