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
        help="FILE.urdf, FILE.py:NAME of a loop of your own, scara, two-link or emps; required."
    ),
]
Json = Annotated[Path | None, typer.Option("--json", help="Also write the result here.")]
Column = Annotated[
    list[str] | None,
    typer.Option("--column", help="Our name=theirs, as q=pos_1,pos_2; once for each signal."),
]
Unit = Annotated[
    list[str] | None,
    typer.Option(
        "--unit", help="Unit of a signal that is not SI, as q=deg, or one per joint: q=deg,mm."
    ),
]
Log = Annotated[
    Path | None,
    typer.Option(
        "--log", help="Columns, units, scales in a TOML file, as of jaxid inspect --write."
    ),
]
# None where nothing is said: then the file of --log decides.
Gaps = Annotated[
    Literal["refuse", "allow"] | None,
    typer.Option(help="Missing stretches of time in a recording; refused by default."),
]
Clock = Annotated[
    Literal["recorded", "even"] | None,
    typer.Option(help="Times as recorded, by default, or even where those of a logger jitter."),
]
DropNan = Annotated[
    bool, typer.Option("--drop-nan", help="Leave out samples at which a signal is empty.")
]
METHODS = "oem, pem, idim, idim-iv, didim, integral, filtered, fourier or difference."
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
