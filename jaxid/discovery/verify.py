"""Full nonlinear fits of models with sets of effects."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, AbstractTransmission
from ..estimate import OEM, Fit, SeparablePEM, Status, fit
from ..noise import ARFilter
from ..parameters import Bounds, read_values, write_values
from ..recording import Recordings
from ..simulation.dynamics import imposed
from ..simulation.loop import ClosedLoop
from .diagnosis import over_recordings
from .hypotheses import free_of
from .likelihood import noise_filters, price_of_value, score_of
from .signs import from_usual_signs, has_one_sign, of_one_sign, reshaped

# Factor on the gap at the start of another refit. In a wide gap the link moves freely for longer,
# so that all parameters of the contact influence the motion.
_WIDE = 10.0
# Ratio of what an effect explains to its price above which no refit without it is made; the same if
# the sign of its friction may change, which can replace it.
_CERTAIN, _RESHAPED = 3.0, 10.0
# Ratio of actual to predicted decrease of the score above which, or below whose inverse, the refit
# is repeated from another start.
_FAR = 2.0
# Eigenvalues of correlations of estimates, relative to the largest, below which they are rounding.
_SINGULAR = 1e-10
# Ratio of a residual after the start to the later one above which the initial state is wrong.
_APART = 3.0
# Largest number of refits in which frictions take the estimated sign of their joint.
_SIGN_TURNS = 6
# Change of the score below which the shape of the sign does not matter, and two fits of the same
# effects without filters are in the same minimum.
_LITTLE = 1.0
# Ratio of errors with and without filters above which filters model an error of the model as
# noise.
_STRAYS = 1.5


class Refits(eqx.Module):
    """Fits on the same recordings by the same method, compared by the same score.

    - `before`: relative error by joint of the starting model's fit, %; None before that fit.
    """

    recordings: Recordings
    method: OEM
    before: Float[np.ndarray, " joints"] | None = None

    def first(self, loop: ClosedLoop) -> Fit:
        """The fit of the starting model."""
        return fit(loop, self.recordings, quiet(self.method))

    def filtered(self, loop: ClosedLoop, noise: Sequence[ARFilter]) -> Fit:
        """A fit with noise filters, from the loop's values; efficient for coloured noise.

        Frictions of one joint have one sign. A fit estimates the shape of that of Coulomb friction,
        so it is repeated until the others have the same. They move half of the way each time,
        because a smoother sign of one friction makes that of another one sharper.

        The error can have another minimum where a sign jumps, because samples then do not determine
        its form, and where it is a ramp. Along an imposed motion a fit that ends there is repeated
        from a usual shape.
        """
        found = self._with_one_sign(loop, noise)
        usual = from_usual_signs(found.loop)
        if not found.status.simulated or usual is None or not imposed(found.loop):
            return found
        again = self._with_one_sign(usual, noise)
        return self.best([found, again]) if again.status.simulated else found

    def _with_one_sign(self, loop: ClosedLoop, noise: Sequence[ARFilter]) -> Fit:
        """A fit, repeated until the frictions of each joint have one sign."""
        found = self._filtered(loop, noise)
        for _ in range(_SIGN_TURNS):
            if not found.status.simulated or has_one_sign(found.loop):
                break
            again = self._filtered(of_one_sign(found.loop, share=0.5), noise)
            if not again.status.simulated:
                break
            gained = score_of(found).value - score_of(again).value
            found = again if gained > 0 else found
            if gained < _LITTLE:
                break
        return found

    def _filtered(self, loop: ClosedLoop, noise: Sequence[ARFilter]) -> Fit:
        """A fit with noise filters, repeated without them where they hide an error of the model.

        A filter ignores as many rows after the start as its order. If the residual is large there,
        the initial state is wrong, and the filter may model how it decays. The fit is then repeated
        from one without filters.

        An error of the model that filters model as noise costs little, so the fit can leave more of
        it than it has to. If a joint's error is much larger than that of the starting model, the
        fit is repeated without filters.
        """
        found = fit(loop, self.recordings, SeparablePEM(self.given(), filters=tuple(noise)))
        if found.status.simulated and any(f.order for f in noise) and self._strays(found):
            plain = self.unfiltered(loop, noise)
            found = plain if plain.status.simulated else found
        if not found.status.simulated or not _starts_apart(found.residuals, noise):
            return found
        plain = self.unfiltered(found.loop, noise)
        if not plain.status.simulated:
            return found
        own = SeparablePEM(self.given(), filters=noise_filters(plain.residuals))
        return self.best([found, fit(plain.loop, self.recordings, own)])

    def _strays(self, found: Fit) -> bool:
        """Whether a joint's error is much larger than that of the starting model."""
        if self.before is None:
            return False
        return bool(np.any(over_recordings(found.error_percent.to_numpy()) > _STRAYS * self.before))

    def given(self) -> OEM:
        """The output-error method that starts from the loop's values."""
        return dataclasses.replace(quiet(self.method), start="given")

    def with_effects(
        self,
        before: Fit,
        effects: Sequence[AbstractEffect],
        noise: Sequence[ARFilter],
        promised: float = 0.0,
    ) -> Fit:
        """The best refit of a fitted model with additional effects, from several starts if needed.

        The linear system predicts transmissions and limits least precisely. Noise filters can keep
        their fit from the minimum, so another refit starts from a fit without filters. A contact
        with a held stiffness has many local minima, so further refits start with the stiffness
        free. If the score decreases much more or much less than predicted, the refit is repeated
        from a fit that assumes white noise; of several effects, also from fits of one after the
        other, in both orders.

        **Arguments:**

        - `promised`: predicted decrease of the score.
        """
        loop = of_one_sign(before.loop.add(*map(_inside, effects)))
        tried: list[Fit] = []
        held: tuple[str, ...] = ()
        if any(e.finite for e in effects):
            tried.append(self.unfiltered(loop, noise))
            held = held_shapes(loop, len(effects))
        if any(e.contact for e in effects):
            for factor in (1.0, _WIDE):
                scaled = [_inside(e.scaled(factor)) if e.contact else _inside(e) for e in effects]
                apart = of_one_sign(before.loop.add(*scaled)).free(*held)
                tried.append(self.unfiltered(apart, noise))
        starts = [loop, *(fit.loop for fit in _promising(before, tried))]
        best = self.best([self.filtered(start, noise) for start in starts])
        gained = score_of(before).value - score_of(best).value
        if not tried and not promised / _FAR < gained < promised * _FAR:
            # A fit that strays has been repeated without filters already.
            tried.append(best if _is_plain(best) else self.unfiltered(loop, noise))
            best = self.best([best, self.filtered(tried[-1].loop, noise)])
        for order in (effects, effects[::-1]) if len(effects) > 1 else ():
            if score_of(before).value - score_of(best).value < promised / _FAR:
                plain = self.in_turn(before, order, noise)
                if not _ends_as(plain, tried):
                    best = self.best([best, self.filtered(plain.loop, noise)])
                tried.append(plain)
        loose = [name for name in held if name not in best.loop.names]
        if loose:
            best = self.best([best, self.filtered(best.loop.free(*loose), noise)])
        return best

    def in_turn(
        self, before: Fit, effects: Sequence[AbstractEffect], noise: Sequence[ARFilter]
    ) -> Fit:
        """A fit with additional effects, of which each is fitted before the next is added.

        Two large effects at once may be too far from the minimum for a fit to converge.
        """
        found = before
        for effect in effects:
            found = self.with_one(found.loop, effect, noise)
        return found

    def with_one(self, loop: ClosedLoop, effect: AbstractEffect, noise: Sequence[ARFilter]) -> Fit:
        """The fit of a loop with one more effect under the assumption of white noise."""
        return self.unfiltered(of_one_sign(loop.add(_inside(effect))), noise)

    def unfiltered(self, loop: ClosedLoop, noise: Sequence[ARFilter]) -> Fit:
        """The fit of the loop under the assumption of white noise, a start for further fits.

        Filters that were estimated without an effect can remove its torque from the comparison. The
        compiled program is that of fits with filters.
        """
        return self._filtered(loop, [ARFilter(np.zeros(0), f.variance * f.gain) for f in noise])

    def best(self, found: Sequence[Fit]) -> Fit:
        """The fit with the lowest score, of several fits of one set of effects."""
        return min(found, key=lambda f: score_of(f).value)


def _is_plain(found: Fit) -> bool:
    """Whether a fit assumes white noise."""
    return isinstance(found.noise, tuple) and all(f.order == 0 for f in found.noise)


def _ends_as(plain: Fit, tried: Sequence[Fit]) -> bool:
    """Whether a fit without filters ends in the minimum of an earlier one."""
    ends = [score_of(f).value for f in tried if f.status.simulated]
    own = score_of(plain).value
    return plain.status.simulated and any(abs(own - end) < _LITTLE for end in ends)


def _promising(before: Fit, tried: Sequence[Fit]) -> list[Fit]:
    """The fits without filters that explain at least half as much as the best one of them.

    A fit takes most of a minute if parts collide. One that ends in another minimum does not leave
    it because of filters.

    **Arguments:**

    - `before`: the fit without the effects.
    """
    usable = [f for f in tried if f.status.simulated and f.status is not Status.misfit]
    if not usable:
        return []
    gained = [score_of(before).value - score_of(f).value for f in usable]
    least = max(gained) / _FAR if max(gained) > 0 else max(gained)
    return [f for f, g in zip(usable, gained, strict=True) if g >= least]


def quiet(method: OEM) -> OEM:
    """The method without its progress lines."""
    return dataclasses.replace(method, progress=False)


def held_shapes(loop: ClosedLoop, last: int) -> tuple[str, ...]:
    """Names of parameters that are held by declaration, of transmissions among the last effects.

    **Arguments:**

    - `last`: number of last effects to consider.
    """
    first = len(loop.effects) - last
    return tuple(
        p.name
        for p in loop.parameters
        if p.place[0] == "effects"
        and int(p.place[1]) >= first
        and isinstance(loop.effects[int(p.place[1])], AbstractTransmission)
        and not p.declaration.free
    )


def _inside(effect: AbstractEffect) -> AbstractEffect:
    """The effect with parameters at or beyond their bounds moved just inside."""
    chosen = free_of(effect)
    if not chosen:
        return effect
    values = Bounds.of(chosen).moved_inside(read_values(effect, chosen))
    return write_values(effect, chosen, values)


def _starts_apart(
    residuals: Sequence[Float[np.ndarray, "_samples outputs"]], noise: Sequence[ARFilter]
) -> bool:
    """Whether residuals are much larger in the first rows, which filters ignore, than later."""
    for rest in residuals:
        for output, filt in zip(rest.T, noise, strict=True):
            # Rows that are not compared are zero.
            first, later = (x[x != 0] ** 2 for x in (output[: filt.order], output[filt.order :]))
            if len(first) and len(later) and first.mean() > _APART**2 * later.mean():
                return True
    return False


def needed(fit: Fit, effect: AbstractEffect, price: float) -> bool:
    """Whether amplitudes are so significant that a refit without the effect cannot be better.

    **Arguments:**

    - `price`: decrease of the price of the choice without the effect.
    """
    place = next(k for k, e in enumerate(fit.loop.effects) if e is effect)
    places = values_of(fit.loop, place)
    own = [k for k, linear in places if linear]
    if effect.finite or not own:
        return False
    # The increase of the squared error without the effect, and the decrease of the price.
    lost = wald(fit, own)
    saved = len(places) * price_of_value(fit) + price
    return bool(lost > (_RESHAPED if reshaped(fit.loop, effect) else _CERTAIN) * saved)


def wald(fit: Fit, places: Sequence[int]) -> float:
    """Wald's statistic of some values of `theta`; 0 if the recordings do not determine them.

    It is the increase of the whitened squared error if these values are zero.
    """
    std, own = fit.std[list(places)], np.ix_(places, places)
    if not np.isfinite(std).all():
        return 0.0
    size = np.where(std > 0, std, 1.0)
    values = np.asarray(fit.theta)[list(places)] / size
    correlation = fit.covariance[own] / np.outer(size, size)
    return float(values @ np.linalg.pinv(correlation, _SINGULAR, hermitian=True) @ values)


def values_of(loop: ClosedLoop, place: int) -> list[tuple[int, bool]]:
    """The places of an effect's values in `theta`, each with whether torque is linear in it."""
    at, own = 0, []
    for p in loop.free_parameters:
        if p.place[0] == "effects" and int(p.place[1]) == place:
            own += [(k, p.declaration.linear) for k in range(at, at + p.size)]
        at += p.size
    return own
