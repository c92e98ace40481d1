"""The page as one HTML file that needs no network."""

from importlib import resources
from pathlib import Path

from ..discovery import Discovery
from ..errors import ModelError
from ._html import Markup, join, tag
from ._sections import body


def write_report(story: Discovery, path: str | Path) -> Path:
    """Writes a discovery as one self-contained HTML page.

    **Arguments:**

    - `story`: the result of `jaxid.discover`.
    - `path`: the file to write; its folder must exist.

    **Returns:** the path.

    **Raises:** `ModelError` if the folder does not exist.
    """
    path = Path(path)
    if not path.resolve().parent.is_dir():
        raise ModelError(f"there is no folder {path.parent} to write {path.name} into: create it")
    path.write_text(page(story), encoding="utf-8")
    return path


def page(story: Discovery) -> str:
    """The page as text."""
    from plotly.offline import get_plotlyjs

    meta = (
        Markup('<meta charset="utf-8">'),
        Markup('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Markup('<meta name="color-scheme" content="light dark">'),
        # The page fetches nothing from the network, even if a figure or browser extension tries to.
        Markup(
            '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
            "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:\">"
        ),
    )
    head = tag(
        "head",
        *meta,
        tag("title", f"{story.loop.name}: {story.sentence}"),
        tag("style", Markup(_part("page.css"))),
    )
    without = tag("noscript", tag("p", "The figures need JavaScript.", class_="note"))
    # The browser does not run plain text; the page's script runs it before the first figure.
    library = tag("script", Markup(get_plotlyjs()), type="text/plain", data_library="")
    script = tag("script", Markup(_part("page.js")))
    content = tag("body", tag("main", without, body(story)), library, script)
    return f"<!doctype html>\n{tag('html', join(head, content), lang='en')}\n"


def _part(name: str) -> str:
    return (resources.files("jaxid.report") / name).read_text(encoding="utf-8")
