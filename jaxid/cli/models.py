"""Models given to a command by name, by file, or as the output of another command."""

import importlib.util
import json
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import MissingClassError, ModelError


def load_robot(robot: str | None) -> Any:
    """A loop from the name of a predefined robot or from a Python file.

    **Arguments:**

    - `robot`: `scara`, `two-link`, `emps`, a URDF file, if wanted with `:near` or `:free` as the
      `bodies` of `jaxid.serial`, or `path/to/file.py:name` of a loop, or of a function without
      arguments that returns one; None if the user gave none.

    **Raises:** `ModelError` if there is no such robot or its file cannot be used.
    """
    from .. import robots
    from ..simulation.loop import ClosedLoop

    ready = {"scara": robots.scara, "two-link": robots.two_link, "emps": robots.emps}
    if robot is None:
        raise ModelError(
            "no robot is given: use --robot FILE.urdf, --robot FILE.py:NAME of a loop of your "
            f"own, or one of {', '.join(ready)}"
        )
    if robot in ready:
        return ready[robot]()
    path, _, name = robot.rpartition(":")
    if robot.lower().endswith(".urdf"):
        return robots.serial(robot)
    if path.lower().endswith(".urdf"):
        return robots.serial(path, bodies=name)
    if robot.endswith(".py"):
        names = _named(_module(robot), ClosedLoop) or "NAME"
        raise ModelError(f"{robot} is named without its loop: give --robot {robot}:{names}")
    if not path.endswith(".py"):
        raise ModelError(
            f"there is no robot {robot!r}: choose {', '.join(ready)}, or give FILE.urdf or "
            "FILE.py:NAME"
        )
    module = _module(path)
    made = getattr(module, name, None)
    try:
        made = made() if callable(made) and not isinstance(made, ClosedLoop) else made
    except Exception as error:
        raise ModelError(
            f"{name}() in {path} fails ({_where(path, error)}): give a function without arguments "
            "that returns a ClosedLoop"
        ) from error
    if not isinstance(made, ClosedLoop):
        raise ModelError(
            f"{path} has no ClosedLoop called {name!r}: name one that it defines, "
            f"{_named(module, ClosedLoop) or 'of which it has none'}"
        )
    return made


def _named(module: Any, kind: type) -> str:
    """The names that a module has for objects of a kind."""
    return " or ".join(name for name, value in vars(module).items() if isinstance(value, kind))


def _where(path: str, error: BaseException) -> str:
    """The line of a file from which an error came, and what it says."""
    if isinstance(error, SyntaxError):
        return f"line {error.lineno}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if _same(frame.filename, path)]
    at = f"line {lines[-1]}: " if lines else ""
    return f"{at}{type(error).__name__}: {error}"


def _same(one: str | None, other: str) -> bool:
    """Whether two paths name one file."""
    return one is not None and Path(one).resolve() == Path(other).resolve()


def load_effect(given: str) -> Any:
    """An effect class, or any other entry of a catalogue, from a Python file.

    **Arguments:**

    - `given`: `path/to/file.py:Name`.

    **Raises:** `ModelError` if there is no such class or its file cannot be used.
    """
    path, _, name = given.rpartition(":")
    if not path.endswith(".py"):
        raise ModelError(
            f"--catalogue {given!r} does not name an effect: give FILE.py:NAME of its class"
        )
    module = _module(path)
    if not hasattr(module, name):
        raise ModelError(f"{path} has no effect called {name!r}: name the class it defines")
    return getattr(module, name)


def _module(path: str) -> Any:
    """A user's Python file, imported."""
    if not Path(path).is_file():
        raise ModelError(f"there is no file {path}: give the path of your own Python file")
    known, stamp = sys.modules.get(Path(path).stem), Path(path).stat().st_mtime_ns
    mine = _same(getattr(known, "__file__", None), path)
    # A file that is loaded again must give the same classes, unless it has changed in between.
    if mine and getattr(known, "_read_at", None) == stamp:
        return known
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(Path(path).resolve().parent))
    module._read_at = stamp  # type: ignore[attr-defined]
    # Annotations given as strings are resolved in the module that defines them.
    if known is None or mine:
        sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ModelError(
            f"{path} fails when it is imported ({_where(path, error)}): correct it first"
        ) from error
    return module


def with_controller(loop: Any, controller: str | None) -> Any:
    """The loop with the control law of `--controller`; its own law if none is named."""
    import dataclasses

    from ..control import OpenLoop, Tracking

    if controller is None:
        return loop
    laws = {"tracking": Tracking, "open-loop": OpenLoop}
    if controller not in laws:
        raise ModelError(f"there is no controller {controller!r}: choose {', '.join(laws)}")
    return dataclasses.replace(loop, controller=laws[controller]())


def saved_model(robot: str | None, path: Path | None, own: frozenset[type] = frozenset()) -> Any:
    """The robot with values from the JSON of an earlier command, or a model that was saved.

    **Arguments:**

    - `robot`: as for `load_robot`; a saved model needs it only if it uses the robot's classes.
    - `path`: the written file; None for the unchanged robot.
    - `own`: further classes of the user.
    """
    if path is None:
        return load_robot(robot)
    if path.suffix == ".jaxid":
        from ..storage.classes import classes_of
        from ..storage.saved import load

        theirs = frozenset() if robot is None else classes_of(load_robot(robot))
        try:
            saved = load(path, theirs | own)
        except MissingClassError as error:
            # The remedy of the message is for Python.
            raise ModelError(
                f"{path} has an object of your class {error.name}: name its file, --robot "
                "FILE.py:NAME, or --catalogue FILE.py:NAME for an effect"
            ) from error
        if not hasattr(saved, "loop"):
            raise ModelError(f"{path} contains no model: give a saved fit or story")
        return saved.loop
    loop = load_robot(robot)
    try:
        parameters = json.loads(path.read_text(encoding="utf-8"))["parameters"]
        found = {name: float(entry["value"]) for name, entry in parameters.items()}
    except FileNotFoundError as error:
        raise ModelError(
            f"there is no file {path}: give one that `jaxid fit --json` or `jaxid discover --save` "
            "wrote"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(
            f"{path} contains no fitted parameters ({error!r}): give a file that "
            "`jaxid fit --json` or `jaxid discover --save` wrote"
        ) from error
    names = {name for p in loop.parameters for name in p.names}
    strange = [name for name in found if name not in names]
    if strange:
        raise ModelError(
            f"{path} has {strange[0]}, which {loop.name} has not: it is of another robot, so name "
            "that with --robot"
        )
    return loop.with_values(**found)


def without(catalogue: Sequence[Any], names: Sequence[str]) -> list[Any]:
    """The catalogue without the effects of the given names.

    **Raises:** `ModelError` for a name that is not in the catalogue.
    """
    known = {entry.effect_name() for entry in catalogue}
    unknown = sorted(set(names) - known)
    if unknown:
        raise ModelError(
            f"the catalogue has no effect {unknown[0]!r} to leave out: it has "
            f"{', '.join(sorted(known))}"
        )
    return [entry for entry in catalogue if entry.effect_name() not in names]
