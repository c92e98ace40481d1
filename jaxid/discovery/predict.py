"""Predictions of sets of effects in the linear system: the residual that a full refit would leave.

Along a run the loop is a linear system, and an effect is a torque on it. The values of the effects,
of the loop's own parameters and of the initial states are estimated there: those of the base
(parameters and initial states) by projection, those of the effects by damped Gauss-Newton steps. No
model that contains the effects is compiled.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..effects.placed import Placed
from ..estimate.minimise import Filling, Stopping, Sums, descend
from ..noise import ARFilter
from ..parameters import Bounds, read_values, write_values
from .bounded import least_squares
from .data import Data
from .finite import differences
from .forces import force_and_slopes, misreads, torques_of
from .hypotheses import free_of
from .linear import Place, at_samples, respond
from .score import spanned
from .system import System
from .table import SignatureTable

# Columns of one response. Missing columns are filled with zeros, so that few programs are compiled.
_WIDTH = 8
# Relative step of the finite differences for effects that are simulated at a finite size.
_MOVED = 1e-4


class Prediction(eqx.Module):
    """A set of effects with estimated values, in the linear system.

    - `rest`: the residual with the effects, not whitened.
    - `residual`: the whitened residual minus what the base absorbs. `loss`: its squared norm.
    - `moved`: derivatives of the output by the values of the effects. `slopes`: the whitened
      derivatives minus what the base absorbs.
    - `taken`: changes of the base's values.
    - `freedom`: number of estimated values, with those of the base.
    - `possible`: whether no amplitude is at a bound, and the response of the loop is finite.
    """

    effects: tuple[AbstractEffect, ...]
    rest: Float[np.ndarray, "recordings samples outputs"]
    residual: Float[np.ndarray, " rows"]
    moved: Float[np.ndarray, "recordings samples outputs values"]
    slopes: Float[np.ndarray, "rows values"]
    taken: Float[np.ndarray, " absorbed"]
    loss: float
    freedom: int
    possible: bool


class Predictor(eqx.Module):
    """A linear system with noise filters, in which sets of effects are predicted.

    - `basis`: orthonormal basis of the span of the whitened base. `base`: the whitened base in it.
    - `limits`: smallest and largest change of the base's values.
    - `rank`: number of the base's values that the recordings determine.
    """

    system: System
    data: Data
    noise: tuple[ARFilter, ...]
    basis: Float[np.ndarray, "rows rank"]
    base: Float[np.ndarray, "rank absorbed"]
    limits: tuple[Float[np.ndarray, " absorbed"], Float[np.ndarray, " absorbed"]]
    rank: int

    @classmethod
    def of(cls, system: System, noise: Sequence[ARFilter], level: Any = None) -> "Predictor":
        """The predictor of a system.

        **Arguments:**

        - `noise`: noise filters, one per output.
        - `level`: noise level of each recording, as in `Data`.
        """
        none = SignatureTable.of(np.zeros((*system.residual.shape, 0)))
        data = Data(system.residual, system.base, none, system.mask, level, known=system.known)
        base = data.white_columns(system.base, noise, slice(None))
        loop = system.loop
        bounds, theta = Bounds.of(loop.free_parameters), np.asarray(loop.theta)
        free = np.full(base.shape[1] - len(theta), np.inf)
        lower = np.append(np.minimum(np.asarray(bounds.lower) - theta, 0.0), -free)
        upper = np.append(np.maximum(np.asarray(bounds.upper) - theta, 0.0), free)
        basis = spanned(base)
        rows = len(base) - len(data.known_left())
        rank = basis.shape[1] if rows == len(base) else spanned(base[:rows]).shape[1]
        return cls(system, data, tuple(noise), basis, basis.T @ base, (lower, upper), rank)

    def predict(self, effects: Sequence[AbstractEffect], steps: int = 20) -> Prediction:
        """A set of effects with their values estimated together, from their current values.

        **Arguments:**

        - `effects`: effects that the system's own loop does not contain.
        - `steps`: largest number of evaluated points.
        """
        effects = tuple(effects)
        if not effects:
            return self._ended(self._reached(()))
        free = [p for e in effects for p in free_of(e)]
        bounds = Bounds.of(free)
        first = np.clip(_values(effects), bounds.lower, bounds.upper)
        fill = Filling(parameters=len(first), recordings=0, estimated=0)

        def at(y) -> "_Reached":
            return self._reached(_with_values(effects, fill.emptied(y)[0]))

        y = fill.unknowns((first, np.zeros((0, 0))))
        rows = int(self.data.compared.sum())
        limits = bounds.lower, bounds.upper
        settings = Stopping(tolerance=0.05, max_steps=steps)
        found, _, _ = descend(at, at(y), y, limits, fill, rows, settings)
        return self._ended(found)

    def change(self, effect: AbstractEffect) -> Float[np.ndarray, "recordings samples outputs"]:
        """Change of the output by an effect, N·m or N (rad or m in an open loop)."""
        if not effect.finite:
            return self.shown(effect)[..., 0]
        system = self.system
        nominal = system.linear.seen[:, :, system.row]
        (found,) = differences(system.loop, system.batch, [effect], system.row, nominal)
        return at_samples(system.batch, np.asarray(found))

    def absorbed(
        self, left: Float[np.ndarray, "recordings samples outputs"]
    ) -> Float[np.ndarray, " absorbed"]:
        """Changes of the base's values that explain most of a residual."""
        white = self.data.white_residual(left, self.noise)
        return least_squares(self.basis.T @ white, self.base, self.limits)[0]

    def _reached(self, effects: tuple[AbstractEffect, ...]) -> "_Reached":
        shown = [self.shown(effect) for effect in effects]
        none = np.zeros((*self.data.residual.shape, 1))
        value = sum((s[..., 0] for s in shown), none[..., 0])
        slopes = np.concatenate([none[..., 1:], *(s[..., 1:] for s in shown)], axis=-1)
        both = np.concatenate([(self.data.residual - value)[..., None], -slopes], axis=-1)
        # A diverging response is rejected as a step.
        there = bool(np.isfinite(both).all())
        both = both if there else np.zeros_like(both)
        white = self.data.white_columns(both, self.noise)
        known = self.data.known_left()
        white[len(white) - len(known) :, 0] = known
        # Coordinates in the span of the whitened base, to which changes of the base are restricted.
        within = self.basis.T @ white
        taken, free = least_squares(within[:, 0], self.base, self.limits)
        absorbed = within.copy()
        absorbed[:, 0] = self.base @ taken
        if not free.all():
            open_ = spanned(self.base[:, free])
            absorbed[:, 1:] = open_ @ (open_.T @ within[:, 1:])
        before = np.linalg.norm(white, axis=0)
        white = white - self.basis @ absorbed
        # A column that the base absorbs consists of rounding errors now; it is set to zero.
        white[:, 1:] *= np.linalg.norm(white[:, 1:], axis=0) > 1e-7 * before[1:]
        gram = white.T @ white
        loss = gram[0, 0] if there else np.inf
        sums = Sums(
            loss=np.array([loss]),
            gram=gram[None, 1:, 1:],
            slope=gram[None, 1:, 0],
            start_gram=np.zeros((1, 0, 0, 0)),
            start_slope=np.zeros((1, 0, 0)),
            cross=np.zeros((1, 0, 0, len(gram) - 1)),
        )
        return _Reached(effects, value, slopes, white, taken, sums, np.asarray(loss))

    def shown(
        self, effect: AbstractEffect
    ) -> Float[np.ndarray, "recordings samples outputs columns"]:
        """Change of the output by an effect, and its derivatives.

        The first column is the change, N·m or N (rad or m in an open loop). The others are its
        derivatives by the free parameters of the effect.
        """
        if effect.finite:
            return self._by_simulation(effect)
        system = self.system
        placed = Placed.of(effect, system.loop.joints)
        push, noise, rate = force_and_slopes(placed, system.linear.motion, system.left)
        shown = self._through(self._place(effect), push)
        if misreads(effect):
            shown = shown + self._through("noise", noise) + self._through("rate", rate)
        return shown

    def shown_together(
        self, effects: Sequence[AbstractEffect]
    ) -> Float[np.ndarray, "recordings samples outputs effects"]:
        """Changes of the output by effects of one structure that act on the joint's torque."""
        push = torques_of(effects, self.system.linear.motion, self.system.left)
        return self._through(self._place(effects[0]), push)

    def _place(self, effect: AbstractEffect) -> Place:
        return "pull" if effect.on_link and "pull" in self.system.linear.places else "push"

    def _through(self, place: Place, columns) -> np.ndarray:
        count = columns.shape[-1]
        blocks = []
        for at in range(0, count, _WIDTH):
            some = columns[..., at : at + _WIDTH]
            wide = np.pad(some, [(0, 0)] * (some.ndim - 1) + [(0, _WIDTH - some.shape[-1])])
            blocks.append(respond(self.system.linear, place, jax.device_put(wide)))
        return at_samples(self.system.batch, np.concatenate(blocks, axis=-1)[..., :count])

    def _by_simulation(self, effect: AbstractEffect) -> np.ndarray:
        free = free_of(effect)
        values = np.asarray(read_values(effect, free))
        scale = np.array([p.declaration.scale for p in free])
        by = _MOVED * np.maximum(np.abs(values), 1e-3 * scale)
        moved = [write_values(effect, free, values + d) for d in np.diag(by)]
        system = self.system
        nominal = system.linear.seen[:, :, system.row]
        first, *others = differences(
            system.loop, system.batch, [effect, *moved], system.row, nominal
        )
        # A run that diverges has infinite slopes, and its effect is not predicted.
        with np.errstate(over="ignore", invalid="ignore"):
            columns = [first, *((x - first) / d for x, d in zip(others, by, strict=True))]
        return at_samples(system.batch, np.stack(columns, axis=-1))

    def _ended(self, found: "_Reached") -> Prediction:
        there = np.isfinite(found.loss)
        left = self.data.residual - (found.value if there else 0.0)
        rest = (left - self.system.base @ found.taken) * self.data.mask[..., None]
        free = [p for e in found.effects for p in free_of(e)]
        values, bounds = _values(found.effects), Bounds.of(free)
        amplitude = np.array([p.declaration.linear for p in free for _ in range(p.size)], bool)
        inside = (values > np.asarray(bounds.lower)) & (values < np.asarray(bounds.upper))
        # The effect to which each value belongs.
        owner = np.array(
            [k for k, e in enumerate(found.effects) for p in free_of(e) for _ in range(p.size)], int
        )
        # An effect whose amplitudes are all at a bound has no torque, or too much of it.
        sized = {*owner[amplitude]} <= {*owner[amplitude & inside]}
        return Prediction(
            effects=found.effects,
            rest=rest,
            residual=found.white[:, 0],
            moved=found.moved,
            slopes=-found.white[:, 1:],
            taken=found.taken,
            loss=float(found.loss),
            # A value that the base absorbs is not determined.
            freedom=self.rank + int(np.count_nonzero(found.white[:, 1:].any(axis=0))),
            possible=bool(there) and sized,
        )


class _Reached(eqx.Module):
    """Output, derivatives and sums of squares at some values of the effects' parameters."""

    effects: tuple[AbstractEffect, ...]
    value: np.ndarray
    moved: np.ndarray
    white: np.ndarray
    taken: np.ndarray
    sums: Sums
    loss: Float[np.ndarray, ""]


def _values(effects: Sequence[AbstractEffect]) -> Float[np.ndarray, " values"]:
    return np.concatenate([np.zeros(0), *(np.asarray(read_values(e, free_of(e))) for e in effects)])


def _with_values(
    effects: tuple[AbstractEffect, ...], values: Float[np.ndarray, " values"]
) -> tuple[AbstractEffect, ...]:
    made, at = [], 0
    for effect in effects:
        free = free_of(effect)
        count = sum(p.size for p in free)
        made.append(write_values(effect, free, values[at : at + count]))
        at += count
    return tuple(made)
