"""How a command ends: on a user's mistake with one sentence, on Ctrl-C at once."""

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

# What shells give for a command that Ctrl-C ended.
INTERRUPTED = 130
UNDETERMINED = 3


@contextlib.contextmanager
def sentences(on_interrupt: Callable[[], str] = str) -> Iterator[None]:
    """Ends on a user's error with its one sentence and on Ctrl-C with a message, no traceback.

    **Arguments:**

    - `on_interrupt`: saves what is to be saved then, and gives what else to say.
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
    # The line of jaxid's source that warned says nothing to someone at a prompt.
    said = str(message) if issubclass(category, JaxidWarning) else f"{category.__name__}: {message}"
    typer.echo(f"jaxid: {said}", err=True)


# What an interrupt does and says beside that it was one; a command in progress sets it.
_farewell: list[Callable[[], str] | None] = [str]
_parting = threading.Lock()


def _part() -> None:
    """Says that it was an interrupt, once, whichever thread comes first; the other waits for it."""
    with _parting:
        farewell, _farewell[0] = _farewell[0], None
        if farewell is not None:
            typer.echo(f"\njaxid: interrupted{farewell()}", err=True)


def leave_on_interrupt() -> None:
    """Ends the process a second after Ctrl-C if the main thread has not: it may be compiling.

    Python's own handler waits for the compiler to return, which takes up to a minute. Files are
    written under another name first, so that none is left half done.
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
    # A compilation may be on its way in a thread of XLA's; taking the interpreter down under it
    # makes it abort.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(INTERRUPTED)
