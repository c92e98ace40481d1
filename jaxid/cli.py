"""The command line: `jaxid demo`, `fit`, `compare`, `discover`."""

import contextlib
import importlib.util
import itertools
import json
import math
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from .errors import JaxidError, JaxidWarning, ModelError, RecordingError

ABOUT = """Identify robot arms from closed-loop recordings, and find the effect the model lacks.

\b
Examples:
  jaxid demo
  jaxid fit run_1.csv run_2.csv --robot scara --json fit.json
  jaxid compare held_out.csv --fit fit.json --plot compare.html
  jaxid discover run_1.csv run_2.csv --validate held_out.csv --report story.html

\b
Exit codes:
  0    it is done, whatever the verdict
  1    a fit that did not converge; its result is printed and written all the same
  2    something given cannot be used; the one line on stderr says what to do
  130  interrupted by Ctrl-C

Colours and progress are shown on a terminal only; NO_COLOR turns colours off.
"""

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help=ABOUT,
)

# What shells give for a command that Ctrl-C ended.
INTERRUPTED = 130

Files = Annotated[
    list[Path],
    typer.Argument(help="Recordings: .csv, .tsv, .txt, .parquet, .mat or .npz, also .gz."),
]
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
_METHODS = "oem, pem, idim, idim-iv, didim, integral, filtered, fourier or difference."
Controller = Annotated[
    str | None,
    typer.Option(help="tracking (the real law is unknown) or open-loop (recorded torque)."),
]
Window = Annotated[
    float | None, typer.Option(help="Simulate pieces of this length on their own, s.")
]
Report = Annotated[
    Path | None, typer.Option(help="Write the story to this HTML file, which needs no network.")
]
Catalogue = Annotated[
    list[str] | None,
    typer.Option(help="FILE.py:NAME of an effect of your own, asked beside the known ones."),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress, and the result in a line.")
]


def load_robot(robot: str) -> Any:
    """A loop by the name of a ready robot, or from a Python file.

    **Arguments:**

    - `robot`: `scara`, `two-link`, `emps`, or `path/to/file.py:name` of a loop, or of a function
      without arguments that gives one.

    **Raises:** `ModelError` that says what was not found.
    """
    from . import robots
    from .simulation.loop import ClosedLoop

    ready = {"scara": robots.scara, "two-link": robots.two_link, "emps": robots.emps}
    if robot in ready:
        return ready[robot]()
    path, _, name = robot.rpartition(":")
    if not path.endswith(".py"):
        raise ModelError(
            f"there is no robot {robot!r}: choose {', '.join(ready)}, or give FILE.py:NAME"
        )
    made = getattr(_module(path), name, None)
    try:
        made = made() if callable(made) and not isinstance(made, ClosedLoop) else made
    except Exception as error:
        raise ModelError(
            f"{name}() in {path} fails ({error!r}): give a function without arguments that "
            "returns a ClosedLoop"
        ) from error
    if not isinstance(made, ClosedLoop):
        raise ModelError(f"{path} has no ClosedLoop called {name!r}: name the one it defines")
    return made


def load_effect(given: str) -> Any:
    """An effect's class from a Python file, or whatever else a catalogue may hold.

    **Arguments:**

    - `given`: `path/to/file.py:Name`.

    **Raises:** `ModelError` that says what was not found.
    """
    path, _, name = given.rpartition(":")
    if not path.endswith(".py"):
        raise ModelError(f"--catalogue {given!r} names no effect: give FILE.py:NAME of its class")
    module = _module(path)
    if not hasattr(module, name):
        raise ModelError(f"{path} has no effect called {name!r}: name the class it defines")
    return getattr(module, name)


def _module(path: str) -> Any:
    """A user's Python file, imported."""
    if not Path(path).is_file():
        raise ModelError(f"there is no file {path}: give the path of your own Python file")
    known = sys.modules.get(Path(path).stem)
    if known is not None and getattr(known, "__file__", None) == path:
        return known
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(Path(path).resolve().parent))
    # Annotations that are strings are looked up in the module that they were written in.
    sys.modules.setdefault(spec.name, module)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ModelError(f"{path} fails when it is imported ({error!r}): mend it first") from error
    return module


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
        text = json.dumps(_plain(content), indent=1, ensure_ascii=False, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """The same with null for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _check_outputs(*paths: Path | None) -> None:
    """Says before the work, not after it, that a result would have nowhere to go."""
    for path in paths:
        if path is not None and not path.resolve().parent.is_dir():
            raise ModelError(f"there is no folder {path.parent} for {path.name}: make it first")
        if path is not None and path.is_dir():
            raise ModelError(f"{path} is a folder: name a file in it")


def _say(text: str, **style: Any) -> None:
    """Prints a line, in colour where the terminal has it and the user wants it."""
    plain = "NO_COLOR" in os.environ or not sys.stdout.isatty()
    typer.echo(text if plain else typer.style(text, **style))


@contextlib.contextmanager
def _sentences(on_interrupt: Callable[[], str] = str) -> Iterator[None]:
    """Ends on a user's error with its one sentence and on Ctrl-C with a message, no traceback.

    **Arguments:**

    - `on_interrupt`: saves what is to be saved then, and gives what else to say.
    """
    _farewell[0] = on_interrupt
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            yield
        except (JaxidError, OSError) as error:
            typer.echo(f"jaxid: {error}", err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            _part()
            raise typer.Exit(INTERRUPTED) from None


def _show_warning(message: Warning | str, category: type[Warning], *where: Any) -> None:
    # The line of jaxid's source that warned says nothing to someone at a prompt.
    said = str(message) if issubclass(category, JaxidWarning) else f"{category.__name__}: {message}"
    typer.echo(f"jaxid: {said}", err=True)


@app.command()
def fit(
    files: Files,
    robot: Robot = "scara",
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    controller: Controller = None,
    method: Annotated[str, typer.Option(help=_METHODS)] = "oem",
    window: Window = None,
    quiet: Quiet = False,
) -> None:
    """Estimate the physical parameters of a robot from recordings.

    \b
    Examples:
      jaxid fit run_1.csv run_2.csv --robot scara --json fit.json
      jaxid fit run.mat --robot emps --method idim
      jaxid fit run.csv --robot my_robot.py:loop --column q=pos_a,pos_b --unit q=deg

    The exit code is 0, 1 where the fit did not converge, 2 where something given cannot be used.
    """
    from . import estimate

    with _sentences():
        _check_outputs(json_file)
        oem = estimate.OEM(window=window, progress=not quiet)
        methods = {
            "oem": lambda: oem,
            "pem": lambda: estimate.SeparablePEM(oem),
            "idim": estimate.IDIM,
            "idim-iv": estimate.IDIMIV,
            "didim": estimate.DIDIM,
            "integral": estimate.IntegralLS,
            "filtered": estimate.FilteredLS,
            "fourier": estimate.FourierLS,
            "difference": estimate.DifferenceLS,
        }
        if method not in methods:
            raise ModelError(f"there is no method {method!r}: choose {', '.join(methods)}")
        if window is not None and method not in ("oem", "pem"):
            raise ModelError(f"--method {method} simulates nothing in windows: leave out --window")
        loop = _with_controller(load_robot(robot), controller)
        found = estimate.fit(loop, _read(files, column, unit), methods[method]())
        typer.echo(repr(found).partition("\n")[0] if quiet else repr(found))
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
        Path | None,
        typer.Option(
            "--fit",
            help="Values that `jaxid fit --json` wrote, or a model that `discover --save` did.",
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Write the figure to this HTML file.")] = None,
    catalogue: Annotated[
        list[str] | None, typer.Option(help="FILE.py:NAME of your own effects in a saved model.")
    ] = None,
    window: Window = None,
    quiet: Quiet = False,
) -> None:
    """Hold a model against recordings: relative errors, and a figure.

    \b
    Examples:
      jaxid compare held_out.csv --fit fit.json --plot compare.html
      jaxid compare new.csv --fit story.jaxid
      jaxid compare run.csv --robot my_robot.py:loop --json errors.json

    The exit code is 0, or 2 where something given cannot be used.
    """
    from .discovery import compare as run_compare

    with _sentences():
        _check_outputs(json_file, plot)
        loop = load_robot(robot)
        if values is not None:
            own = frozenset(e for e in map(load_effect, catalogue or ()) if isinstance(e, type))
            loop = _with_fitted(loop, values, own)
        loop = _with_controller(loop, controller)
        result = run_compare(loop, _read(files, column, unit), window=window)
        errors = ", ".join(f"{name} {x:.3f} %" for name, x in _pooled(result).items())
        typer.echo(f"{result.loop.name}: {errors}" if quiet else repr(result))
        _write(json_file, result.to_dict())
        if plot is not None:
            result.plot().write_html(plot, include_plotlyjs=True)


def _pooled(result: Any) -> dict[str, float]:
    """Relative error of each joint over all recordings together, %."""
    return ((result.error_percent**2).mean() ** 0.5).to_dict()


def _with_fitted(loop: Any, path: Path, own: frozenset[type] = frozenset()) -> Any:
    if path.suffix == ".jaxid":
        from .storage.archive import classes_of
        from .storage.saved import load

        saved = load(path, classes_of(loop) | own)
        if not hasattr(saved, "loop"):
            raise ModelError(f"{path} holds no model: give a saved fit or story")
        return saved.loop
    try:
        parameters = json.loads(path.read_text(encoding="utf-8"))["parameters"]
        found = {name: float(entry["value"]) for name, entry in parameters.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelError(
            f"{path} holds no fitted parameters ({error!r}): give a file that "
            "`jaxid fit --json` or `jaxid discover --save` wrote"
        ) from error
    return loop.with_values(**found)


class _Spread(TyperCommand):
    """A command in which `--validate` takes every file up to the next option.

    Only after the files to fit: in `--validate a.csv b.csv` with none before, the second is one
    of those.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Writes `--validate` before each of its files, which is how one option takes several."""
        valued = {name for p in self.params for name in p.opts if not getattr(p, "is_flag", True)}
        return super().parse_args(ctx, spread(args, "--validate", valued))


def spread(args: list[str], option: str, valued: set[str]) -> list[str]:
    """Arguments in which an option that was given several values is repeated for each.

    **Arguments:**

    - `option`: the one that may take several.
    - `valued`: options that take one value.
    """
    out: list[str] = []
    fitted = taking = False
    rest = iter(args)
    for word in rest:
        if word == "--":
            return [*out, word, *rest]
        if word.startswith("-") and word != "-":
            name, equals, _ = word.partition("=")
            taking = name == option and fitted
            out.append(word)
            if name in valued and not equals:
                out.extend(value for value in [next(rest, None)] if value is not None)
        elif taking:
            out += [option, word]
        else:
            fitted = True
            out.append(word)
    return out


@app.command(cls=_Spread)
def discover(
    files: Files,
    validate: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings held out of the fit, to judge by: one or several."),
    ] = None,
    robot: Robot = "scara",
    json_file: Json = None,
    report: Report = None,
    resume: Annotated[
        Path | None, typer.Option(help="Save each step in this folder, and go on from there.")
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(help="Write story and model to this file (story.jaxid), for compare --fit."),
    ] = None,
    catalogue: Catalogue = None,
    column: Column = None,
    unit: Unit = None,
    controller: Controller = None,
    quiet: Quiet = False,
) -> None:
    """Find the physical effect that the model lacks, and add it.

    The exit code is 0 whatever the verdict, 2 where something given cannot be used. Ctrl-C keeps
    the steps so far in the folder of --resume, or else in jaxid-steps, and says how to go on.

    \b
    Examples:
      jaxid discover fit_1.csv fit_2.csv --validate held_out.csv
      jaxid discover run_*.csv --validate held_1.csv held_2.csv --robot my_robot.py:loop \\
            --unit q=deg --json story.json --report story.html --resume steps
      jaxid discover run_*.csv --catalogue my_effects.py:Hose --save story.jaxid
    """
    from .discovery import discover as run_discover
    from .effects import catalogue as known

    journal = _Kept(resume)
    # The folder outlives the interrupt, whose farewell takes the steps out of it.
    with journal, _sentences(journal.farewell):
        _check_outputs(json_file, report, save)
        loop = _with_controller(load_robot(robot), controller)
        own = [load_effect(given) for given in catalogue or ()]
        held_out = list(validate or [])
        _check_apart(files, held_out)
        story = run_discover(
            loop,
            _read(files, column, unit),
            validate=_read(held_out, column, unit) if held_out else None,
            catalogue=(*known, *own),
            resume=journal.path,
            progress=not quiet,
        )
        _tell(story, quiet)
        _write(json_file, story.to_dict())
        if save is not None:
            story.save(save)
        if report is not None:
            story.report(report)


class _Kept:
    """Where the steps of a discovery are saved: the user's folder, or one an interrupt keeps."""

    def __init__(self, resume: Path | None) -> None:
        self.own = Path(tempfile.mkdtemp(prefix="jaxid-")) if resume is None else None
        self.path = resume or Path(str(self.own)) / "steps"

    def __enter__(self) -> "_Kept":
        return self

    def __exit__(self, *_: object) -> None:
        if self.own is not None:
            # What an interrupt wants kept has been moved out of here by its farewell.
            shutil.rmtree(self.own, ignore_errors=True)

    def farewell(self) -> str:
        """What is said after an interrupt: what was done, and how to go on from there."""
        done = len(list(self.path.glob("*.piece")))
        if not done:
            return " before the first step was done; nothing is saved"
        path = self.path
        if self.own is not None:
            path = next(p for p in _names("jaxid-steps") if not p.exists())
            shutil.move(self.path, path)
        said = f" with {done} step{'s' if done > 1 else ''} done"
        return f"{said}; the same command with --resume {path} goes on from there"


def _names(name: str) -> Iterator[Path]:
    """The name, then the same with a number."""
    path = Path(name)
    yield path
    for k in itertools.count(2):
        yield path.with_stem(f"{path.stem}-{k}")


def _check_apart(files: list[Path], held_out: list[Path]) -> None:
    both = {path.resolve() for path in files} & {path.resolve() for path in held_out}
    if both:
        raise RecordingError(
            f"{min(both).name} is both to be fitted and held out: what judges a model must not "
            "have made it"
        )


def _tell(story: Any, quiet: bool = False) -> None:
    verdict, _, rest = repr(story).partition("\n")
    colour = "yellow" if story.verdict == "outside_catalogue" else "green"
    _say(verdict, bold=True, fg=colour)
    if not quiet:
        typer.echo(rest)


@app.command()
def demo(
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """The story on bundled recordings: a model that suffices, and one that lacks an effect.

    Takes about a minute, most of it to compile. With --report, the second story as a page.

    \b
    Example:
      jaxid demo --report story.html
    """
    from .discovery import discover as run_discover
    from .recording import read

    with _sentences():
        _check_outputs(report)
        for kind, says in (
            ("clean", "1. Recordings of a SCARA that the model describes"),
            ("hidden", "2. The same arm with a physical effect that the model lacks"),
        ):
            with resources.as_file(resources.files("jaxid") / "demo" / kind) as path:
                used = read(path / "fit_1.csv", path / "fit_2.csv")
                unseen = read(path / "held_out.csv")
            _say(f"\n{says}", bold=True)
            story = run_discover(load_robot("scara"), used, validate=unseen, progress=not quiet)
            _tell(story, quiet)
            if not quiet:
                _error_falls(story)
        if not quiet:
            typer.echo(LEGEND)
        if report is not None:
            story.report(report)
        if not quiet:
            typer.echo("\nThe same as a page with figures: jaxid demo --report story.html")
            typer.echo("On your own recordings: jaxid discover --help")


LEGEND = """
relative error: norm of measured less simulated torque, over norm of measured torque
fit, held out:  recordings that were fitted, and one that no fit has seen
noise floor:    the error that a perfect model would leave
±:              one standard deviation"""


def _error_falls(story: Any) -> None:
    """A bar a step: held-out error of the joint at which the starting model did worst."""
    table = story.table()
    if len(table) < 2:
        return
    held = table[[name for name in table.columns if name.startswith("held out")]]
    worst = str(held.iloc[0].idxmax())
    error = held[worst]
    typer.echo(f"\nerror on the recording that no fit saw ({worst.removeprefix('held out, ')}):")
    width = max(len(str(step)) for step in error.index)
    for step, value in error.items():
        bar = "█" * max(1, round(30 * value / error.max()))
        typer.echo(f"  {step!s:<{width}}  {bar} {value:.2f} %")


def _keep_programs() -> None:
    """Keeps compiled programs between runs: compiling is most of what a user waits for."""
    import jax

    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    jax.config.update("jax_compilation_cache_dir", str(Path(base) / "jaxid"))
    # The small ones too: a fit has dozens, and each takes longer to compile than to read.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


# What an interrupt does and says beside that it was one; a command in progress sets it.
_farewell: list[Callable[[], str] | None] = [str]
_parting = threading.Lock()


def _part() -> None:
    """Says that it was an interrupt, once, whichever thread comes first; the other waits for it."""
    with _parting:
        farewell, _farewell[0] = _farewell[0], None
        if farewell is not None:
            typer.echo(f"\njaxid: interrupted{farewell()}", err=True)


def _leave_on_interrupt() -> None:
    """Ends the process a second after Ctrl-C if the main thread has not: it may be compiling.

    Python's own handler waits for the compiler to return, which takes up to a minute. Files are
    written under another name first, so that none is left half done.
    """
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        while signal.SIGINT not in ours.recv(64):
            pass
        time.sleep(1.0)
        _part()
        theirs.close()
        _leave()

    threading.Thread(target=watch, daemon=True).start()


def _leave() -> None:
    # A compilation may be on its way in a thread of XLA's; taking the interpreter down under it
    # makes it abort.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(INTERRUPTED)


def main() -> None:
    """Entry point of the `jaxid` command."""
    _leave_on_interrupt()
    # Where there is no home or it cannot be written, each run compiles for itself.
    with contextlib.suppress(OSError, RuntimeError):
        _keep_programs()
    try:
        app()
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            _leave()
        raise
