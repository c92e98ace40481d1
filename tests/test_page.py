"""The page in a real browser: it draws, sorts, zooms and prints, and asks nothing of a network."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from test_discover_cli import DEMO, told
from typer.testing import CliRunner

from jaxid.cli import app

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

# What one worker has fitted serves all of them.
pytestmark = [pytest.mark.xdist_group("demo"), pytest.mark.slow]

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
DRAWN = """() => [...document.querySelectorAll("[data-figure]")].every(
    (box) => box.querySelector(".main-svg .plot, .main-svg .cartesianlayer path"))"""
RANGES = """() => [...document.querySelectorAll("[data-linked]")].map(
    (box) => box.layout.xaxis.range)"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """The system's chromium, headless; skips where there is none."""
    found = next((path for path in map(shutil.which, NAMES) if path), None)
    if found is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield running
        running.close()


class Opened:
    """A page, the demo's by default, and what the browser complained of or asked for."""

    def __init__(
        self, browser: Any, width: int = 1200, scheme: str = "light", page: Path | None = None
    ) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        self.said: list[str] = []
        self.asked: list[str] = []
        self.dialogs: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("dialog", self._dialog)
        self.page.goto((page or told().page).as_uri())
        # The page forbids itself to evaluate text, which waiting for a function would do.
        for _ in range(600):
            if self.page.evaluate(DRAWN):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError("a figure was not drawn within 30 s")

    def _dialog(self, dialog: Any) -> None:
        self.dialogs.append(dialog.message)
        dialog.dismiss()


@pytest.fixture(scope="module")
def opened(browser: Any) -> Opened:
    """The page in a light window of 1200 px."""
    return Opened(browser)


@pytest.mark.parametrize(("width", "scheme"), [(1200, "light"), (1200, "dark"), (400, "light")])
def test_it_draws_without_complaint_or_request(browser: Any, width: int, scheme: str) -> None:
    window = Opened(browser, width, scheme)
    assert window.said == []
    assert window.asked == [told().page.as_uri()]
    # Nothing hangs over the edge; wide figures and tables scroll in boxes of their own.
    assert window.page.evaluate("document.documentElement.scrollWidth") <= width
    assert window.page.locator("[data-figure]").count() >= 8
    back = window.page.evaluate("getComputedStyle(document.body).backgroundColor")
    light = sum(int(x) for x in back.removeprefix("rgb(").removesuffix(")").split(","))
    assert light > 700 if scheme == "light" else light < 100
    window.page.close()


def _column(table: Any, k: int) -> list[str]:
    return table.locator(f"tbody tr td:nth-child({k + 1})").all_inner_texts()


def test_tables_sort_by_mouse_and_by_keyboard(opened: Opened) -> None:
    table = opened.page.locator("table", has_text="parameters of the final model")
    names, values = _column(table, 0), _column(table, 1)
    by_value = sorted(names, key=lambda name: float(values[names.index(name)].replace("−", "-")))
    table.get_by_role("button", name="value").click()
    assert _column(table, 0) == by_value[::-1]
    opened.page.keyboard.press("Enter")
    assert _column(table, 0) == by_value
    head = table.locator("th").nth(1)
    assert head.get_attribute("aria-sort") == "ascending"
    table.get_by_role("button", name="parameter").focus()
    opened.page.keyboard.press("Space")
    assert _column(table, 0) == sorted(names, key=str.casefold, reverse=True)


def test_zoom_is_linked_over_signals_and_obeys_the_keyboard(opened: Opened) -> None:
    page = opened.page
    whole = page.evaluate(RANGES)
    assert len(whole) == 2
    box = page.locator("[data-linked]").first
    box.scroll_into_view_if_needed()
    frame = box.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    x, y = frame["x"] + frame["width"] / 4, frame["y"] + frame["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + frame["width"] / 4, y, steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    first, second = page.evaluate(RANGES)
    assert first == second
    span = whole[0][1] - whole[0][0]
    assert first[0] == pytest.approx(whole[0][0] + span / 4, abs=0.02 * span)
    assert first[1] == pytest.approx(whole[0][0] + span / 2, abs=0.02 * span)
    # All panels of a figure share its axis of time.
    assert box.evaluate("box => box.layout.xaxis3.range[1]") == first[1]
    box.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("0")
    page.wait_for_timeout(300)
    assert page.evaluate(RANGES) == whole


def test_figures_follow_a_change_of_theme(opened: Opened) -> None:
    ink = 'document.querySelector("[data-figure]").layout.font.color'
    light = opened.page.evaluate(ink)
    opened.page.emulate_media(color_scheme="dark")
    opened.page.wait_for_timeout(300)
    assert opened.page.evaluate(ink) != light
    opened.page.emulate_media(color_scheme="light")
    opened.page.wait_for_timeout(300)
    assert opened.page.evaluate(ink) == light


def test_it_prints_what_is_folded_away(opened: Opened) -> None:
    assert len(opened.page.pdf(format="A4")) > 50_000
    folded = "document.querySelectorAll('details:not(.raw):not([open])').length"
    assert opened.page.evaluate(folded) == 0
    assert opened.said == []


HOSTILE = (
    "<script>alert(1)<script>",
    '"><img src=x onerror=alert(2)>',
    "$(touch hit);`touch hit`&'",
)
BOLD = '<b>bold</b><a href="javascript:alert(3)">$(touch hit)</script>'


def test_hostile_files_and_columns_are_inert(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The demo's clean set: of the size that is compiled already, and nothing to be found.
    monkeypatch.chdir(tmp_path)
    for name, own in zip(HOSTILE, ("fit_1", "fit_2", "held_out"), strict=True):
        frame = pd.read_csv(DEMO / "clean" / f"{own}.csv")
        frame.set_axis([f"{BOLD}{c}" for c in frame], axis=1).to_csv(f"{name}.csv", index=False)
    files = [f"{name}.csv" for name in HOSTILE]
    columns = ["time={}time", "q={0}q_1,{0}q_2", "tau={0}tau_1,{0}tau_2"]
    columns += ["q_ref={0}q_ref_1,{0}q_ref_2"]
    given = [word for c in columns for word in ("--column", c.format(BOLD))]
    held = ["--validate", files[2], "--robot", "scara"]
    command = ["discover", *files[:2], *held, *given, "--report", "out.html"]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0
    window = Opened(browser, page=tmp_path / "out.html")
    assert (window.said, window.dialogs) == ([], [])
    assert window.asked == [(tmp_path / "out.html").as_uri()]
    shown = window.page.evaluate("document.body.innerText")
    assert all(name in shown for name in HOSTILE)
    assert window.page.locator("img").count() == 0
    assert window.page.locator("a[href^=javascript]").count() == 0
    # The drawing library, the page's own script and figures' data are long.
    assert window.page.evaluate("[...document.scripts].every((script) => script.text.length > 200)")
    assert not Path("hit").exists()
    window.page.close()


def test_it_is_read_and_printed_before_any_figure_is_drawn(browser: Any) -> None:
    page = browser.new_page()
    # A browser that never finds the time.
    page.add_init_script("window.requestIdleCallback = () => 0")
    page.goto(told().page.as_uri())
    assert page.locator("h1").inner_text() == told().story.sentence
    assert page.evaluate("typeof Plotly") == "undefined"
    button = page.locator("table button").first
    button.click()
    assert page.locator("th[aria-sort]").count() == 1
    assert not page.evaluate(DRAWN)
    page.pdf(format="A4")
    assert page.evaluate(DRAWN)
    page.close()


def test_figures_far_below_are_drawn_when_one_goes_there(browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1200, "height": 700})
    # Time for one thing only: to begin to watch the window.
    page.add_init_script(
        "window.requestIdleCallback = (call) => {"
        " if (!window.begun) { window.begun = true; setTimeout(call, 0); } return 0; }"
    )
    page.goto(told().page.as_uri())
    last = page.locator("[data-figure]").last
    page.locator("[data-figure][data-drawn]").first.wait_for()
    assert last.get_attribute("data-drawn") is None
    last.scroll_into_view_if_needed()
    last.locator(".main-svg").first.wait_for()
    assert not page.evaluate(DRAWN)
    page.close()
