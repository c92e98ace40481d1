"""Progress with the time left: lines on a terminal, one line in a notebook."""

import contextlib
import html
import json
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

# Updates per second, in a notebook and on a terminal.
_RATE = 4
_BAR = 16


class Line:
    """The state of a running task: the current activity, the time elapsed and the time left.

    **Arguments:**

    - `title`: title of the task.
    """

    def __init__(self, title: str) -> None:
        self.title, self.text = title, ""
        self.began = time.perf_counter()
        self.share: float | None = None
        self._ends: float | None = None

    def say(self, text: str, share: float | None = None, left: float | None = None) -> None:
        """Sets the current activity, the share that is done, 0 to 1, and the time left, s.

        If the share is given, the time left follows from it. It counts down until it is set again.
        """
        self.text, self.share, now = text, share, time.perf_counter()
        if share:
            left = (now - self.began) * (1 - share) / share
        if left is not None:
            self._ends = now + left

    def head(self) -> str:
        """The time elapsed, the title, and the time left if it is known."""
        now = time.perf_counter()
        said = f"{clock(now - self.began)}  {self.title}"
        if self._ends is not None and self._ends > now:
            said += f", about {clock(self._ends - now)} left"
        return said

    def lines(self, width: int) -> list[str]:
        """The whole text in lines of a given width; long text is wrapped, not truncated."""
        head = textwrap.wrap(self.head(), width)
        if self.share is not None and len(head[-1]) + _BAR + 2 <= width:
            done = round(_BAR * min(max(self.share, 0.0), 1.0))
            head[-1] += f"  {'━' * done}{'╌' * (_BAR - done)}"
        said = textwrap.wrap(self.text, max(width - 2, 1))
        return [*head, *(f"  {line}" for line in said)]

    def __rich_console__(self, console: Any, options: Any) -> Iterator[Any]:
        from rich.text import Text

        # One column less, since some terminals wrap at the last column.
        yield Text("\n".join(self.lines(options.max_width - 1)))


class Pace:
    """Measures the durations of pieces of work by kind and predicts the time left from them.

    **Arguments:**

    - `course`: kinds of the expected pieces, in order.
    """

    def __init__(self, course: Sequence[str], now: Callable[[], float] = time.perf_counter) -> None:
        self._ahead, self._now = list(course), now
        self._took: dict[str, list[float]] = {}
        self._at: tuple[str, float] | None = None

    def begin(self, kind: str, then: Sequence[str] | None = None) -> float | None:
        """Begins a piece and ends the last one; returns the time left in s, None if unknown.

        **Arguments:**

        - `then`: kinds expected after it, if they have changed.
        """
        if self._at is not None:
            last, began = self._at
            self._took.setdefault(last, []).append(self._now() - began)
        self._at = kind, self._now()
        if then is not None:
            self._ahead = list(then)
        elif kind in self._ahead:
            self._ahead = self._ahead[self._ahead.index(kind) + 1 :]
        if not self._took:
            return None
        return sum(map(self._usual, [kind, *self._ahead]))

    def _usual(self, kind: str) -> float:
        """Mean duration of the pieces of a kind; for a new kind, of all pieces."""
        took = self._took.get(kind) or [x for of in self._took.values() for x in of]
        return sum(took) / len(took)


@contextlib.contextmanager
def working(title: str, show: bool = True) -> Iterator[Callable[..., None]]:
    """Gives a function that replaces the text; silent without a terminal or a notebook.

    The function takes the text and, if they are known, the share that is done, 0 to 1, and
    `left`, the time left in s. The time elapsed is shown as well.

    **Arguments:**

    - `title`: shown before every text.
    - `show`: False to stay silent everywhere.
    """
    if not show:
        yield silent
        return
    line = Line(title)
    handle = notebook_output()
    if handle is not None:
        yield from _in_notebook(line, handle)
        return
    # Imported here, because imports take most of the time of a short command.
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield silent
        return
    from rich.live import Live

    with Live(line, console=console, transient=True, refresh_per_second=_RATE):
        yield line.say


def _in_notebook(line: Line, handle: Any) -> Iterator[Callable[..., None]]:
    shown = 0.0

    def say(text: str, share: float | None = None, left: float | None = None) -> None:
        nonlocal shown
        line.say(text, share, left)
        if time.perf_counter() > shown + 1 / _RATE:
            shown = time.perf_counter()
            handle.update(_html(line), raw=True)

    try:
        yield say
    finally:
        # A finished task needs no line; a display cannot be removed, only emptied.
        handle.update({"text/html": "", "text/plain": ""}, raw=True)


def _html(line: Line) -> dict[str, str]:
    bar = "" if line.share is None else f'<progress value="{line.share:.3f}"></progress> '
    said = f"{html.escape(line.head())}<br>{bar}{html.escape(line.text)}"
    style = "font-variant-numeric:tabular-nums;opacity:.8"
    return {
        "text/html": f'<div style="{style}">{said}</div>',
        "text/plain": "\n".join(line.lines(80)),
    }


def live_figure(show: bool = True) -> Callable[[Callable[[], Any]], None]:
    """Gives a function that draws a figure in a notebook; each figure replaces the last one.

    It takes a function that makes the figure; outside a notebook, that function is not called.

    **Arguments:**

    - `show`: False to draw nothing.
    """
    handles: list[Any] = []

    def draw(make: Callable[[], Any]) -> None:
        if not show or not in_notebook():
            return
        if not handles:
            handles.append(notebook_output())
        content = {"application/vnd.plotly.v1+json": json.loads(make().to_json())}
        # JupyterLab does not redraw a figure that is replaced directly by another one.
        handles[0].update({"text/plain": ""}, raw=True)
        handles[0].update({**content, "text/plain": "a figure"}, raw=True)

    return draw


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    # IPython is already imported in a process that it runs.
    if "IPython" not in sys.modules:
        return False
    from IPython.core.getipython import get_ipython  # type: ignore[import-not-found]

    return hasattr(get_ipython(), "kernel")


def notebook_output() -> Any:
    """A display in a notebook's output that can be updated; None outside a notebook."""
    if not in_notebook():
        return None
    from IPython.display import display  # type: ignore[import-not-found]

    return display({"text/plain": ""}, raw=True, display_id=True)


def clock(seconds: float) -> str:
    """A duration as minutes and seconds, or hours."""
    whole = round(max(seconds, 0.0))
    hours, rest = divmod(whole, 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def silent(text: str, share: float | None = None, left: float | None = None) -> None:
    """Shows nothing."""
