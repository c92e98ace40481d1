"""The command line: `jaxid demo`, `fit`, `compare`."""

import contextlib
import importlib.util
import json
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import typer

from .errors import JaxidError, ModelError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Identify robot arms from closed-loop recordings, and find the effect the model lacks.",
)

Files = Annotated[list[Path], typer.Argument(help="Recordings: .csv, .parquet, .mat or .npz.")]
Robot = Annotated[
    str, typer.Option(help="scara, two-link, emps, or FILE.py:NAME for a loop of your own.")
]
Json = Annotated[Path | None, typer.Option("--json", help="Also write the result here.")]
Column = Annotated[
    list[str] | None,
    typer.Option("--column", help="Our name=theirs, as q=pos_1,pos_2; once for each signal."),
]
Unit = Annotated[
    list[str] | None, typer.Option("--unit", help="Unit of a signal that is not SI, as q=deg.")
]
Controller = Annotated[
    str | None,
    typer.Option(help="tracking (the real law is unknown) or open-loop (recorded torque)."),
]


def load_robot(robot: str) -> Any:
    """A loop by the name of a ready robot, or from a Python file.

    **Arguments:**

    - `robot`: `scara`, `two-link`, `emps`, or `path/to/file.py:name` of a loop, or of a function
      without arguments that gives one.

    **Raises:** `ModelError` that says what was not found.
    """
    from . import robots
    from .loop import ClosedLoop

    ready = {"scara": robots.scara, "two-link": robots.two_link, "emps": robots.emps}
    if robot in ready:
        return ready[robot]()
    path, _, name = robot.rpartition(":")
    if not path.endswith(".py"):
        raise ModelError(
            f"there is no robot {robot!r}: choose {', '.join(ready)}, or give FILE.py:NAME"
        )
    if not Path(path).is_file():
        raise ModelError(f"there is no file {path}: give the path of your robot's Python file")
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(Path(path).resolve().parent))
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ModelError(f"{path} fails when it is imported ({error!r}): mend it first") from error
    made = getattr(module, name, None)
    made = made() if callable(made) and not isinstance(made, ClosedLoop) else made
    if not isinstance(made, ClosedLoop):
        raise ModelError(f"{path} has no ClosedLoop called {name!r}: name the one it defines")
    return made


def _with_controller(loop: Any, controller: str | None) -> Any:
    import dataclasses

    from .control import OpenLoop, Tracking

    if controller is None:
        return loop
    laws = {"tracking": Tracking, "open-loop": OpenLoop}
    if controller not in laws:
        raise ModelError(f"there is no controller {controller!r}: choose {', '.join(laws)}")
    return dataclasses.replace(loop, controller=laws[controller]())


def _pairs(given: list[str] | None, what: str) -> dict[str, str] | None:
    if not given:
        return None
    pairs = {}
    for item in given:
        name, equals, value = item.partition("=")
        if not equals:
            raise ModelError(f"--{what} {item!r} has no '=': write for instance q=pos_1,pos_2")
        pairs[name.strip()] = value.strip()
    return pairs


def _read(files: list[Path], column: list[str] | None, unit: list[str] | None) -> Any:
    from .recording import read

    named = _pairs(column, "column")
    columns = {k: v if k == "time" else v.split(",") for k, v in named.items()} if named else None
    return read(*files, columns=columns, units=_pairs(unit, "unit"))


def _write(path: Path | None, content: dict[str, Any]) -> None:
    if path is not None:
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


@contextlib.contextmanager
def _sentences() -> Iterator[None]:
    """Ends on an error of jaxid's own with its one sentence, and without a traceback."""
    try:
        yield
    except JaxidError as error:
        typer.echo(f"jaxid: {error}", err=True)
        raise typer.Exit(2) from None
    except OSError as error:
        typer.echo(f"jaxid: {error}", err=True)
        raise typer.Exit(2) from None


@app.command()
def fit(
    files: Files,
    robot: Robot = "scara",
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    controller: Controller = None,
    method: Annotated[str, typer.Option(help="oem, idim, idim-iv or didim.")] = "oem",
    window: Annotated[
        float | None, typer.Option(help="Simulate pieces of this length on their own, s.")
    ] = None,
) -> None:
    """Estimate the physical parameters of a robot from recordings.

    Example: jaxid fit run_1.csv run_2.csv --robot scara --json fit.json
    """
    from . import estimate

    with _sentences():
        methods = {
            "oem": lambda: estimate.OEM(window=window),
            "idim": estimate.IDIM,
            "idim-iv": estimate.IDIMIV,
            "didim": estimate.DIDIM,
        }
        if method not in methods:
            raise ModelError(f"there is no method {method!r}: choose {', '.join(methods)}")
        loop = _with_controller(load_robot(robot), controller)
        found = estimate.fit(loop, _read(files, column, unit), methods[method]())
        typer.echo(repr(found))
        _write(json_file, found.to_dict())
        if not found.succeeded:
            raise typer.Exit(1)


@app.command()
def compare(
    files: Files,
    robot: Robot = "scara",
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    controller: Controller = None,
    values: Annotated[
        Path | None, typer.Option("--fit", help="Values from a file that `jaxid fit --json` wrote.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Write the figure to this HTML file.")] = None,
    window: Annotated[
        float | None, typer.Option(help="Simulate pieces of this length on their own, s.")
    ] = None,
) -> None:
    """Hold a model against recordings: relative errors, and a figure.

    Example: jaxid compare held_out.csv --fit fit.json --plot compare.html
    """
    from .discovery import compare as run_compare

    with _sentences():
        loop = _with_controller(load_robot(robot), controller)
        if values is not None:
            loop = _with_fitted(loop, values)
        result = run_compare(loop, _read(files, column, unit), window=window)
        typer.echo(repr(result))
        _write(json_file, result.to_dict())
        if plot is not None:
            result.plot().write_html(plot, include_plotlyjs=True)


def _with_fitted(loop: Any, path: Path) -> Any:
    try:
        parameters = json.loads(path.read_text(encoding="utf-8"))["parameters"]
        found = {name: float(entry["value"]) for name, entry in parameters.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(
            f"{path} holds no fitted parameters ({error!r}): give a file that "
            "`jaxid fit --json` wrote"
        ) from error
    return loop.with_values(**found)


@app.command()
def demo() -> None:
    """The story on bundled recordings: a model that fits, and one that lacks an effect."""
    from .discovery import compare as run_compare
    from .estimate import fit as run_fit
    from .recording import read

    with _sentences():
        for kind, says in (
            ("clean", "1. Recordings of a SCARA that the model describes"),
            ("hidden", "2. The same arm with a physical effect that the model lacks"),
        ):
            folder = resources.files("jaxid") / "demo" / kind
            with resources.as_file(folder) as path:
                used = read(path / "fit_1.csv", path / "fit_2.csv")
                unseen = read(path / "held_out.csv")
            typer.echo(f"\n{says}\n{'-' * len(says)}")
            found = run_fit(load_robot("scara"), used)
            typer.echo(repr(found))
            typer.echo("\non a recording the fit never saw:")
            typer.echo(repr(run_compare(found, unseen)))


def main() -> None:
    """Entry point of the `jaxid` command."""
    app()
