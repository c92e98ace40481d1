"""A slider for each free parameter of an effect."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..discovery.hypotheses import free_of
from ..effects import AbstractEffect
from ..parameters import read_values, write_values
from ..simulation.loop import ClosedLoop

# A slider is logarithmic above this ratio of its ends; number of steps.
_LOG, _STEPS = 10.0, 400


class Sliders:
    """Sliders for the values of one effect, and the effect at these values."""

    def __init__(
        self,
        effect: AbstractEffect,
        ranges: Mapping[str, tuple[float, float]],
        loop: ClosedLoop,
        moved: Callable[[], None],
    ) -> None:
        self._effect, self._free = effect, free_of(effect)
        self._moved, self._quiet = moved, False
        values = np.asarray(read_values(effect, self._free)) if self._free else np.zeros(0)
        labels = [x for p in self._free for x in zip(p.names, loop.units(p), strict=True)]
        self.widgets = [
            _slider(name, unit, float(value), *ranges[name])
            for (name, unit), value in zip(labels, values, strict=True)
        ]
        for slider in self.widgets:
            slider.observe(self._on_move, names="value")

    @property
    def effect(self) -> AbstractEffect:
        """The effect at the values of the sliders."""
        values = jnp.asarray([float(slider.value) for slider in self.widgets])
        return write_values(self._effect, self._free, values) if self._free else self._effect

    def move_to(self, effect: AbstractEffect) -> None:
        """Sets the sliders to the values of another effect; their ranges are widened if needed."""
        # The answer is computed once for all sliders instead of once for each.
        self._quiet = True
        try:
            for slider, value in zip(
                self.widgets, np.asarray(read_values(effect, self._free)), strict=True
            ):
                power = hasattr(slider, "base")
                end = np.log10(max(value, 1e-300)) if power else value
                slider.max, slider.min = max(slider.max, end), min(slider.min, end)
                slider.value = float(value)
        finally:
            self._quiet = False
        self._moved()

    def _on_move(self, _: Any) -> None:
        if not self._quiet:
            self._moved()


def _slider(name: str, unit: str, value: float, low: float, high: float) -> Any:
    import ipywidgets

    look = {
        "description": name if unit == "1" else f"{name} ({unit})",
        "readout_format": ".4g",
        "style": {"description_width": "120px"},
        "layout": {"width": "100%"},
        "continuous_update": True,
    }
    if low > 0 and high > _LOG * low:
        low, high = np.log10(low), np.log10(high)
        value = float(np.clip(value, 10**low, 10**high))
        step = (high - low) / _STEPS
        return ipywidgets.FloatLogSlider(value=value, min=low, max=high, step=step, **look)
    value, step = float(np.clip(value, low, high)), (high - low) / _STEPS
    return ipywidgets.FloatSlider(value=value, min=low, max=high, step=step, **look)
