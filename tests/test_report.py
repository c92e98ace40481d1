"""The page: it needs nothing but itself, and what users name things does not get into it."""

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from test_discover_cli import told

import jaxid
from jaxid.discovery.floor import Floor
from jaxid.display import figures
from jaxid.errors import ModelError
from jaxid.report import write_report
from jaxid.report._html import Markup, join, number, probability, table, tag, with_deviation
from jaxid.report._signals import POINTS

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


def test_it_is_small_and_holds_plotly_once(page: Page) -> None:
    assert sum(len(code) > 2**20 for code in page.code) == 1
    assert told().page.stat().st_size - max(map(len, page.code)) < 2**20


def test_signals_of_six_joints_are_small() -> None:
    rng = np.random.default_rng(0)
    joints = 6
    time = np.arange(25_000) * 1e-3
    drawn = 0
    for _ in range(joints):
        measured, before, after = rng.normal(size=(3, len(time)))
        figure = figures.before_after(
            time, measured, after, before, 1.0, most=min(figures.MAX_POINTS, POINTS // joints)
        )
        drawn += len(figure.to_json() or "")
    # What is left of a megabyte is enough for tables and for the curves of effects.
    assert drawn < 0.7 * 2**20


def test_the_verdict_comes_first(page: Page) -> None:
    text = " ".join(page.shown).replace("\u00a0", " ")
    headline = told().story.headline
    assert headline in text
    order = ["Measured and simulated", "Effect that was found"]
    order += ["All recordings, joints and steps", "Models that were compared", "Parameters"]
    order += ["Where the model still fails", "How to reproduce this result"]
    # After the links to them.
    places = [text.index(headline), *(text.rindex(heading) for heading in order)]
    assert places == sorted(places)
    assert "probability" not in headline
    assert "(probability > 0.999)" in text
    # Nothing is open that another recording would settle.
    assert "What to record next" not in text
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


def test_names_are_shown_and_not_obeyed(tmp_path: Path) -> None:
    path = write_report(_renamed(told().story), tmp_path / "hostile.html")
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert "alert(1)" in text
    assert HOSTILE not in text
    assert not any(code.strip().startswith("alert") for code in page.code)
    assert "img" not in {name for name, _ in page.elements}
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)


def test_a_story_writes_its_own_page(tmp_path: Path) -> None:
    assert jaxid.write_report(told().story, tmp_path / "story.html").stat().st_size > 2**20
    with pytest.raises(ModelError, match="there is no folder"):
        jaxid.write_report(told().story, tmp_path / "absent" / "story.html")


def test_a_story_of_one_step_is_a_page_too(tmp_path: Path) -> None:
    story = told().story
    short = dataclasses.replace(story, verdict="adequate", steps=story.steps[:1])
    page = Page(write_report(short, tmp_path / "short.html").read_text(encoding="utf-8"))
    assert "nothing is missing" in " ".join(page.shown)


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
    assert "Models that were compared" in shown


def test_a_floor_that_a_doubtful_model_has_estimated_is_called_too_high(tmp_path: Path) -> None:
    last = told().story.steps[-1]
    percent = np.ones((len(last.fit.recordings), told().story.loop.joints))
    measured = Floor(percent, percent, percent, (("repeats",) * percent.shape[1],) * len(percent))

    def story(verdict, floor):
        steps = (dataclasses.replace(last, diagnosis=dataclasses.replace(last.diagnosis, **floor)),)
        return dataclasses.replace(told().story, verdict=verdict, reason="a test", steps=steps)

    sure = story("explained", {"measured": None})
    doubtful = story("undetermined", {"measured": None})
    known = story("undetermined", {"measured": measured})
    for shown, warned in ((sure, False), (doubtful, True), (known, False)):
        page = Page(write_report(shown, tmp_path / "floor.html").read_text(encoding="utf-8"))
        assert ("it is too high where a model" in " ".join(page.shown)) == warned
        assert ("too high if an effect is missing" in " ".join(repr(shown).split())) == warned


def test_text_is_escaped_unless_it_is_markup() -> None:
    assert join("<b>", Markup("<i>")) == "&lt;b&gt;<i>"
    assert tag("p", HOSTILE, class_=IMAGE) == (
        '<p class="&quot;&gt;&lt;img src=x onerror=alert(1)&gt;">'
        "&lt;script&gt;alert(1)&lt;/script&gt;</p>"
    )
    assert "<script>" not in table([HOSTILE], [[HOSTILE]], HOSTILE)


def test_deviations_end_where_their_value_does() -> None:
    assert with_deviation(0.079786, 0.001312) == "0.0798\u00a0±\u00a00.0013"
    assert with_deviation(-3.17, 0.0) == number(-3.17)
    assert with_deviation(9.049e-06, 4.2e-07) == "(9.05\u00a0±\u00a00.42)·10⁻⁶"
    assert with_deviation(-11370.0, 470.0) == "−11370\u00a0±\u00a0470"
    assert with_deviation(2.0, None) == "2"


def test_a_shift_is_counted_in_deviations(page: Page) -> None:
    first, last = told().story.steps[0].fit, told().story.fit
    k, j = first.names.index("Fc2"), last.names.index("Fc2")
    shift = (last.theta[j] - first.theta[k]) / max(first.std[k], last.std[j])
    text = " ".join(page.shown)
    assert f"{shift:+.1f}".replace("-", "−") in text
    assert abs(shift) > 3


def test_every_error_is_beside_its_floor(page: Page) -> None:
    story = told().story
    text = " ".join(page.shown)
    for step in story.steps:
        tables = [step.fit.error_percent, step.held_out.error_percent]  # type: ignore[union-attr]
        assert all(f"{x:.2f}" in text for table in tables for x in table.to_numpy().ravel())
    assert all(f"{x:.2f}" in text for x in story.noise_floor_percent())


def test_a_reference_is_shown_only_where_effects_look_alike(tmp_path: Path) -> None:
    story = told().story
    rival = next(v.key for v in story.first_diagnosis.ranking[1:] if v.possible)
    last = dataclasses.replace(story.steps[1], alike=(rival,))
    file = write_report(dataclasses.replace(story, steps=(story.steps[0], last)), tmp_path / "a")
    shown = " ".join(Page(file.read_text(encoding="utf-8")).shown)
    assert "What to record next" in shown
    assert "These recordings cannot tell whether the model lacked Stribeck friction" in shown


def test_numbers_are_read_and_sorted() -> None:
    assert number(-0.00123456) == "−0.001235"
    assert (number(24841), number(24841.3), number(2.5e7)) == ("24841", "24840", "2.5e+07")
    assert number(float("nan")) == "–"
    assert number(float("inf")) == "∞"
    assert probability(0.0) == "< 1e−300"
    assert probability(0.01234) == "0.012"
    assert 'data-value="0.3333333333333333"' in table(["x"], [[1 / 3]])
