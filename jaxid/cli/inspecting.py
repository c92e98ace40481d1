"""The commands `inspect` and `diagnose`."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import RecordingError
from .ending import sentences
from .files import ReadOptions, check_outputs, described, write_json
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

# What logs call the signals, numbers and underscores aside; the first that is there is meant.
_CALLED = {
    "time": ("time", "t", "stamp", "timestamp", "time_s", "time_ms", "sec", "ms"),
    "q": ("q", "pos", "position", "angle", "theta", "joint_pos", "joint_position", "actual_q"),
    "tau": ("tau", "torque", "effort", "trq", "force", "i", "current", "cur", "actual_current"),
    "v": ("dq", "qd", "qp", "vel", "velocity", "speed", "omega", "joint_vel", "actual_qd"),
    "q_ref": ("q_ref", "qref", "qr", "ref", "des", "q_des", "target", "target_q", "goal", "cmd"),
}


def inspect(
    files: Files,
    json_file: Json = None,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = "allow",
    clock: Clock = "recorded",
    drop_nan: DropNan = False,
    write: Annotated[
        Path | None,
        typer.Option(help="Write columns and units to this TOML file, to be edited: for --log."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the recordings to this HTML file.")
    ] = None,
) -> None:
    """Show what is in recordings: columns, rates, gaps, ranges, rests, encoder steps, repeats.

    \b
    Examples:
      jaxid inspect run_1.csv run_2.csv
      jaxid inspect run_1.csv --write log.toml
      jaxid inspect run_1.csv --log log.toml --plot run_1.html

    The exit code is 0, or 2 where the files cannot be used as they are described.
    """
    from ..recording import columns_of
    from ..signals.inspection import inspect as look

    with sentences():
        check_outputs(json_file, write, plot)
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        guessed: dict[str, Any] = {}
        try:
            recordings = reading(files)
        except RecordingError as error:
            names = columns_of(files[0])
            guessed = guess(names)
            if column is not None or log is not None or not guessed:
                raise
            typer.echo(f"columns of {files[0].name}: {', '.join(names)}")
            typer.echo(f"not read as they are: {error}")
            told = [f"{k}={v if isinstance(v, str) else ','.join(v)}" for k, v in guessed.items()]
            typer.echo(f"taken for now: {'  '.join(told)}")
            recordings = ReadOptions(told, unit, log, gaps, clock, drop_nan)(files)
        found = look(recordings)
        typer.echo(repr(found))
        write_json(json_file, found.to_dict())
        if write is not None:
            write.write_text(description(reading, guessed, recordings.joints), encoding="utf-8")
            typer.echo(f"{write} describes these files: check it, then use --log {write}")
        if plot is not None:
            plot.write_text(_drawn(recordings), encoding="utf-8")


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


def guess(names: Sequence[str]) -> dict[str, Any]:
    """Which columns a log's names may mean; empty where a signal that is needed is not found."""
    stems: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        match = re.fullmatch(r"(.*?)[_.\[ ]*(\d*)\]?", name.strip().lower())
        assert match is not None
        stems.setdefault(match[1], []).append((int(match[2] or 0), name))
    found: dict[str, Any] = {}
    for signal, words in _CALLED.items():
        word = next((w for w in words if w in stems), None)
        if word is not None:
            numbered = [name for _, name in sorted(stems.pop(word))]
            found[signal] = numbered[0] if signal == "time" else numbered
    joints = len(found.get("q", ()))
    if "time" not in found or not joints or len(found.get("tau", ())) != joints:
        return {}
    return {k: v for k, v in found.items() if k == "time" or len(v) == joints}


def description(reading: ReadOptions, guessed: dict[str, Any], joints: int) -> str:
    """A TOML file that says how these files are read, with what else may be said in it."""
    told = {} if reading.log is None else described(reading.log)
    columns = told.get("columns", {}) | guessed
    if not columns:
        columns = {"time": "time"} | {
            signal: [f"{signal}_{j}" for j in range(1, joints + 1)] for signal in ("q", "tau")
        }
    units = {"time": "s", "q": ["rad"] * joints, "tau": ["Nm"] * joints} | told.get("units", {})
    lines = [
        "# How jaxid reads these logs: jaxid discover FILES --log THIS.toml",
        "# Torque of the joint's side of the gear; current times torque constant times gear ratio",
        '# is "current_1*0.062*100".',
        f"gaps = {json.dumps(reading.gaps)}  # or refuse: missing stretches of time",
        f"clock = {json.dumps(reading.clock)}  # or even: where a logger's times jitter",
        "",
        "[columns]",
        *(f"{name} = {json.dumps(value)}" for name, value in columns.items()),
        "",
        "[units]  # rad, deg, turn, m, mm; Nm, mNm, N; s, ms, us",
        *(f"{name} = {json.dumps(value)}" for name, value in units.items()),
    ]
    return "\n".join(lines) + "\n"


def diagnose(
    files: Files,
    robot: Robot = None,
    json_file: Json = None,
    catalogue: Catalogue = None,
    column: Column = None,
    unit: Unit = None,
    log: Log = None,
    gaps: Gaps = "refuse",
    clock: Clock = "recorded",
    drop_nan: DropNan = False,
    controller: Controller = None,
    quiet: Quiet = False,
) -> None:
    """Rank what the fitted model may lack, without refitting: quicker than discover, and rougher.

    \b
    Example:
      jaxid diagnose run_1.csv run_2.csv --robot arm.urdf

    The exit code is 0, 1 where the fit did not converge, 2 where something given cannot be used.
    """
    from ..discovery import diagnose as run_diagnose
    from ..effects import catalogue as known
    from ..estimate import OEM, fit

    with sentences():
        check_outputs(json_file)
        loop = with_controller(load_robot(robot), controller)
        own = [load_effect(given) for given in catalogue or ()]
        reading = ReadOptions(column, unit, log, gaps, clock, drop_nan)
        fitted = fit(loop, reading(files), OEM(progress=not quiet))
        found = run_diagnose(fitted, catalogue=(*known, *own), progress=not quiet)
        typer.echo(repr(found).partition("\n")[0] if quiet else f"{fitted!r}\n\n{found!r}")
        write_json(json_file, {"fit": fitted.to_dict(), **found.to_dict()})
        if not fitted.succeeded:
            raise typer.Exit(1)
