"""Options shared by several commands."""

from pathlib import Path
from typing import Annotated, Literal

import typer

Files = Annotated[
    list[Path],
    typer.Argument(
        help="Recordings: .csv, .tsv, .txt (also .gz), .parquet, .mat, .npz, .h5, a bag of ROS 2, "
        "or a LeRobot dataset (FOLDER/episode_3 for one episode)."
    ),
]
Robot = Annotated[
    str | None,
    typer.Option(
        help="FILE.urdf (FILE.urdf:near, :physical or :free also estimates its bodies), "
        "FILE.py:NAME of a loop of your own, scara, two-link or emps; required."
    ),
]
Json = Annotated[Path | None, typer.Option("--json", help="Also write the result here.")]
Column = Annotated[
    list[str] | None,
    typer.Option(
        "--column", help="Signal=columns of the file, such as q=pos_1,pos_2; once for each signal."
    ),
]
Unit = Annotated[
    list[str] | None,
    typer.Option(
        "--unit",
        help="Unit of a signal if it is not SI, such as q=deg, or one per joint: q=deg,mm.",
    ),
]
Log = Annotated[
    Path | None,
    typer.Option(
        "--log",
        help="TOML file of columns, units and scales, as written by jaxid inspect --write.",
    ),
]
# If neither is given, the file of --log decides.
Gaps = Annotated[
    Literal["refuse", "allow"] | None,
    typer.Option(help="What to do if a recording has gaps in time; they are refused by default."),
]
Clock = Annotated[
    Literal["recorded", "even"] | None,
    typer.Option(help="Times as recorded (default), or evenly spaced if a logger's times jitter."),
]
DropNan = Annotated[
    bool, typer.Option("--drop-nan", help="Leave out samples at which a signal is empty.")
]
METHODS = "oem, pem, idim, idim-iv, didim, integral, filtered, fourier or difference."
Controller = Annotated[
    str | None,
    typer.Option(help="tracking (the real law is unknown) or open-loop (recorded torque)."),
]
Window = Annotated[float | None, typer.Option(help="Simulate pieces of this length separately, s.")]
Report = Annotated[
    Path | None, typer.Option(help="Write the story to this self-contained HTML file.")
]
Catalogue = Annotated[
    list[str] | None,
    typer.Option(help="FILE.py:NAME of your own effect, examined in addition to the known ones."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress; the result in one line.")]
