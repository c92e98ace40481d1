"""The commands `discover` and `demo`."""

import itertools
import shutil
import tempfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from ..errors import RecordingError
from .ending import UNDETERMINED, sentences
from .files import ReadOptions, check_outputs, write_json
from .models import load_effect, load_robot, with_controller, without
from .options import (
    Catalogue,
    Clock,
    Column,
    Controller,
    DropNan,
    Files,
    Gaps,
    Json,
    Log,
    Quiet,
    Report,
    Robot,
    Unit,
)
from .showing import LEGEND, error_falls, say, tell


class Spread(TyperCommand):
    """A command in which `--validate` takes every file up to the next option.

    This holds only after the files to fit: in `--validate a.csv b.csv` with no file before, the
    second file is one to fit.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Inserts `--validate` before each of its files, so that the option takes several."""
        valued = {name for p in self.params for name in p.opts if not getattr(p, "is_flag", True)}
        return super().parse_args(ctx, spread(args, "--validate", valued))


def spread(args: list[str], option: str, valued: set[str]) -> list[str]:
    """Arguments in which an option that was given several values is repeated for each.

    **Arguments:**

    - `option`: the option that may take several values.
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


def discover(
    files: Files,
    validate: Annotated[
        list[Path] | None,
        typer.Option(help="Held-out recordings that test the model: one or several."),
    ] = None,
    robot: Robot = None,
    json_file: Json = None,
    report: Report = None,
    resume: Annotated[
        Path | None, typer.Option(help="Save each step in this folder, and continue from it.")
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(help="Write story and model to this file (story.jaxid), for compare --fit."),
    ] = None,
    catalogue: Catalogue = None,
    exclude: Annotated[
        list[str] | None,
        typer.Option(help="An effect of the catalogue to leave out, such as stribeck."),
    ] = None,
    worth: Annotated[
        float, typer.Option(help="Leave out effects below this share of each joint's torque, %.")
    ] = 0.05,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = None,
    clock: Clock = None,
    drop_nan: DropNan = False,
    controller: Controller = None,
    quiet: Quiet = False,
) -> None:
    """Find the physical effect that the model lacks, and add it.

    The exit code is 0 for a verdict, 3 if the verdict is undetermined, 2 if an input cannot be
    used. Ctrl-C keeps the steps so far in the folder of --resume, or in jaxid-steps without it;
    a message explains how to continue.

    \b
    Examples:
      jaxid discover fit_1.csv fit_2.csv --validate held_out.csv --robot arm.urdf
      jaxid discover run_*.csv --validate held_1.csv held_2.csv --robot my_robot.py:loop \\
            --unit q=deg --json story.json --report story.html --resume steps
      jaxid discover run_*.csv --robot arm.urdf --catalogue my_effects.py:Hose --save story.jaxid
    """
    from ..discovery import discover as run_discover
    from ..effects import catalogue as known
    from ..report import write_report

    journal = _Kept(resume)
    # After an interrupt `farewell` moves the steps out of the folder, which must exist until then.
    with journal, sentences(journal.farewell):
        check_outputs(json_file, report, save)
        loop = with_controller(load_robot(robot), controller)
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        own = [load_effect(given) for given in catalogue or ()]
        held_out = list(validate or [])
        _check_apart(files, held_out)
        story = run_discover(
            loop,
            reading.fitted(files),
            validate=reading(held_out) if held_out else None,
            catalogue=(*without(known, exclude or ()), *own),
            worth=worth,
            resume=journal.path,
            progress=not quiet,
        )
        tell(story, quiet)
        write_json(json_file, story.to_dict())
        if save is not None:
            story.save(save)
        if report is not None:
            write_report(story, report)
        if story.interrupted:
            raise KeyboardInterrupt
    if story.verdict == "undetermined":
        raise typer.Exit(UNDETERMINED)


class _Kept:
    """Folder for the steps of a discovery: the user's, or a temporary one kept on interrupt."""

    def __init__(self, resume: Path | None) -> None:
        self.own = Path(tempfile.mkdtemp(prefix="jaxid-")) if resume is None else None
        self.path = resume or Path(str(self.own)) / "steps"

    def __enter__(self) -> "_Kept":
        return self

    def __exit__(self, *_: object) -> None:
        if self.own is not None:
            # After an interrupt, `farewell` has already moved the steps out of this folder.
            shutil.rmtree(self.own, ignore_errors=True)

    def farewell(self) -> str:
        """The message after an interrupt: what was done, and how to continue."""
        done = len(list(self.path.glob("*.piece")))
        if not done:
            return " before the first step was done; nothing is saved"
        path = self.path
        if self.own is not None:
            path = next(p for p in _names("jaxid-steps") if not p.exists())
            shutil.move(self.path, path)
        said = f" with {done} step{'s' if done > 1 else ''} done"
        return f"{said}; to continue, repeat the command with --resume {path}"


def _names(name: str) -> Iterator[Path]:
    """The name, then the same name with increasing numbers."""
    path = Path(name)
    yield path
    for k in itertools.count(2):
        yield path.with_stem(f"{path.stem}-{k}")


def _check_apart(files: list[Path], held_out: list[Path]) -> None:
    both = {path.resolve() for path in files} & {path.resolve() for path in held_out}
    if both:
        raise RecordingError(
            f"{min(both).name} is both fitted and held out: a model must be tested on recordings "
            "to which it was not fitted"
        )


def demo(
    report: Report = None,
    quiet: Quiet = False,
) -> None:
    """Run discover on bundled recordings: with a complete model, and with one that lacks an effect.

    Takes about a minute, mostly for compilation. --report writes the second result as a page.

    \b
    Example:
      jaxid demo --report story.html
    """
    from ..discovery import discover as run_discover
    from ..recording import read
    from ..report import write_report

    with sentences():
        check_outputs(report)
        for kind, says in (
            ("clean", "1. Recordings of a SCARA that the model describes"),
            ("hidden", "2. The same arm with a physical effect that the model lacks"),
        ):
            with resources.as_file(resources.files("jaxid") / "demo" / kind) as path:
                used = read(path / "fit_1.csv", path / "fit_2.csv")
                unseen = read(path / "held_out.csv")
            say(f"\n{says}", bold=True)
            story = run_discover(load_robot("scara"), used, validate=unseen, progress=not quiet)
            tell(story, quiet)
            if not quiet:
                error_falls(story)
        if not quiet:
            typer.echo(LEGEND)
        if report is not None:
            write_report(story, report)
        if not quiet:
            typer.echo("\nThe same as a page with figures: jaxid demo --report story.html")
            typer.echo("On your own recordings: jaxid discover --help")
