"""The command `discover-all`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import ModelError, near
from .ending import sentences
from .files import ReadOptions, check_outputs, write_json
from .models import load_robot, with_controller
from .options import Controller, Json, Quiet

# Columns of the table; the first three are required.
_COLUMNS = ("name", "robot", "fit", "validate", "log")


def discover_all(
    table: Annotated[
        Path,
        typer.Argument(
            help="CSV with a row per robot: name, robot (as --robot), fit and validate (files, "
            "separated by blanks), log (as --log); the last two may be empty or left out."
        ),
    ],
    json_file: Json = None,
    csv: Annotated[Path | None, typer.Option(help="Write the table of results here.")] = None,
    resume: Annotated[
        Path | None, typer.Option(help="Keep each result in this folder, and continue from there.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(help="Robots at a time; by default the number of cores.")
    ] = None,
    worth: Annotated[
        float, typer.Option(help="Leave out effects below this share of each joint's torque, %.")
    ] = 0.05,
    controller: Controller = None,
    quiet: Quiet = False,
) -> None:
    """Find what the models of many robots lack, and show them in one table.

    File names are relative to the folder of the table. If a robot fails, the others are still
    examined, and the reason is shown.

    \b
    Examples:
      jaxid discover-all fleet.csv --csv found.csv --resume steps
      jaxid discover-all fleet.csv --jobs 8 --json found.json

    The exit code is 0, 1 if a robot failed, 2 if an input cannot be used.
    """
    from ..discovery import discover_all as run_all

    with sentences():
        check_outputs(json_file, csv)
        problems, failed = _problems(table, controller)
        found = run_all(problems, jobs=jobs, resume=resume, worth=worth, progress=not quiet)
        found.failed.update(failed)
        typer.echo(repr(found))
        write_json(json_file, found.to_dict())
        if csv is not None:
            found.table().to_csv(csv)
        for robot, reason in found.failed.items():
            typer.echo(f"jaxid: {robot}: {reason}", err=True)
        if found.failed:
            raise typer.Exit(1)


def _problems(table: Path, controller: str | None) -> tuple[dict[str, Any], dict[str, str]]:
    """The robots of a table that can be read, and the reasons why others cannot."""
    import pandas as pd

    from ..discovery import FleetRobot
    from ..errors import JaxidError

    try:
        rows = pd.read_csv(table, dtype=str, keep_default_na=False, skipinitialspace=True)
    except (OSError, ValueError) as error:
        raise ModelError(f"{table} cannot be read as a table ({error}): give a CSV") from error
    for column in rows.columns:
        if column not in _COLUMNS:
            raise ModelError(
                f"{table} has an unknown column {column!r}{near(column, _COLUMNS)}: the columns "
                f"are {', '.join(_COLUMNS)}"
            )
    absent = [c for c in _COLUMNS[:3] if c not in rows.columns]
    if absent:
        raise ModelError(f"{table} has no column {absent[0]!r}: give {', '.join(_COLUMNS)}")
    names = rows["name"].tolist()
    twice = [name for k, name in enumerate(names) if name in names[:k]]
    if twice:
        raise ModelError(f"{table} names the robot {twice[0]!r} twice: give each its own name")
    problems, failed = {}, {}
    for row in rows.to_dict("records"):
        try:
            problems[row["name"]] = FleetRobot(*_given(row, table.parent, controller))
        except JaxidError as error:
            failed[row["name"]] = str(error)
    return problems, failed


def _given(row: dict[str, str], folder: Path, controller: str | None) -> tuple[Any, Any, Any]:
    """Model, recordings and held-out recordings of a row."""
    robot = row["robot"]
    robot = str(folder / robot) if Path(robot.partition(":")[0]).suffix else robot
    log = folder / row["log"] if row.get("log") else None
    reading = ReadOptions(log=log)
    fitted, unseen = (
        [folder / name for name in row.get(kind, "").split()] for kind in ("fit", "validate")
    )
    loop = with_controller(load_robot(robot), controller)
    return loop, reading.fitted(fitted), reading(unseen) if unseen else None
