"""The page in a real browser: it draws, sorts, zooms and prints, and asks nothing of a network.

Figures in sight are drawn without scrolling; those of joints that are not chosen when they are.
"""

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
pytestmark = pytest.mark.xdist_group("demo")

DRAWN = """() => [...document.querySelectorAll("[data-figure]")].filter(
    (box) => box.offsetParent !== null).every(
    (box) => box.querySelector(".main-svg .plot, .main-svg .cartesianlayer path"))"""
RANGE = """() => [...document.querySelectorAll("[data-linked]")].find(
    (box) => box.offsetParent !== null).layout.xaxis.range"""
# Figures that are wider than their box, or whose legend reaches into the axes.
CUT_OFF = """() => [...document.querySelectorAll("[data-figure]")].filter((box) => {
    if (box.offsetParent === null) return false;
    const own = box.getBoundingClientRect();
    const legend = box.querySelector(".legend .bg")?.getBoundingClientRect();
    const axes = box.querySelector(".nsewdrag").getBoundingClientRect();
    return own.right > document.documentElement.clientWidth + 1
        || [...box.querySelectorAll("text")].some((text) => {
            const place = text.getBoundingClientRect();
            return place.left < own.left - 1 || place.right > own.right + 1;
        })
        || (legend && legend.bottom > axes.top + 1 && legend.left < axes.right);
}).map((box) => box.getAttribute("aria-label"))"""


@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Any]:
    """The system's chromium, headless."""
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
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


@pytest.mark.parametrize(("width", "scheme"), [(1200, "light"), (1200, "dark"), (390, "light")])
def test_it_draws_without_complaint_or_request(browser: Any, width: int, scheme: str) -> None:
    window = Opened(browser, width, scheme)
    assert window.said == []
    assert window.asked == [told().page.as_uri()]
    # Nothing hangs over the edge; wide figures and tables scroll in boxes of their own.
    assert window.page.evaluate("document.documentElement.scrollWidth") <= width
    assert window.page.evaluate(CUT_OFF) == []
    # One of them is in sight without scrolling.
    frame = window.page.locator("[data-figure]:visible").first.bounding_box()
    assert frame is not None
    assert frame["y"] + frame["height"] / 2 < 900
    back = window.page.evaluate("getComputedStyle(document.body).backgroundColor")
    light = sum(int(x) for x in back.removeprefix("rgb(").removesuffix(")").split(","))
    assert light > 700 if scheme == "light" else light < 100
    window.page.close()


def _column(table: Any, k: int) -> list[str]:
    return table.locator(f"tbody tr td:nth-child({k + 1})").all_inner_texts()


def test_tables_sort_by_mouse_and_by_keyboard(opened: Opened) -> None:
    table = opened.page.locator("table", has_text="parameters before and after")
    names, values = _column(table, 0), [x.split("\u00a0")[0] for x in _column(table, 2)]
    by_value = sorted(names, key=lambda name: float(values[names.index(name)].replace("−", "-")))
    table.get_by_role("button", name="after").click()
    assert _column(table, 0) == by_value[::-1]
    opened.page.keyboard.press("Enter")
    assert _column(table, 0) == by_value
    head = table.locator("th").nth(2)
    assert head.get_attribute("aria-sort") == "ascending"
    table.get_by_role("button", name="parameter").focus()
    opened.page.keyboard.press("Space")
    assert _column(table, 0) == sorted(names, key=str.casefold, reverse=True)


def test_joints_share_their_zoom_which_obeys_mouse_keys_and_buttons(opened: Opened) -> None:
    page = opened.page
    whole = page.evaluate(RANGE)
    span = whole[1] - whole[0]
    box = page.locator("[data-linked]:visible")
    box.scroll_into_view_if_needed()
    frame = box.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    x, y = frame["x"] + frame["width"] / 4, frame["y"] + frame["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + frame["width"] / 4, y, steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    first = page.evaluate(RANGE)
    assert first[0] == pytest.approx(whole[0] + span / 4, abs=0.02 * span)
    assert first[1] == pytest.approx(whole[0] + span / 2, abs=0.02 * span)
    # Residuals share their axis of time with the signals.
    assert box.evaluate("box => box.layout.xaxis2.range[1]") == first[1]
    chosen = page.locator("input[name=joint]:checked")
    assert chosen.get_attribute("value") == "2"
    chosen.focus()
    page.keyboard.press("ArrowLeft")
    page.locator("[data-panel='1'] .main-svg").first.wait_for()
    assert not page.locator("[data-panel='2']").is_visible()
    assert page.evaluate(RANGE) == first
    page.get_by_role("button", name="later").click()
    page.wait_for_timeout(300)
    assert page.evaluate(RANGE)[0] > first[0]
    page.locator("[data-linked]:visible").focus()
    page.keyboard.press("0")
    page.wait_for_timeout(300)
    assert page.evaluate(RANGE) == pytest.approx(whole, abs=0.02 * span)
    page.get_by_role("radio", name="joint 2").check()
    page.wait_for_timeout(300)
    assert page.evaluate(RANGE) == whole


def test_an_accessibility_checker_finds_nothing_serious(browser: Any) -> None:
    checker = pytest.importorskip("axe_playwright_python.sync_playwright")
    for scheme in ("light", "dark"):
        window = Opened(browser, 390, scheme)
        for folded in window.page.locator("summary").all():
            folded.click()
        found = checker.Axe().run(window.page).response
        assert len(found["passes"]) > 15
        serious = [v for v in found["violations"] if v["impact"] in ("serious", "critical")]
        assert [(v["id"], v["nodes"][0]["html"]) for v in serious] == []
        window.page.close()


def test_figures_follow_a_change_of_theme(opened: Opened) -> None:
    # Figures in folded panels are not drawn yet.
    ink = 'document.querySelector("[data-figure].js-plotly-plot").layout.font.color'
    light = opened.page.evaluate(ink)
    opened.page.emulate_media(color_scheme="dark")
    opened.page.wait_for_timeout(300)
    assert opened.page.evaluate(ink) != light
    opened.page.emulate_media(color_scheme="light")
    opened.page.wait_for_timeout(300)
    assert opened.page.evaluate(ink) == light


def test_it_prints_what_is_folded_away_and_all_joints(opened: Opened) -> None:
    page = opened.page
    assert len(page.pdf(format="A4")) > 50_000
    folded = "document.querySelectorAll('details:not(.raw):not([open])').length"
    assert page.evaluate(folded) == 0
    assert page.locator("[data-panel] .main-svg").count() >= 2
    page.emulate_media(media="print")
    for condition in ("before", "after"):
        page.evaluate(f"dispatchEvent(new Event('{condition}print'))")
        shown = [panel.is_visible() for panel in page.locator("[data-panel]").all()]
        assert shown.count(True) == (2 if condition == "before" else 1)
    page.emulate_media(media="screen")
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
    assert page.locator("h1").inner_text().replace("\u00a0", " ") == told().story.headline
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
    last = page.locator("[data-figure]:visible").last
    page.locator("[data-figure][data-drawn]").first.wait_for()
    assert last.get_attribute("data-drawn") is None
    last.scroll_into_view_if_needed()
    last.locator(".main-svg").first.wait_for()
    # Nobody has chosen the other joint.
    assert page.locator("[data-panel='1'] [data-drawn]").count() == 0
    page.close()
