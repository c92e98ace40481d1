"""Pictures of effects that look alike on one motion and not on another: docs/img/alike.

PYTHONPATH=. python docs/look_alikes.py [NAMES]    needs the extra `static`; some minutes
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from pictures import DEMO
from plotly.subplots import make_subplots

import jaxid
from jaxid import effects as fx
from jaxid.discovery.diagnosis import Diagnosis, Verdict
from jaxid.display import figures
from jaxid.effects import AbstractEffect

OUT = Path(__file__).parent / "img" / "alike"
TIME = np.arange(0.0, 12.0, 0.01)
Motion = Callable[[np.ndarray], np.ndarray]


class Pair(NamedTuple):
    """An effect in the recordings, another effect that looks like it, and two motions.

    An effect is screened with its own shape, a class with the shapes of its grid.
    """

    there: AbstractEffect
    other: type[AbstractEffect] | AbstractEffect
    alike: Motion
    apart: Motion
    titles: tuple[str, str]


def waves(size: float, *hertz: float) -> Motion:
    """Sines of equal amplitude (rad) and different phases, from rest at zero."""
    phases = np.linspace(0, 2, len(hertz))

    def along(t: np.ndarray) -> np.ndarray:
        each = [np.sin(2 * np.pi * f * t + p) for f, p in zip(hertz, phases, strict=True)]
        return size * np.minimum(t, 1.0) * np.sum(each, axis=0) / len(hertz)

    return along


def turning(speed: float, wobble: float = 0.0) -> Motion:
    """Motion in one direction at a constant or a varying speed (rad/s)."""

    def along(t: np.ndarray) -> np.ndarray:
        return speed * t - wobble * (np.cos(0.9 * t) - 1)

    return along


def with_rests(t: np.ndarray) -> np.ndarray:
    """Slow moves between rests."""
    stops = np.array([0.0, 0.8, 0.8, -0.6, -0.6, 0.4, 0.4, 0.0])
    return np.interp(t, np.linspace(0, 12, len(stops)), stops)


PAIRS = {
    "stribeck_hysteresis": Pair(
        fx.Stribeck(joint=2, level=0.08, velocity=0.4),
        fx.Hysteresis,
        waves(1.2, 1.1, 1.7, 2.3),
        waves(0.5, 0.11, 0.23),
        ("fast reversals", "slow passes through zero speed"),
    ),
    "stribeck_drag": Pair(
        fx.Stribeck(joint=2, level=0.08, velocity=3.0),
        fx.QuadraticDrag,
        waves(0.5, 0.23, 0.4),
        waves(2.2, 0.3, 0.7, 1.1),
        ("speeds up to 1 rad/s", "speeds up to 9 rad/s"),
    ),
    "lag_delay": Pair(
        fx.ActuatorLag(joint=2, time_constant=0.008),
        fx.TimeDelay,
        waves(1.0, 0.3, 0.5),
        waves(0.6, 1.0, 4.0, 7.0),
        ("slow motion, up to 0.5 Hz", "fast motion, up to 7 Hz"),
    ),
    "ripple_disturbance": Pair(
        fx.TorqueRipple(joint=2, A=0.05, harmonic=6.0),
        fx.PeriodicDisturbance(joint=2, frequency=6.0 * 2.0 / (2 * np.pi)),
        turning(2.0),
        turning(2.0, 1.2),
        ("constant speed", "varying speed"),
    ),
    "spring_counterbalance": Pair(
        fx.Spring(joint=2, stiffness=0.1),
        fx.Counterbalance(joint=2),
        waves(0.35, 0.4, 0.7),
        waves(3.0, 0.4, 0.7),
        ("short travel, ±0.35 rad", "long travel, ±3 rad"),
    ),
    "offset_asymmetry": Pair(
        fx.AsymmetricFriction(joint=2, coulomb=0.05),
        fx.TorqueOffset,
        waves(1.2, 0.6, 1.1),
        with_rests,
        ("always moving", "with rests"),
    ),
}


def recorded(pair: Pair, motion: Motion) -> jaxid.Recording:
    """A simulated recording of a SCARA with the effect, torque noise of 0.5 mN·m on joint 2."""
    moved = motion(TIME)
    q_ref = np.stack([0.6 * np.sin(1.3 * TIME) * np.minimum(TIME, 1.0), moved], axis=1)
    asked = jaxid.Recording(TIME, q_ref, np.zeros_like(q_ref), q_ref=q_ref)
    run = jaxid.simulate(jaxid.scara().add(pair.there), asked)[0]
    noise = np.random.default_rng(1).standard_normal(q_ref.shape) * [5e-3, 5e-4]
    return jaxid.Recording(TIME, np.asarray(run.q), np.asarray(run.tau) + noise, q_ref=q_ref)


def answers(pair: Pair, motion: Motion) -> tuple[Diagnosis, Verdict, Verdict]:
    """The best verdicts of the effect in the recordings and of the other effect."""
    fit = jaxid.fit(jaxid.scara(), recorded(pair, motion), jaxid.OEM(progress=False))
    shaped = isinstance(pair.other, AbstractEffect)
    there = pair.there.scaled(0.0) if shaped else type(pair.there)
    found = jaxid.diagnose(fit, catalogue=(there, pair.other), progress=False)

    def best(kind: type[AbstractEffect]) -> Verdict:
        forms = [v for v in found.forms if type(v.hypothesis.effect) is kind]
        return max(forms, key=lambda v: (v.hypothesis.joint in (2, None), v.explained))

    return found, best(type(pair.there)), best(kind_of(pair.other))


def kind_of(effect: type[AbstractEffect] | AbstractEffect) -> type[AbstractEffect]:
    """The class of an effect, or the class itself."""
    return effect if isinstance(effect, type) else type(effect)


def explained(found: Diagnosis, verdict: Verdict) -> Float[np.ndarray, " samples"]:
    """The residual of joint 2 that an effect explains, with the fitted parameters free."""
    data, columns = found.data, list(verdict.hypothesis.columns)
    wave = data.table[..., columns] @ found.gram.amplitude(columns)[0]
    weights = 1 / np.sqrt(np.mean(data.residual**2, axis=(0, 1)))
    base = (data.base * weights[:, None]).reshape(-1, data.base.shape[-1])
    bent = np.linalg.lstsq(base, (wave * weights).ravel(), rcond=None)[0]
    return (wave - data.base @ bent)[0, :, 1]


def draw(pair: Pair) -> go.Figure:
    """Both effects on both motions."""
    figure = make_subplots(1, 2, subplot_titles=pair.titles, horizontal_spacing=0.06)
    names = [kind_of(effect).spoken() for effect in (pair.there, pair.other)]
    for column, motion in enumerate((pair.alike, pair.apart), start=1):
        found, there, other = answers(pair, motion)
        share = 100 * other.explained / there.explained
        behind = there.evidence - other.evidence
        looks = ({"color": figures.BLUE, "width": 2.4}, {"color": figures.ORANGE, "width": 1.6})
        for name, verdict, look in zip(names, (there, other), looks, strict=True):
            y = 1e3 * explained(found, verdict)
            trace = go.Scatter(x=TIME, y=y, mode="lines", line=look, name=name)
            figure.add_trace(trace.update(showlegend=column == 1), row=1, col=column)
        text = (
            f"{pair.titles[column - 1]}<br>{names[1]} explains {share:.3g} %, {behind:.0f} behind"
        )
        figure.layout.annotations[column - 1].text = text
        print(f"{names[0]}: {text}")
    figure.update_layout(template=figures.theme(), margin={"l": 60, "r": 10, "t": 85, "b": 45})
    figure.update_layout(legend={"y": 1.2})
    figure.update_annotations(font_size=12.5)
    figure.update_xaxes(title_text="time (s)", range=[2, 10])
    figure.update_yaxes(title_text="joint 2 (mN·m)", row=1, col=1)
    return figure


def matrix(joint: int = 2) -> go.Figure:
    """Correlation of all effects of one joint, on the recordings that come with jaxid."""
    fit = jaxid.fit(jaxid.scara(), jaxid.read(DEMO / "fit_1.csv", DEMO / "fit_2.csv"))
    found = jaxid.diagnose(fit, progress=False)
    forms = [v for v in found.forms if v.hypothesis.joint == joint]
    values = np.array([[found.correlation(a, b) for b in forms] for a in forms])
    # Effects that look alike are neighbours in the picture.
    order = [0]
    while len(order) < len(forms):
        rest = [k for k in range(len(forms)) if k not in order]
        order.append(max(rest, key=lambda k: values[order[-1], k]))
    names = [type(forms[k].hypothesis.effect).__name__ for k in order]
    values = values[np.ix_(order, order)]
    figure = go.Figure(
        go.Heatmap(z=values, x=names, y=names, zmin=0, zmax=1, colorscale="Blues", xgap=1, ygap=1)
    )
    figure.update_layout(template=figures.theme(), margin={"l": 10, "r": 10, "t": 10, "b": 10})
    figure.update_yaxes(autorange="reversed", showgrid=False)
    figure.update_xaxes(tickangle=-50, showgrid=False)
    return figure


def main() -> None:
    """Writes one picture for each pair that is named, and that of all correlations."""
    OUT.mkdir(parents=True, exist_ok=True)
    asked = sys.argv[1:] or ["correlations", *PAIRS]
    if "correlations" in asked:
        matrix().write_image(OUT / "correlations.png", width=760, height=620, scale=1)
    for name in [name for name in PAIRS if name in asked]:
        draw(PAIRS[name]).write_image(OUT / f"{name}.png", width=900, height=300, scale=1)


if __name__ == "__main__":
    main()
