"""The page: it needs nothing but itself, and what users name things does not get into it."""

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from test_discover_cli import told

import jaxid
from jaxid.errors import ModelError
from jaxid.report import write_report
from jaxid.report._html import Markup, join, number, probability, table, tag

# What one worker has fitted serves all of them.
pytestmark = pytest.mark.xdist_group("demo")


HOSTILE = "<script>alert(1)</script>"
IMAGE = '"><img src=x onerror=alert(1)>'


class Page(HTMLParser):
    """Elements with their attributes, and the text outside scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.code: list[str] = []
        self.shown: list[str] = []
        self.open = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self.open = tag

    def handle_endtag(self, tag: str) -> None:
        self.open = ""

    def handle_data(self, data: str) -> None:
        (self.code if self.open in ("script", "style") else self.shown).append(data)


@pytest.fixture(scope="session")
def page() -> Page:
    """The page of the demo's hidden set."""
    return Page(told().page.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_it_loads_nothing(page: Page) -> None:
    loading = ("src", "srcset", "data", "poster", "action", "background")
    assert [e for e in page.elements if any(name in e[1] for name in loading)] == []
    # Links lead to places on the page, each of which is there once.
    places = [a["id"] for _, a in page.elements if "id" in a]
    links = [a["href"] for _, a in page.elements if "href" in a]
    assert len(links) > 5
    assert sorted(links) == sorted(f"#{place}" for place in places)
    assert "link" not in {name for name, _ in page.elements}
    styles = [code for code in page.code if "{" in code and "function" not in code]
    assert not any(re.search(r"@import|url\(", style) for style in styles)
    policies = [a["content"] for n, a in page.elements if a.get("http-equiv")]
    assert any(policy.startswith("default-src 'none'") for policy in policies if policy)


@pytest.mark.slow
def test_it_is_small_and_holds_plotly_once(page: Page) -> None:
    assert told().page.stat().st_size < 6 * 2**20
    assert sum(len(code) > 2**20 for code in page.code) == 1


@pytest.mark.slow
def test_the_verdict_comes_first(page: Page) -> None:
    text = " ".join(page.shown)
    assert told().story.sentence in text
    assert text.index(told().story.sentence) < text.index("The error falling")
    for heading in (
        "Where the starting model failed",
        "Why this effect and not its rivals",
        "Parameters",
        "What is left",
        "What to record next",
        "To do it again",
    ):
        assert heading in text
    assert all(name in text for name in ("fit_1", "fit_2", "held_out", "jaxid-robotics"))


def _renamed(story: jaxid.Discovery) -> jaxid.Discovery:
    """The story of a robot, recordings, steps and notes with hostile names."""

    def named(recordings):
        renamed = [dataclasses.replace(r, name=f"{HOSTILE}{IMAGE}{r.name}") for r in recordings]
        return jaxid.Recordings.of(renamed)

    def step(old):
        loop = dataclasses.replace(old.fit.loop, name=HOSTILE)
        fit = dataclasses.replace(
            old.fit, loop=loop, recordings=named(old.fit.recordings), notes=(HOSTILE, IMAGE)
        )
        held = dataclasses.replace(
            old.held_out, loop=loop, recordings=named(old.held_out.recordings)
        )
        alike = ((HOSTILE, 1), (IMAGE, None))
        return dataclasses.replace(
            old, label=f"{old.label}{IMAGE}", fit=fit, held_out=held, alike=alike
        )

    steps = tuple(step(old) for old in story.steps)
    removed = ((HOSTILE, 1), (IMAGE, None))
    return dataclasses.replace(story, steps=steps, removed=removed, notes=(HOSTILE, IMAGE))


@pytest.mark.slow
def test_names_are_shown_and_not_obeyed(tmp_path: Path) -> None:
    path = write_report(_renamed(told().story), tmp_path / "hostile.html")
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert "alert(1)" in text
    assert HOSTILE not in text
    assert not any(code.strip().startswith("alert") for code in page.code)
    assert "img" not in {name for name, _ in page.elements}
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)


@pytest.mark.slow
def test_a_story_writes_its_own_page(tmp_path: Path) -> None:
    assert jaxid.write_report(told().story, tmp_path / "story.html").stat().st_size > 2**20
    with pytest.raises(ModelError, match="there is no folder"):
        jaxid.write_report(told().story, tmp_path / "absent" / "story.html")


@pytest.mark.slow
def test_a_story_of_one_step_is_a_page_too(tmp_path: Path) -> None:
    story = told().story
    short = dataclasses.replace(story, verdict="adequate", steps=story.steps[:1])
    page = Page(write_report(short, tmp_path / "short.html").read_text(encoding="utf-8"))
    assert "nothing is missing" in " ".join(page.shown)


@pytest.mark.slow
def test_what_cannot_be_told_is_a_page_that_says_why(tmp_path: Path) -> None:
    why = "the fit of the model did not converge (a test)"
    story = dataclasses.replace(
        told().story, verdict="undetermined", reason=why, steps=told().story.steps[:1]
    )
    file = write_report(story, tmp_path / "undetermined.html")
    shown = " ".join(Page(file.read_text(encoding="utf-8")).shown)
    assert "These recordings do not tell what the model of scara lacks." in shown
    assert f"T{why[1:]}." in shown
    assert "Nothing is missing" not in shown
    assert "The models that were looked at" in shown


def test_text_is_escaped_unless_it_is_markup() -> None:
    assert join("<b>", Markup("<i>")) == "&lt;b&gt;<i>"
    assert tag("p", HOSTILE, class_=IMAGE) == (
        '<p class="&quot;&gt;&lt;img src=x onerror=alert(1)&gt;">'
        "&lt;script&gt;alert(1)&lt;/script&gt;</p>"
    )
    assert "<script>" not in table([HOSTILE], [[HOSTILE]], HOSTILE)


def test_numbers_are_read_and_sorted() -> None:
    assert number(-0.00123456) == "−0.001235"
    assert number(float("nan")) == "–"
    assert number(float("inf")) == "∞"
    assert probability(0.0) == "< 1e−300"
    assert probability(0.01234) == "0.012"
    assert 'data-value="0.3333333333333333"' in table(["x"], [[1 / 3]])
