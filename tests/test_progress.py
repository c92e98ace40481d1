"""What is shown while something works: never cut, and the time left."""

import io

import numpy as np
import pytest
from rich.console import Console

from jaxid.display import figures, progress
from jaxid.display.progress import Line, Pace, clock

LONG = "fit with " + " and ".join(f"position_dependent_friction on joint {k}" for k in range(1, 7))


@pytest.mark.parametrize("width", [40, 80, 120])
def test_a_line_is_wrapped_and_never_cut(width):
    line = Line("discovery on an arm of a rather long name")
    line.say(LONG, left=95.0)
    shown = line.lines(width)
    assert all(len(x) <= width for x in shown)
    assert " ".join(" ".join(shown).split()).endswith(LONG)
    assert "about 1:35 left" in " ".join(x.strip() for x in shown)
    # As a terminal of that width has it.
    out = io.StringIO()
    Console(file=out, width=width, force_terminal=True, color_system=None).print(line)
    assert "…" not in out.getvalue()
    assert " ".join(out.getvalue().split()).endswith(LONG)


def test_the_time_left_follows_from_the_share_that_is_done(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    line = Line("bootstrap")
    now[0] = 130.0
    line.say("30 of 120 fits", 0.25)
    assert line.head() == "0:30  bootstrap, about 1:30 left"
    now[0] = 140.0
    assert line.head() == "0:40  bootstrap, about 1:20 left"
    now[0] = 500.0
    assert line.head() == "6:40  bootstrap"


def test_the_time_left_follows_from_pieces_of_its_kind():
    now = [0.0]
    pace = Pace(["fit", "screen", "fit", "screen", "look"], lambda: now[0])
    assert pace.begin("fit") is None
    now[0] = 10.0
    # One fit took 10 s; of a screening nothing is known but that.
    assert pace.begin("screen") == pytest.approx(40.0)
    now[0] = 14.0
    assert pace.begin("fit") == pytest.approx(10.0 + 4.0 + 7.0)
    now[0] = 34.0
    assert pace.begin("fit", ["look"]) == pytest.approx((10 + 20) / 2 + (10 + 4 + 20) / 3)


@pytest.mark.parametrize(
    ("seconds", "said"), [(0.4, "0:00"), (59.6, "1:00"), (3599, "59:59"), (3661, "1:01:01")]
)
def test_durations(seconds, said):
    assert clock(seconds) == said


class _Handle:
    def __init__(self):
        self.shown = []

    def update(self, content, raw):
        assert raw
        self.shown.append(content)


def test_in_a_notebook_the_line_is_filled_anew_and_emptied(monkeypatch):
    handle = _Handle()
    monkeypatch.setattr(progress, "notebook_output", lambda: handle)
    with progress.working("a fit <of> two") as say:
        say("iteration 1", 0.5)
    first, last = handle.shown
    assert "a fit &lt;of&gt; two" in first["text/html"]
    assert "iteration 1" in first["text/plain"]
    assert last["text/html"] == ""


def test_figures_are_made_for_notebooks_alone(monkeypatch):
    def make():
        raise AssertionError

    progress.live_figure()(make)
    handle = _Handle()
    monkeypatch.setattr(progress, "in_notebook", lambda: True)
    monkeypatch.setattr(progress, "notebook_output", lambda: handle)
    draw = progress.live_figure()
    for errors in ([[4.0]], [[4.0], [1.0]]):
        steps = ["start", "+ spring"][: len(errors)]
        draw(lambda e=errors, s=steps: figures.error_falling(s, {"fitted": np.array(e)}))
    content = [x["application/vnd.plotly.v1+json"]["data"][0]["name"] for x in handle.shown[1::2]]
    assert content == ["joint 1, fitted"] * 2
    # Between two figures the place is empty, or the first would stay.
    assert [x["text/plain"] for x in handle.shown[::2]] == ["", ""]
