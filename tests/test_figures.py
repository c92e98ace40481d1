"""Figures name their axes with units, show everything they are given, and stay small."""

import json

import numpy as np
import plotly.graph_objects as go
import pytest

from jaxid.display import figures

TIME = np.arange(400) * 0.01
WAVE = np.sin(TIME)
PAIR = np.stack([WAVE, np.cos(TIME)], axis=1)
ACF = np.stack([0.5 ** np.arange(39), 0.1 ** np.arange(39)], axis=1)


def _signals() -> go.Figure:
    band = WAVE[:, None] + np.array([-0.1, 0.1])
    upper = [
        figures.Trace("measured", WAVE, "N·m"),
        figures.Trace("simulated", 0.9 * WAVE, "N·m", "simulated"),
        figures.Trace("±2σ", band, "N·m", "band"),
    ]
    lower = [figures.Trace("residual", 0.1 * WAVE, "N·m", "residual")]
    return figures.signals(TIME, [upper, lower], titles=["torque of joint 1", "residual"])


def _comparison() -> go.Figure:
    names = ["torque of joint 1", "force of joint 2"]
    return figures.comparison(
        TIME, PAIR, 0.9 * PAIR, 0.1 * PAIR, ACF, 0.1, names, ["N·m", "N"], "held out"
    )


def _before_after() -> go.Figure:
    return figures.before_after(TIME, WAVE, 0.9 * WAVE, 0.8 * WAVE, 0.05)


def _error_bars() -> go.Figure:
    values = np.array([[2.4, 3.9], [2.5, 4.0], [2.6, 4.1]])
    return figures.error_bars(
        ["joint 1", "joint 2"], ["fit_1", "fit_2", "held out"], values, np.array([2.3, 1.5])
    )


def _error_falling() -> go.Figure:
    errors = np.array([[4.0, 3.0], [2.0, 1.0]])
    series = {"fitted": errors, "held out": 1.1 * errors}
    return figures.error_falling(["start", "+ stribeck"], series, np.array([1.9, 0.9]))


def _autocorrelation() -> go.Figure:
    return figures.autocorrelation(np.arange(39), ACF[:, 0], 0.1)


def _curve_fit() -> go.Figure:
    x = np.linspace(-1, 1, 50)
    band = np.full(50, 0.1)
    return figures.curve_fit(WAVE, WAVE**2, "velocity", "rad/s", "N·m", x, x**2, band)


def _dependence() -> go.Figure:
    return figures.dependence(WAVE, WAVE**2, "velocity", "rad/s", "N·m")


def _parameters() -> go.Figure:
    values, stds = np.array([3.4, 0.0]), np.array([0.02, 0.1])
    return figures.parameters(["ZZ1r", "MY2"], values, stds, ["kg·m²", "kg·m"], values + 0.01)


def _ranking() -> go.Figure:
    labels = ["stribeck, joint 2", "spring, joint 1", "delay, joint 1"]
    return figures.ranking(labels, np.array([60.0, 2.0, 0.1]), np.array([True, False, False]))


def _shares() -> go.Figure:
    return figures.shares_in_time(TIME, WAVE, {"stribeck": 0.7 * WAVE, "spring": 0.2 * WAVE})


DRAWINGS = {
    "signals": (_signals, ["measured", "simulated", "±2σ", "residual"]),
    "comparison": (
        _comparison,
        2 * ["measured", "simulated", "residual", "autocorrelation"],
    ),
    "before_after": (
        _before_after,
        ["measured", "before", "before", "after", "after", "noise"],
    ),
    "error_bars": (_error_bars, ["fit_1", "fit_2", "held out", "noise floor"]),
    "error_falling": (
        _error_falling,
        [
            f"joint {joint}, {kind}"
            for joint in (1, 2)
            for kind in ("fitted", "held out", "noise floor")
        ],
    ),
    "autocorrelation": (_autocorrelation, ["autocorrelation"]),
    "curve_fit": (_curve_fit, ["residual", "95 % band", "fitted curve"]),
    "dependence": (_dependence, ["residual", "95 % band", "mean"]),
    "parameters": (_parameters, ["estimate ± 2σ", "reference"]),
    "ranking": (_ranking, ["significant", "not significant"]),
    "shares": (_shares, ["residual", "explained by stribeck", "stribeck", "spring", "rest"]),
}
# Axes of names or of pure numbers; every other axis names its unit.
WITHOUT_UNIT = {"autocorrelation", "joint", "step", "parameter", "candidate"}


@pytest.fixture(params=list(DRAWINGS))
def drawing(request: pytest.FixtureRequest) -> tuple[go.Figure, list[str]]:
    draw, names = DRAWINGS[request.param]
    return draw(), names


def _shown_axes(figure: go.Figure, letter: str) -> list[dict]:
    layout = figure.to_dict()["layout"]
    axes = [value for key, value in layout.items() if key.startswith(f"{letter}axis")]
    return [axis for axis in axes if axis.get("showticklabels", True)]


def test_rivals_are_not_added_up():
    top = {t.name: np.nanmax(np.abs(np.asarray(t.y, float))) for t in _shares().data}
    assert np.isclose(top["explained by stribeck"], 0.7 * top["residual"])
    assert np.isclose(top["rest"], 0.3 * top["residual"])


def test_all_series_are_drawn(drawing):
    figure, names = drawing
    assert sorted(trace.name for trace in figure.data) == sorted(names)


def test_axes_are_named_with_units(drawing):
    figure, _ = drawing
    titles = [axis.get("title", {}).get("text") for axis in _shown_axes(figure, "y")]
    assert titles
    assert all(title in WITHOUT_UNIT or title.endswith(")") for title in titles)
    named = [axis["title"]["text"] for axis in _shown_axes(figure, "x") if "title" in axis]
    assert named
    assert all(title in WITHOUT_UNIT or title.endswith(")") for title in named)


def test_theme_is_applied_and_lets_the_page_through(drawing):
    figure, _ = drawing
    assert figure.layout.template == figures.theme()
    assert figure.layout.template.layout.paper_bgcolor == "rgba(0,0,0,0)"


def test_figure_is_json(drawing):
    figure, names = drawing
    assert len(json.loads(figure.to_json())["data"]) == len(names)


def test_units_of_each_joint_are_its_own():
    titles = [axis["title"]["text"] for axis in _shown_axes(_comparison(), "y")]
    assert {"torque of joint 1 (N·m)", "force of joint 2 (N)"} <= set(titles)


def test_a_name_is_once_in_the_legend():
    shown = [trace.name for trace in _comparison().data if trace.showlegend is not False]
    assert sorted(shown) == ["measured", "residual", "simulated"]


def test_comparison_wants_the_acf_from_lag_zero():
    with pytest.raises(ValueError, match="lag 0"):
        figures.comparison(TIME, PAIR, PAIR, PAIR, ACF[1:], 0.1, ["1", "2"], "N·m")


def test_an_empty_panel_is_refused():
    with pytest.raises(ValueError, match="at least one trace"):
        figures.signals(TIME, [[]])


def test_long_series_keep_extremes_and_holes_but_few_points():
    time = np.arange(1_000_000) * 1e-3
    values = np.sin(time)
    values[123_456], values[654_321], values[500_000] = 9.0, -9.0, np.nan
    drawn = figures.signals(time, [[figures.Trace("measured", values, "N·m")]]).data[0]
    assert len(drawn.y) <= figures.MAX_POINTS
    assert np.nanmax(drawn.y) == 9.0
    assert np.nanmin(drawn.y) == -9.0
    assert np.isnan(drawn.y).sum() == 1
    assert np.all(np.diff(drawn.x) >= 0)


def test_long_scatter_is_thinned_and_says_so():
    many = np.linspace(-1, 1, 100_000)
    figure = figures.curve_fit(many, many, "position", "rad", "N·m", many[:9], many[:9])
    assert len(figure.data[0].x) == figures.MAX_DOTS
    assert "2000 of 100000" in figure.data[0].name


def test_gaps_break_the_line_and_are_shaded():
    kept = (TIME < 1.0) | (TIME > 1.5)
    time, values = TIME[kept], WAVE[kept].copy()
    values[-50:-40] = np.nan
    traces = [
        figures.Trace("measured", values, "N·m"),
        figures.Trace("±2σ", values[:, None] + np.array([-0.1, 0.1]), "N·m", "band"),
    ]
    figure = figures.signals(time, [traces])
    measured, band = figure.data[0], figure.data[1]
    # One NaN breaks the line at the jump; the ten missing samples are there as they were.
    assert np.isnan(measured.y).sum() == 11
    # Each of the three stretches of the band is an outline of its own, ended by a NaN.
    assert np.isnan(band.y).sum() == 3
    edges = sorted((shape.x0, shape.x1) for shape in figure.layout.shapes)
    missing = np.flatnonzero(np.isnan(values))
    spans = [(0.99, 1.51), (time[missing[0] - 1], time[missing[-1] + 1])]
    np.testing.assert_allclose(edges, spans, atol=1e-12)
    assert figure.data[-1].name == "no data"


def test_misfit_is_shaded_beside_its_joint_and_named_once():
    figure = figures.mark_misfit(_comparison(), 2, [(0.5, 1.0), (2.0, 2.2)])
    figures.mark_misfit(figure, 1, [(1.0, 1.1)])
    spans = [(s.xref, s.x0, s.x1) for s in figure.layout.shapes if s.x1 - s.x0 < 1]
    # Panels 1 and 2 are joint 1's, 3 and 4 joint 2's; the third axis is that of autocorrelation.
    rows = {axis: sum(span[0] == axis for span in spans) for axis in {s[0] for s in spans}}
    assert sorted(rows.values()) == [1, 1, 2, 2]
    assert [trace.name for trace in figure.data].count("misfit") == 1


def test_a_mean_follows_what_depends():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, 3000)
    figure = figures.dependence(x, x**2 + 0.1 * rng.standard_normal(3000), "q", "rad", "N·m")
    line = figure.data[-1]
    np.testing.assert_allclose(line.y, line.x**2, atol=0.05)
    still = figures.dependence(np.zeros(300), rng.standard_normal(300), "q", "rad", "N·m")
    assert len(still.data[-1].x) == 1


def test_nothing_is_shaded_without_gaps():
    figure = _signals()
    assert not figure.layout.shapes
    assert all(trace.name != "no data" for trace in figure.data)


def test_parameter_of_value_zero_has_a_finite_bar():
    figure = _parameters()
    assert np.all(np.isfinite(figure.data[0].error_x.array))
    assert figure.layout.yaxis.ticktext[0] == "<b>ZZ1r</b>  3.400 ± 0.020 kg·m²"


def test_many_joints_share_a_short_legend():
    errors = np.ones((3, 6))
    steps = ["start", "+ position_dependent_friction on joint 2", "c"]
    series = {"fitted": errors, "held out": errors}
    figure = figures.error_falling(steps, series, np.ones(6))
    shown = [trace.name for trace in figure.data if trace.showlegend is not False]
    joints = [f"joint {j}" for j in range(1, 7)]
    assert shown == [*joints, "fitted", "held out", "noise floor"]
    # Words are whole.
    assert figure.layout.xaxis.ticktext[1].split("<br>") == [
        "+ position",
        "dependent",
        "friction on",
        "joint 2",
    ]


def test_before_and_after_are_on_one_axis():
    figure = _before_after()
    by_name = {(t.name, t.yaxis): np.asarray(t.y) for t in figure.data}
    assert np.allclose(by_name["before", "y2"], 0.2 * WAVE, atol=1e-6)
    assert np.allclose(by_name["after", "y2"], 0.1 * WAVE, atol=1e-6)
    (band,) = figure.layout.shapes
    assert (band.y0, band.y1) == (-0.05, 0.05)
    shown = [trace.name for trace in figure.data if trace.showlegend is not False]
    assert shown == ["measured", "before", "after", "noise"]
