"""Files and columns named to do harm, through `jaxid discover --report` in a real browser."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from test_discover_cli import HIDDEN, told
from typer.testing import CliRunner

from jaxid.cli import app

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

# What one worker has compiled serves all of them.
pytestmark = [pytest.mark.xdist_group("demo"), pytest.mark.slow]

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
FILES = {
    "fit_1": "<script>alert(1)<&script>.csv",
    "fit_2": '"><img src=x onerror=alert(2)>.csv',
    "held_out": "$(touch hit);`touch hit`&& touch hit|.csv",
}
COLUMNS = {
    "q_1": "<script>alert(3)<!--",
    "tau_1": "javascript:alert(4)//'\"><svg onload=alert(5)>",
    "q_2": "$(touch hit)",
    "tau_2": "; touch hit #",
}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the hidden set under hostile names, written where `hit` would be."""
    # The programs are the same; compiled by the other tests of this group, they are there.
    told()
    folder = tmp_path_factory.mktemp("hostile")
    for plain, name in zip(HIDDEN, FILES.values(), strict=True):
        pd.read_csv(plain).rename(columns=COLUMNS).to_csv(folder / name, index=False)
    first, second, held = (str(folder / name) for name in FILES.values())
    named = [
        "time=time",
        f"q={COLUMNS['q_1']},{COLUMNS['q_2']}",
        f"tau={COLUMNS['tau_1']},{COLUMNS['tau_2']}",
        "q_ref=q_ref_1,q_ref_2",
    ]
    command = ["discover", first, second, "--validate", held, "--quiet"]
    for column in named:
        command += ["--column", column]
    command += ["--report", str(folder / "story.html"), "--json", str(folder / "<b>story.json")]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.startswith("explained: ")
    return folder / "story.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """The system's chromium, headless; skips where there is none."""
    found = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield running
        running.close()


def test_hostile_names_are_text_and_nothing_else(page: Path, browser: Any) -> None:
    window = browser.new_page()
    heard: list[str] = []
    window.on("dialog", lambda dialog: (heard.append(dialog.message), dialog.dismiss()))
    window.on("pageerror", lambda error: heard.append(str(error)))
    window.on("request", lambda request: heard.append(request.url))
    window.goto(page.as_uri())
    # Figures are drawn as they come into view; names stand in their legends as well.
    height = window.evaluate("document.documentElement.scrollHeight")
    for top in range(0, height, 500):
        window.evaluate(f"window.scrollTo(0, {top})")
        window.wait_for_timeout(100)
    assert heard == [page.as_uri()]
    assert window.locator("img, svg[onload], iframe, object, embed").count() == 0
    shown = window.locator("body").inner_text()
    for name in FILES.values():
        assert name.removesuffix(".csv") in shown
    window.close()


def test_no_shell_saw_them(page: Path) -> None:
    assert {path.name for path in page.parent.iterdir()} == {
        *FILES.values(),
        "story.html",
        "<b>story.json",
    }
    assert not Path("hit").exists()
