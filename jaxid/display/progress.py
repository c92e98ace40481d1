"""A line on the terminal while something works."""

import contextlib
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def working(title: str, show: bool = True) -> Iterator[Callable[..., None]]:
    """Gives a function that replaces the line's text; silent where stderr is no terminal.

    The function takes the text and, where it is known, the share that is done, 0 to 1. The line
    shows how long it has been as well.

    **Arguments:**

    - `title`: before every text.
    - `show`: False to stay silent everywhere.
    """
    if not show:
        yield silent
        return
    # Here, since most of a short command's life goes into imports.
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield silent
        return
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description}")
    columns = (SpinnerColumn(), TimeElapsedColumn(), BarColumn(16), text)
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(title, total=None)

        def say(text: str, share: float | None = None) -> None:
            known = None if share is None else 1.0
            progress.update(task, description=f"{title}: {text}", completed=share or 0.0)
            # `update` takes None for what is not to change; the bar pulses where the total is None.
            progress.tasks[0].total = known

        yield say


def silent(text: str, share: float | None = None) -> None:
    """Says nothing."""
