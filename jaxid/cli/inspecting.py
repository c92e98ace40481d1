"""The commands `inspect` and `diagnose`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import RecordingError
from .describing import description, guess, guess_units, on_torque, taken
from .ending import sentences
from .files import ReadOptions, check_outputs, write_json
from .models import load_effect, load_robot, with_controller
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
    Robot,
    Unit,
)


def inspect(
    files: Files,
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = None,
    clock: Clock = None,
    drop_nan: DropNan = False,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Write columns, units and scales to this TOML file; edit it, then use --log."
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the recordings to this HTML file.")
    ] = None,
) -> None:
    """Show what is in recordings: topics, columns, rates, gaps, ranges, encoder steps, the law's
    clock, repeats.

    \b
    Examples:
      jaxid inspect run_1.csv run_2.csv
      jaxid inspect run_1.csv --write log.toml
      jaxid inspect bag_folder --log log.toml --plot run_1.html

    The exit code is 0, or 2 if the files cannot be read as described.
    """
    from ..recording import contents_of
    from ..signals.inspection import inspect as look

    with sentences():
        check_outputs(json_file, write, plot)
        # What is to be looked at is read with its gaps, unless that is refused.
        gaps = gaps or "allow"
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        found = contents_of(files[0], **_named(reading))
        for line in found.about or (", ".join(found.columns),):
            typer.echo(f"{files[0].name}: {line}")
        try:
            recordings = reading(files)
        except RecordingError as error:
            guessed = guess(found.columns)
            if column is not None or log is not None or not guessed:
                raise
            typer.echo(f"not readable without options: {error}")
            units = (unit or []) + _pairs(guess_units(guessed, unit or []))
            reading = ReadOptions(_pairs(guessed), units, log, gaps, clock, drop_nan)
            typer.echo(f"assumed: {'  '.join(_pairs(guessed) + units)}")
            recordings = reading(files)
            found = contents_of(files[0], **_named(reading))
        if found.joints:
            typer.echo(taken(found))
        inspected = look(recordings)
        typer.echo(repr(inspected))
        if remark := on_torque(found.signals.get("tau", [])):
            typer.echo(remark)
        write_json(json_file, inspected.to_dict())
        if write is not None:
            told = reading.told()
            if not inspected.signals["gaps"].to_numpy().any():
                told["gaps"] = "refuse"
            text = description(told, found, recordings.joints)
            write.write_text(text, encoding="utf-8")
            typer.echo(f"{write} describes these files: check it, then use --log {write}")
        if plot is not None:
            plot.write_text(_drawn(recordings), encoding="utf-8")


def _named(reading: ReadOptions) -> dict[str, Any]:
    """The options for columns and joints."""
    return {key: value for key, value in reading.told().items() if key in ("columns", "joints")}


def _pairs(named: Mapping[str, Any]) -> list[str]:
    """The values in the form of command-line options."""
    return [f"{k}={v if isinstance(v, str) else ','.join(v)}" for k, v in named.items()]


def _drawn(recordings: Any) -> str:
    """A page with a figure for each recording: positions, references and torques."""
    from ..display.figures.along_time import signals
    from ..display.figures.panels import Trace

    parts = []
    for k, r in enumerate(recordings):
        panels, titles = [], []
        for j in range(r.joints):
            panel = [Trace("position", r.q[:, j], "rad or m", "measured")]
            if r.q_ref is not None:
                panel.append(Trace("reference", r.q_ref[:, j], "rad or m", "reference"))
            panels += [panel, [Trace("torque", r.tau[:, j], "N·m or N", "measured")]]
            titles += [f"position {j + 1}", f"torque {j + 1}"]
        figure = signals(r.time, panels, titles=titles, title=r.name)
        parts.append(figure.to_html(full_html=False, include_plotlyjs=k == 0))
    return f"<!doctype html><meta charset=utf-8><title>recordings</title>{''.join(parts)}"


def diagnose(
    files: Files,
    robot: Robot = None,
    json_file: Json = None,
    catalogue: Catalogue = None,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = None,
    clock: Clock = None,
    drop_nan: DropNan = False,
    controller: Controller = None,
    quiet: Quiet = False,
) -> None:
    """Rank effects that the model may lack, from one fit: faster than discover, less accurate.

    \b
    Example:
      jaxid diagnose run_1.csv run_2.csv --robot arm.urdf

    The exit code is 0, 1 if the fit did not converge, 2 if an input cannot be used.
    """
    from ..discovery import diagnose as run_diagnose
    from ..effects import catalogue as known
    from ..estimate import OEM, fit

    with sentences():
        check_outputs(json_file)
        loop = with_controller(load_robot(robot), controller)
        own = [load_effect(given) for given in catalogue or ()]
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        fitted = fit(loop, reading.fitted(files), OEM(progress=not quiet))
        found = run_diagnose(fitted, catalogue=(*known, *own), progress=not quiet)
        typer.echo(repr(found).partition("\n")[0] if quiet else f"{fitted!r}\n\n{found!r}")
        write_json(json_file, {"fit": fitted.to_dict(), **found.to_dict()})
        if not fitted.succeeded:
            raise typer.Exit(1)
