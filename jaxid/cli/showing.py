"""Output of commands in addition to the text of a result."""

import os
import sys
from typing import Any

import typer


def say(text: str, **style: Any) -> None:
    """Prints a line, in colour if the terminal supports it and the user wants it."""
    plain = "NO_COLOR" in os.environ or not sys.stdout.isatty()
    typer.echo(text if plain else typer.style(text, **style))


def pooled(result: Any) -> dict[str, float]:
    """Relative error of each joint over all recordings together, %."""
    return ((result.error_percent**2).mean() ** 0.5).to_dict()


def tell(story: Any, quiet: bool = False) -> None:
    """Prints a discovery: its verdict, and all of it unless `quiet`."""
    verdict, _, rest = repr(story).partition("\n\n")
    colour = "green" if story.verdict in ("adequate", "explained") else "yellow"
    if quiet:
        say(f"{story.verdict}: {story.sentence}", bold=True, fg=colour)
    else:
        say(verdict, bold=True, fg=colour)
        typer.echo(f"\n{rest}")


LEGEND = """
relative error: norm of measured minus simulated torque, divided by the norm of
                the measured torque
fitted:         on recordings that were used in the fit
held out:       on a recording that was not
noise floor:    the error that a perfect model would leave
±:              one standard deviation"""


def error_falls(story: Any) -> None:
    """Prints one bar per step: held-out error of the joint that the starting model fits worst."""
    table = story.table()
    if len(table) < 2:
        return
    held = table[[name for name in table.columns if name.startswith("held out")]]
    worst = str(held.iloc[0].idxmax())
    error = held[worst]
    typer.echo(f"\nerror on the held-out recording ({worst.removeprefix('held out, ')}):")
    width = max(len(str(step)) for step in error.index)
    for step, value in error.items():
        bar = "█" * max(1, round(30 * value / error.max()))
        typer.echo(f"  {step!s:<{width}}  {bar} {value:.2f} %")
