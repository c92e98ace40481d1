"""The command `jaxid`: its help, its subcommands, its entry point."""

import contextlib
import os
from importlib import metadata

import typer

from .discovering import Spread, demo, discover
from .ending import INTERRUPTED, leave, leave_on_interrupt
from .fitting import compare, fit
from .fleets import discover_all
from .inspecting import diagnose, inspect

ABOUT = """Identify robot arms from closed-loop recordings, and find the effect the model lacks.

\b
Examples:
  jaxid demo
  jaxid fit run_1.csv run_2.csv --robot scara --json fit.json
  jaxid inspect run_1.csv --write log.toml
  jaxid compare held_out.csv --robot scara --fit fit.json --plot compare.html
  jaxid discover run_1.csv run_2.csv --validate held_out.csv --robot arm.urdf --report story.html

\b
Exit codes:
  0    success
  1    a fit did not converge or does not describe the recordings, or a robot of discover-all
       failed; the results are still written
  2    an input cannot be used; one line on stderr explains what to do
  3    the verdict of a discovery is undetermined; its result is still printed and written
  130  interrupted by Ctrl-C

Colours and progress are shown on a terminal only; NO_COLOR turns colours off.
"""

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> bool:
    if asked:
        typer.echo(f"jaxid {metadata.version('jaxid-robotics')}")
        raise typer.Exit
    return asked


@app.callback(help=ABOUT)
def common(
    version: bool = typer.Option(
        False, "--version", callback=_show_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Options of the command itself."""


# The help lists the commands in this order.
app.command()(inspect)
app.command()(fit)
app.command()(compare)
app.command()(diagnose)
app.command(cls=Spread)(discover)
app.command()(discover_all)
app.command()(demo)


def _use_processor() -> None:
    """Computes on the CPU also if JAX has another backend, unless `JAX_PLATFORMS` chooses one.

    A simulation is a sequence of small steps, which take many times as long on a GPU.
    """
    import jax

    if not os.environ.get("JAX_PLATFORMS"):
        # The variable is for processes that this one starts; JAX here has already read it.
        os.environ["JAX_PLATFORMS"] = "cpu"
        jax.config.update("jax_platforms", "cpu")


def main() -> None:
    """Entry point of the `jaxid` command."""
    leave_on_interrupt()
    _use_processor()
    # Without a writable home folder, compiled programs are not kept.
    with contextlib.suppress(OSError, RuntimeError):
        from ..compiling import keep_programs

        keep_programs()
    try:
        app()
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            leave()
        raise
