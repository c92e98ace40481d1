"""A line on the terminal while something works."""

import contextlib
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def working(title: str, show: bool = True) -> Iterator[Callable[[str], None]]:
    """Gives a function that replaces the line's text; silent where stderr is no terminal.

    **Arguments:**

    - `title`: before every text.
    - `show`: False to stay silent everywhere.
    """
    if not show:
        yield lambda text: None
        return
    # Here, since most of a command's short life goes into imports.
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: None
        return
    with console.status(title) as status:
        yield lambda text: status.update(f"{title}: {text}")
