"""Predictions of a fitted model with an additional effect, at values that the user sets.

The linear system (`linear.py`, `predict.py`) gives them in milliseconds: no model with the effect
is compiled or simulated.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..effects import AbstractEffect
from ..effects import catalogue as known
from ..estimate import Fit
from ..estimate.oem import oem_of
from ..noise import ARFilter
from ..parameters import Bounds, read_values, write_values
from ..recording import Recording, Recordings
from .bounded import least_squares
from .comparison import Comparison, compare
from .data import whitened
from .diagnosis import over_recordings, share_left
from .hypotheses import amplitudes, free_of
from .landscape import form
from .linear import at_rows
from .predict import Prediction, Predictor
from .score import spanned
from .screening import offered
from .system import System
from .verify import Refits

# Range of amplitudes, as a multiple of the least-squares estimate.
_WIDE = 3.0


class Seen(eqx.Module):
    """Compared signals of some recordings; zero for padding.

    - `time`: s. `measured`, `simulated`: N·m or N (rad or m in an open loop), by the fitted model.
    - `there`: rows that are compared samples.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    time: Float[np.ndarray, "recordings rows"]
    measured: Float[np.ndarray, "recordings rows outputs"]
    simulated: Float[np.ndarray, "recordings rows outputs"]
    there: Bool[np.ndarray, "recordings rows"]


class Answer(eqx.Module):
    """The predicted residual of a model with an effect.

    - `fitted`, `held_out`: measured minus predicted, as in `Seen`; None without such recordings.
    - `fitted_percent`, `held_out_percent`: relative errors by joint, %.
    - `possible`: whether all amplitudes are within their bounds, and the loop does not diverge.
    """

    effect: AbstractEffect | None
    fitted: Float[np.ndarray, "recordings rows outputs"]
    fitted_percent: Float[np.ndarray, " outputs"]
    held_out: Float[np.ndarray, "unseen unseen_rows outputs"] | None
    held_out_percent: Float[np.ndarray, " outputs"] | None
    possible: bool


class WhatIf(eqx.Module):
    """A fitted model along its recordings and others, prepared for trials of effects.

    - `settings`: the effects of the catalogue that suit the model, at each of their settings.
    - `absorbed`: change of the model's own values without an effect, almost zero for a converged
      fit.
    """

    fit: Fit
    comparison: Comparison | None
    predictor: Predictor
    unseen: Predictor | None
    settings: tuple[AbstractEffect, ...]
    absorbed: Float[np.ndarray, " absorbed"]

    @classmethod
    def of(
        cls,
        fit: Fit,
        validate: Recording | Recordings | Iterable[Recording] | None = None,
        catalogue: Sequence[Any] = known,
    ) -> "WhatIf":
        """Linearises a fitted model along its recordings, and along held-out ones.

        **Arguments:**

        - `fit`: fit of a loop that can be simulated. `validate`: held-out recordings.
        - `catalogue`: as for `diagnose`.

        **Raises:** `FitError` if the fitted loop cannot be simulated.
        """
        system = System.of(fit)
        noise = _weights(fit, system)
        _, proposed = offered(system, fit.recordings, catalogue)
        comparison = None if validate is None else compare(fit, validate)
        unseen = None if comparison is None else Predictor.of(System.of(comparison), noise)
        settings = tuple(effect for effect, _ in proposed)
        predictor = Predictor.of(system, noise)
        absorbed = predictor.absorbed(system.residual)
        return cls(fit, comparison, predictor, unseen, settings, absorbed)

    def seen(self, held_out: bool = False) -> Seen:
        """The signals of the fitted recordings, or of the held-out ones."""
        predictor = self.unseen if held_out else self.predictor
        of = self.comparison if held_out else self.fit
        assert predictor is not None
        assert of is not None
        system, batch = predictor.system, predictor.system.batch
        signal = batch.tau if system.row == 0 else batch.q
        measured = np.asarray(signal) * np.asarray(batch.mask)[..., None]
        # The system's band advances simulated signals by the delay; measured ones stay.
        measured = np.asarray(batch.compared(measured, -of.loop.controller.late))
        measured = measured * system.mask[..., None]
        time = np.asarray(at_rows(batch, system.linear.motion.t))
        names = tuple(of.recordings.names)
        if len(names) != len(time):
            names = tuple(f"window {k}" for k in range(1, len(time) + 1))
        return Seen(names, time, measured, measured - system.residual, system.mask)

    def answer(self, effect: AbstractEffect | None, again: bool = True) -> Answer:
        """Predicted residual of the model with an effect at these values.

        **Arguments:**

        - `effect`: an effect that is not in the loop; None for the fitted model.
        - `again`: whether the model's own parameters are estimated again with the effect, as in a
          refit; otherwise they keep their fitted values.
        """
        rest, there = _left(self.predictor, effect)
        taken = np.zeros(self.predictor.base.shape[1])
        if again and effect is not None:
            # Relative to the change without an effect, so an effect of zero size changes nothing.
            taken = self.predictor.absorbed(rest) - self.absorbed
            rest = _without(self.predictor, rest, taken)
        percent = _percent(self.fit, self.predictor, rest)
        if self.unseen is None or self.comparison is None:
            return Answer(effect, rest, percent, None, None, there)
        beyond, everywhere = _left(self.unseen, effect)
        if again and effect is not None:
            own = taken[: len(self.predictor.system.loop.theta)]
            beyond = _beyond(self.unseen, beyond, own)
        unseen_percent = _percent(self.comparison, self.unseen, beyond)
        return Answer(effect, rest, percent, beyond, unseen_percent, there and everywhere)

    def best(self, like: AbstractEffect) -> AbstractEffect:
        """An effect at the values of smallest squared error, refined from each of its settings.

        **Arguments:**

        - `like`: any of its settings.
        """
        found: list[Prediction] = [
            self.predictor.predict((self.sized(e),)) for e in self.settings_of(like)
        ]
        possible = [p for p in found if p.possible] or found
        return min(possible, key=lambda p: p.loss).effects[0]

    def settings_of(self, like: AbstractEffect) -> tuple[AbstractEffect, ...]:
        """The settings of one effect on one joint."""
        return tuple(e for e in self.settings if form(e) == form(like))

    def sized(self, effect: AbstractEffect) -> AbstractEffect:
        """The effect at its least-squares amplitudes within their bounds."""
        linear = amplitudes(effect)
        if not linear:
            return effect
        predictor = self.predictor
        columns = predictor.shown(effect)[..., 1:]
        names = [n for p in free_of(effect) for n in p.names]
        at = [names.index(n) for p in linear for n in p.names]
        data = predictor.data
        white = data.white_columns(columns[..., at], predictor.noise)
        left = data.white_residual(data.residual, predictor.noise)
        white = white - predictor.basis @ (predictor.basis.T @ white)
        basis = spanned(white)
        bounds = Bounds.of(linear)
        limits = np.asarray(bounds.lower), np.asarray(bounds.upper)
        values, _ = least_squares(basis.T @ left, basis.T @ white, limits)
        return write_values(effect, linear, jnp.asarray(values))

    def ranges(self, like: AbstractEffect) -> dict[str, tuple[float, float]]:
        """Useful range of each free parameter of an effect.

        Shapes cover the settings that a diagnosis screens, and half of that range on either side.
        Amplitudes cover three times the least-squares estimate.
        """
        settings = self.settings_of(like)
        middle = settings[len(settings) // 2]
        columns = self.predictor.shown(middle)[..., 1:]
        size = np.linalg.norm(columns.reshape(-1, columns.shape[-1]), axis=0)
        # The amplitude as large as the whole residual, and the least-squares estimate.
        whole = np.linalg.norm(self.predictor.data.residual) / np.maximum(size, 1e-300)
        sized = self.sized(middle)
        taken = np.abs(np.asarray(read_values(sized, free_of(sized)))) if len(whole) else whole
        asked = np.maximum(_WIDE * taken, whole / _WIDE)
        found, at = {}, 0
        for p in free_of(settings[0]):
            values = np.array([read_values(e, [p]) for e in settings])
            for k, label in enumerate(p.names):
                low, high = float(values[:, k].min()), float(values[:, k].max())
                d = p.declaration
                if d.linear and not settings[0].finite:
                    low, high = -float(asked[at]), float(asked[at])
                elif low > 0:
                    low, high = low / 2, 2 * high
                else:
                    reach = 0.5 * (high - low) or d.scale
                    low, high = low - reach, high + reach
                found[label] = max(low, d.lower), min(high, d.upper)
                at += 1
        return found

    def refit(self, effect: AbstractEffect) -> Fit:
        """The model with the effect, fitted in full from these values.

        **Raises:** `FitError`, `ModelError` if it cannot be fitted.
        """
        refits = Refits(self.fit.recordings, oem_of(self.fit))
        return refits.with_effects(self.fit, [effect], self.predictor.noise)


def _weights(fit: Fit, system: System) -> tuple[ARFilter, ...]:
    """The noise filters of a fit, scaled to its residual; white ones if it has none.

    A fit weights each output by its residual, independently of the level of its filters.
    """
    outputs = system.residual.shape[2]
    noise = (ARFilter(np.zeros(0), 1.0),) * outputs
    if isinstance(fit.noise, tuple) and len(fit.noise) == outputs:
        noise = tuple(ARFilter(f.coefficients, 1.0) for f in fit.noise)
    there = system.residual != 0
    rows = whitened(system.residual, noise, there)
    power = np.sum(rows**2, axis=(0, 1)) / np.maximum(there.sum(axis=(0, 1)), 1)
    return tuple(
        ARFilter(f.coefficients, float(max(x, 1e-300))) for f, x in zip(noise, power, strict=True)
    )


def _left(predictor: Predictor, effect: AbstractEffect | None) -> tuple[np.ndarray, bool]:
    """The residual with an effect, and whether the loop does not diverge with it."""
    residual = predictor.data.residual
    if effect is None:
        return residual, True
    rest = residual - predictor.change(effect)
    there = bool(np.isfinite(rest).all())
    return (rest if there else residual) * predictor.data.mask[..., None], there


def _without(predictor: Predictor, rest: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """The residual after a change of the base's values."""
    return (rest - predictor.data.base @ taken) * predictor.data.mask[..., None]


def _beyond(unseen: Predictor, rest: np.ndarray, own: np.ndarray) -> np.ndarray:
    """The residual of held-out recordings after a change of the loop's own parameters.

    Initial states, which follow these in the base, are estimated from the held-out recordings.
    """
    data = unseen.data
    rest = _without(unseen, rest, np.append(own, np.zeros(data.base.shape[-1] - len(own))))
    starts = data.base[..., len(own) :]
    if not starts.shape[-1]:
        return rest
    white = data.white(starts, unseen.noise).reshape(-1, starts.shape[-1])
    left = data.white(rest, unseen.noise).reshape(-1)
    return rest - starts @ np.linalg.lstsq(white, left, rcond=1e-9)[0]


def _percent(
    of: Fit | Comparison, predictor: Predictor, rest: np.ndarray
) -> Float[np.ndarray, " outputs"]:
    share = share_left(of, predictor.data, rest)
    return over_recordings(of.error_percent.to_numpy() * share)
