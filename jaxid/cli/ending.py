"""How commands end: with one sentence after a user error, immediately after Ctrl-C."""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import typer

from ..errors import JaxidError, JaxidWarning

# Exit code that shells use for a command ended by Ctrl-C.
INTERRUPTED = 130
UNDETERMINED = 3


@contextlib.contextmanager
def sentences(on_interrupt: Callable[[], str] = str) -> Iterator[None]:
    """Ends a command with one sentence after a user error or Ctrl-C, without a traceback.

    **Arguments:**

    - `on_interrupt`: saves results after an interrupt and returns the rest of the message.
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
    # The source line of a warning does not help users of the command line.
    said = str(message) if issubclass(category, JaxidWarning) else f"{category.__name__}: {message}"
    typer.echo(f"jaxid: {said}", err=True)


# Further action and message on an interrupt; set by the running command.
_farewell: list[Callable[[], str] | None] = [str]
_parting = threading.Lock()


def _part() -> None:
    """Reports the interrupt once, from the first thread that calls; the other thread waits."""
    with _parting:
        farewell, _farewell[0] = _farewell[0], None
        if farewell is not None:
            typer.echo(f"\njaxid: interrupted{farewell()}", err=True)


def leave_on_interrupt() -> None:
    """Ends the process a second after Ctrl-C if the main thread does not, such as in a compilation.

    Python's own handler waits for the compiler to return, which takes up to a minute. Files are
    written under another name first, so that no incomplete file remains.
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
        leave()

    threading.Thread(target=watch, daemon=True).start()


def leave() -> None:
    # A compilation may be running in an XLA thread; it aborts if the interpreter shuts down
    # normally.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(INTERRUPTED)
