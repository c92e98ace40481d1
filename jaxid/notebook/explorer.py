"""Interactive exploration: predictions of a fitted model with an effect set by sliders."""

import html
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..discovery.hypotheses import effect_on
from ..discovery.landscape import form
from ..discovery.what_if import Answer, WhatIf
from ..effects import AbstractEffect
from ..effects import catalogue as known
from ..errors import JaxidError, ModelError
from ..estimate import Fit
from ..recording import Recording, Recordings
from .picture import Picture
from .sliders import Sliders

_ALL = "all"


def explore(
    fit: Fit,
    validate: Recording | Recordings | Iterable[Recording] | None = None,
    *,
    effect: str | None = None,
    joint: int | None = None,
    catalogue: Sequence[Any] = known,
) -> "Explorer":
    """Sets an effect by sliders and shows the predictions of a fitted model with it.

    The linear system along the runs gives torque, residual and error in milliseconds. They are
    exact for small effects; *refit in full* simulates the model with the effect and fits it.
    Transmissions, limits and delays are simulated, which takes longer.

    **Arguments:**

    - `fit`: fit of a loop that can be simulated.
    - `validate`: recordings that were not used in the fit.
    - `effect`, `joint`: the effect to start with, named as in tables; the first one by default.
    - `catalogue`: as for `diagnose`.

    **Raises:** `ModelError` without the extra `notebook`; `FitError` if the fitted loop cannot
    be simulated.
    """
    try:
        import anywidget  # noqa: F401
        import ipywidgets  # noqa: F401
    except ImportError as error:
        raise ModelError(
            "explore needs widgets: pip install 'jaxid-robotics[notebook]', and start Jupyter anew"
        ) from error
    made = Explorer(fit, validate, catalogue)
    if effect is not None:
        made.choose(effect, joint)
    return made


class Explorer:
    """The widget that `explore` shows in a notebook.

    - `fit`: the current model; after a refit, the one with the effect.
    - `effect`: the effect at the values of the sliders.
    - `answer`: the last answer; `milliseconds` is the time it took from slider to figure.
    """

    def __init__(self, fit: Fit, validate: Any, catalogue: Sequence[Any]) -> None:
        import ipywidgets as widgets

        self._validate, self._catalogue = validate, catalogue
        self.milliseconds = 0.0
        self.answer: Answer
        self._rest: np.ndarray
        self._at: tuple[int, np.ndarray, int] | None
        self._picture: Picture | None
        wide: dict[str, Any] = {
            "layout": {"width": "100%"},
            "style": {"description_width": "120px"},
        }
        self._name: Any = widgets.Dropdown(description="effect", **wide)
        self._joint: Any = widgets.Dropdown(description="joint", **wide)
        self._shown: Any = widgets.Dropdown(description="recording", **wide)
        self._of: Any = widgets.Dropdown(description="show joint", **wide)
        self._again = widgets.Checkbox(
            value=True, indent=False, description="estimate the other parameters again"
        )
        self._best = widgets.Button(description="best values", tooltip="by least squares")
        self._full = widgets.Button(
            description="refit in full and add", button_style="primary", layout={"width": "auto"}
        )
        self._box = widgets.VBox()
        self._errors, self._said, self._added = (widgets.HTML() for _ in range(3))
        self._figure = widgets.VBox(layout={"width": "100%", "min_width": "0"})
        self._picture = None
        self._take(fit)
        self._name.observe(lambda _: self._chosen_name(), names="value")
        self._joint.observe(lambda _: self._chosen(), names="value")
        for widget in (self._shown, self._of):
            widget.observe(lambda _: self._chosen_view(), names="value")
        self._again.observe(lambda _: self._moved(), names="value")
        self._best.on_click(lambda _: self.to_best())
        self._full.on_click(lambda _: self.refit())
        left = widgets.VBox(
            [
                self._name,
                self._joint,
                self._box,
                self._again,
                widgets.HBox([self._best, self._full]),
                self._errors,
                self._said,
                self._added,
            ],
            layout={"width": "370px", "flex": "0 0 auto", "padding": "0 12px 0 0"},
        )
        views = widgets.HBox([self._shown, self._of])
        right = widgets.VBox([views, self._figure], layout={"flex": "1 1 420px", "min_width": "0"})
        self.widget = widgets.HBox([left, right], layout={"width": "100%", "flex_flow": "row wrap"})

    @property
    def effect(self) -> AbstractEffect:
        """The effect at the sliders' values."""
        return self._sliders.effect

    @property
    def figure(self) -> Any:
        """The plotly widget that is shown."""
        assert self._picture is not None
        return self._picture.widget

    def choose(self, name: str, joint: int | None = None) -> None:
        """Selects another effect, at zero amplitude.

        **Arguments:**

        - `name`: as in tables. `joint`: counted from 1; None for an effect of the whole arm.

        **Raises:** `ModelError` if the catalogue does not offer it.
        """
        of_name = {key: v for key, v in self._offered.items() if v[0][0] == name}
        if not any(j == joint for _, j, _ in (f for v in of_name.values() for f in v)):
            raise ModelError(f"{effect_on(name, joint)} is not in the list of effects")
        self._name.value = next(k for k, v in of_name.items() if any(f[1] == joint for f in v))
        self._joint.value = joint if joint is not None else _ALL

    def move(self, **values: float) -> None:
        """Moves sliders by the names of their parameters.

        **Raises:** `ModelError` if there is no such slider.
        """
        sliders = {w.description.split(" (")[0]: w for w in self._sliders.widgets}
        for name, value in values.items():
            if name not in sliders:
                raise ModelError(f"there is no slider {name}: there are {', '.join(sliders)}")
            sliders[name].value = value

    def to_best(self) -> None:
        """Moves the sliders to the values that minimise the residual of the linear system."""
        self._say("searching for the best values")
        self._sliders.move_to(self._what_if.best(self.effect))

    def refit(self) -> None:
        """Fits the full model with the effect and continues with the result."""
        name = effect_on(self.effect.effect_name(), getattr(self.effect, "joint", None))
        self._say(f"fitting the model with {name} in full")
        self._full.disabled = True
        try:
            found = self._what_if.refit(self.effect)
            if not found.status.simulated:
                self._say(f"the fit with {name} {found.status.value}")
                return
            self._take(found)
            self._added.value += f"added {html.escape(name)}: the fit {found.status.value}<br>"
        except (JaxidError, KeyboardInterrupt) as error:
            self._say(str(error) or "interrupted, nothing was added")
        finally:
            self._full.disabled = False

    def _take(self, fit: Fit) -> None:
        """Sets a fitted model, its list of effects and its recordings."""
        self.fit, self._at = fit, None
        self._what_if = WhatIf.of(fit, self._validate, self._catalogue)
        self._before = self._what_if.answer(None)
        self._offered: dict[str, list[tuple]] = {}
        kinds: dict[str, set[str]] = {}
        for effect in self._what_if.settings:
            kinds.setdefault(effect.effect_name(), set()).add(type(effect).__name__)
        for effect in self._what_if.settings:
            key, kind = effect.effect_name(), type(effect).__name__
            of = ", ".join(getattr(effect, "recordings", ()))
            label = key.replace("_", " ") + (f" ({kind})" if len(kinds[key]) > 1 else "")
            label += f" in {of}" if of else ""
            forms = self._offered.setdefault(label, [])
            if form(effect) not in forms:
                forms.append(form(effect))
        seen = self._what_if.seen()
        views = [(f"{n} (fitted)", (False, k)) for k, n in enumerate(seen.names)]
        if self._validate is not None:
            beyond = self._what_if.seen(held_out=True).names
            views = [(f"{n} (held out)", (True, k)) for k, n in enumerate(beyond)] + views
        chosen = self._name.value
        self._shown.options, self._shown.value = views, views[0][1]
        joints = list(range(1, fit.loop.joints + 1))
        of = self._of.value if self._of.value in joints else 1
        self._of.options, self._of.value = joints, of
        self._name.options = list(self._offered)
        self._name.value = chosen if chosen in self._offered else next(iter(self._offered))
        self._chosen_name()
        self._chosen_view()

    def _chosen_name(self) -> None:
        joints = [j for _, j, _ in self._offered[self._name.value]]
        kept = self._joint.value
        options = [_ALL if j is None else j for j in joints]
        if list(self._joint.options) != options:
            self._joint.options = options
        self._joint.value = kept if kept in options else options[0]
        self._chosen()

    def _chosen(self) -> None:
        joint = None if self._joint.value == _ALL else self._joint.value
        asked = next(f for f in self._offered[self._name.value] if f[1] == joint)
        settings = [e for e in self._what_if.settings if form(e) == asked]
        effect = settings[len(settings) // 2]
        ranges = self._what_if.ranges(effect)
        self._sliders = Sliders(effect, ranges, self.fit.loop, self._moved)
        self._box.children = tuple(self._sliders.widgets)
        if joint is not None:
            self._of.value = joint
        self._moved()

    def _chosen_view(self) -> None:
        """Shows another recording or joint."""
        torque, position = self.fit.loop.arm.units()
        turned = self._what_if.predictor.system.row != 0
        joint = self._of.value
        held_out, recording = self._shown.value
        seen = self._what_if.seen(held_out)
        there = seen.there[recording]
        self._at = recording, there, joint - 1
        self._answered()
        signals = seen.time[recording, there], seen.measured[self._at], seen.simulated[self._at]
        name = f"{'position' if turned else 'torque'} of joint {joint}"
        unit = (position if turned else torque)[joint - 1]
        if self._picture is None:
            self._picture = Picture(*signals, self._rest, name, unit)
            self._figure.children = (self._picture.widget,)
        else:
            self._picture.show(*signals, self._rest, name, unit)

    def _moved(self) -> None:
        """Updates the answer, in figure and table, after sliders have moved."""
        if self._at is None or self._picture is None:
            return
        began = time.perf_counter()
        self._answered()
        self._picture.follow(self._rest)
        self.milliseconds = 1e3 * (time.perf_counter() - began)
        said = f"answered in {self.milliseconds:.0f} ms"
        self._say(said if self.answer.possible else "the loop diverges with these values")

    def _answered(self) -> None:
        assert self._at is not None
        self.answer = self._what_if.answer(self.effect, self._again.value)
        rest = self.answer.held_out if self._shown.value[0] else self.answer.fitted
        assert rest is not None
        self._rest = rest[self._at]
        self._errors.value = _table(self._before, self.answer)

    def _say(self, text: str) -> None:
        self._said.value = f'<span style="opacity:.7">{html.escape(text)}</span>'

    def _ipython_display_(self) -> None:
        from IPython.display import display  # type: ignore[import-not-found]

        if self._picture is not None and self._picture.changed:
            # Changes are lost before the figure is on the screen, so it is made again.
            self._picture = None
            self._chosen_view()
        display(self.widget)


def _table(before: Answer, now: Answer) -> str:
    """Relative errors of the fitted model without and with the effect."""
    joints = len(before.fitted_percent)
    head = "".join(f"<th>joint {j}</th>" for j in range(1, joints + 1))
    rows = [
        ("fitted", before.fitted_percent, now.fitted_percent),
        ("held out", before.held_out_percent, now.held_out_percent),
    ]
    body = "".join(
        f"<tr><th>{name}</th>{''.join(_cell(a, b) for a, b in zip(was, found, strict=True))}</tr>"
        for name, was, found in rows
        if was is not None and found is not None
    )
    style = (
        "<style>.jaxid-errors td,.jaxid-errors th{padding:2px 10px 2px 0;text-align:right;"
        "font-variant-numeric:tabular-nums}</style>"
    )
    return (
        f'{style}<table class="jaxid-errors"><tr><th>error, %</th>{head}</tr>{body}</table>'
        "as fitted → with the effect"
    )


def _cell(was: float, now: float) -> str:
    weight = "bold" if now < was - 5e-4 else "normal"
    return f'<td>{was:.3f} → <span style="font-weight:{weight}">{now:.3f}</span></td>'
