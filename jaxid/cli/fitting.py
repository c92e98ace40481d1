"""The commands `fit` and `compare`."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import ModelError
from .ending import sentences
from .files import ReadOptions, check_outputs, write_json
from .models import load_effect, load_robot, saved_model, with_controller
from .options import (
    METHODS,
    Clock,
    Column,
    Controller,
    DropNan,
    Files,
    Gaps,
    Json,
    Log,
    Quiet,
    Robot,
    Unit,
    Window,
)
from .showing import pooled


def fit(
    files: Files,
    robot: Robot = None,
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = None,
    clock: Clock = None,
    drop_nan: DropNan = False,
    controller: Controller = None,
    method: Annotated[str, typer.Option(help=METHODS)] = "oem",
    window: Window = None,
    quiet: Quiet = False,
) -> None:
    """Estimate the physical parameters of a robot from recordings.

    \b
    Examples:
      jaxid fit run_1.csv run_2.csv --robot scara --json fit.json
      jaxid fit run.mat --robot emps --method idim
      jaxid fit run.csv --robot my_robot.py:loop --column q=pos_a,pos_b --unit q=deg

    The exit code is 0; 1 if the fit did not converge or leaves more than 30 % of a joint; 2 if an
    input cannot be used.
    """
    from .. import estimate

    with sentences():
        check_outputs(json_file)
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
            raise ModelError(f"--method {method} does not simulate windows: leave out --window")
        loop = with_controller(load_robot(robot), controller)
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        found = estimate.fit(loop, reading.fitted(files), methods[method]())
        typer.echo(repr(found).partition("\n")[0] if quiet else repr(found))
        write_json(json_file, found.to_dict())
        if not found.succeeded or found.mistake or estimate.doubtful_joints(found):
            raise typer.Exit(1)


def compare(
    files: Files,
    robot: Robot = None,
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = None,
    clock: Clock = None,
    drop_nan: DropNan = False,
    controller: Controller = None,
    values: Annotated[
        Path | None,
        typer.Option(
            "--fit",
            help="Values written by `jaxid fit --json`, or a model written by `discover --save`.",
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Write the figure to this HTML file.")] = None,
    catalogue: Annotated[
        list[str] | None, typer.Option(help="FILE.py:NAME of your own effects in a saved model.")
    ] = None,
    window: Window = None,
    quiet: Quiet = False,
) -> None:
    """Compare a model with recordings: relative errors, and a figure.

    \b
    Examples:
      jaxid compare held_out.csv --robot scara --fit fit.json --plot compare.html
      jaxid compare new.csv --fit story.jaxid
      jaxid compare run.csv --robot my_robot.py:loop --json errors.json

    The exit code is 0, or 2 if an input cannot be used.
    """
    from ..discovery import compare as run_compare

    with sentences():
        check_outputs(json_file, plot)
        own = frozenset(e for e in map(load_effect, catalogue or ()) if isinstance(e, type))
        loop = saved_model(robot, values, own)
        loop = with_controller(loop, controller)
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        result = run_compare(loop, reading(files), window=window)
        errors = ", ".join(f"{name} {x:.3f} %" for name, x in pooled(result).items())
        typer.echo(f"{result.loop.name}: {errors}" if quiet else repr(result))
        write_json(json_file, result.to_dict())
        if plot is not None:
            result.plot().write_html(plot, include_plotlyjs=True)
