"""Effects added and refitted as full nonlinear models, and how well they do."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, AbstractTransmission, Coulomb
from ..estimate import OEM, Fit, SeparablePEM, Status, fit
from ..noise import ARFilter, fit_ar
from ..parameters import Bounds, list_parameters, read_values, write_values
from ..recording import Recordings
from ..simulation.loop import ClosedLoop
from .choices import transmissions_on
from .comparison import compare
from .diagnosis import Diagnosis, Verdict
from .hypotheses import amplitudes, effect_on
from .score import whitened
from .story import Contender, Step


class Refits(eqx.Module):
    """Refits on the same recordings by the same method, judged by the same measure."""

    recordings: Recordings
    held_out: Recordings | None
    method: OEM

    def refit(
        self, last: Step, leading: Sequence[Verdict], say: Callable[..., None]
    ) -> list[Contender]:
        """The leading entries as full nonlinear models, best first."""
        found = []
        for k, verdict in enumerate(leading):
            called = effect_on(*verdict.key)
            say(f"refit with {called}, {k + 1} of {len(leading)}", k / len(leading))
            method = self.whitened_method(last.diagnosis)
            fits = [fit(loop, self.recordings, method) for loop in self.starts(last, verdict)]
            if amplitudes(verdict.hypothesis.effect) and not _as_predicted(fits[0], last, verdict):
                away = fit(self.unfiltered(fits[0].loop, last), self.recordings, method)
                fits.append(away)
            values = [self.criterion(refitted, last.diagnosis) for refitted in fits]
            tried = [
                _contender(verdict.key, refitted, value)
                for refitted, value in zip(fits, values, strict=True)
                if np.isfinite(value) and _is_there(refitted, last.fit)
            ]
            found += sorted(tried, key=by_criterion)[:1]
        return sorted(found, key=by_criterion)

    def unfiltered(self, loop: ClosedLoop, last: Step) -> ClosedLoop:
        """The loop fitted as if noise were white: filters that knew nothing of an effect bar it."""
        # Output error, by the program that filters need anyway.
        noise = last.diagnosis.noise
        white = tuple(ARFilter(np.zeros(0), f.variance * f.gain) for f in noise)
        method = dataclasses.replace(self.whitened_method(last.diagnosis), filters=white)
        return fit(loop, self.recordings, method).loop

    def with_siblings(
        self, contenders: Sequence[Contender], last: Step, say: Callable[[str], None]
    ) -> list[Contender]:
        """Contenders, and beside a transmission that leads the others that come close to it.

        To a small motion a gap of micrometres is a soft spring, and that is what screening finds:
        a refit that begins with a gap as wide as the spring's twist tells which of the two it is.
        """
        loop, found = contenders[0].fit.loop, list(contenders)
        leading = loop.effects[-1]
        if not isinstance(leading, AbstractTransmission):
            return found
        tau = np.concatenate([r.tau[:, leading.joint - 1] for r in self.recordings])
        for verdict in transmissions_on(last.diagnosis, leading.joint):
            other = verdict.hypothesis.effect.after(leading, float(np.std(tau)))  # type: ignore[attr-defined]
            if other is None or any(verdict.key == (c.name, c.joint) for c in found):
                continue
            say(f"refit with {effect_on(*verdict.key)} in its place")
            instead = loop.with_effects((*loop.effects[:-1], other))
            instead = instead.free(*held_shapes(instead))
            plain = self.given()
            rough = fit(instead, self.recordings, plain)
            close = fit(rough.loop, self.recordings, self.whitened_method(last.diagnosis))
            value = self.criterion(close, last.diagnosis)
            if np.isfinite(value):
                found.append(_contender(verdict.key, close, value))
        return sorted(found, key=by_criterion)

    def starts(self, last: Step, verdict: Verdict, wide: float = 10.0) -> list[ClosedLoop]:
        """Where refits with an effect begin: at its prediction; from several where that is far off.

        What was screened at a finite setting may start in another valley at its prediction, and
        noise filters that knew nothing of it may bar the way out, so one refit begins without. And
        where drive and link part and meet again nearly every valley is a wrong one while the
        contact's stiffness is held at a wrong value; with that free from the start, and from a gap
        that is too wide, where the link flies longest and all parameters show, few are.
        """

        def grown(effect: AbstractEffect) -> ClosedLoop:
            return of_one_sign(last.fit.loop.add(_inside(effect)))

        effect, found = verdict.hypothesis.effect, [grown(last.diagnosis.predicted(verdict))]
        if amplitudes(effect):
            return found
        found.append(grown(effect))
        if not effect.contact:
            return [*found, self.unfiltered(found[0], last)]
        held = held_shapes(found[0])
        plain = self.given()
        apart = [grown(effect.scaled(factor)).free(*held) for factor in (1.0, wide)]
        fits = [fit(loop, self.recordings, plain) for loop in apart]
        sound = [f for f in fits if f.status.simulated and f.status is not Status.misfit]
        return found + [fitted.loop for fitted in sound]

    def settled(self, best: Contender, say: Callable[[str], None]) -> Contender:
        """The best contender with noise filters of its own, and its held shapes if they matter.

        The filters it was judged by knew its effect from a signature only, so some of it may have
        passed for noise. And what was screened at a finite setting has shapes that only a good fit
        can tell (how stiff a backlash's contact is): held at a wrong value they leave something to
        explain, and estimated from there they may end in a valley beside the right one.
        """
        loop = of_one_sign(best.fit.loop)
        held = () if amplitudes(loop.effects[-1]) else held_shapes(loop)
        released = with_released(loop, [name for name in held if name not in loop.names])
        found = [best.fit]
        for start in (loop, *released):
            say(f"refit of {effect_on(best.name, best.joint)} with its own noise")
            found.append(fit(start, self.recordings, self.alternating()))
        chosen = min((f for f in found if f.succeeded), key=_bic, default=best.fit)
        return dataclasses.replace(best, fit=chosen)

    def replaced(
        self, final: Step, from_end: int, rival: Contender | None, say: Callable[[str], None]
    ) -> Fit:
        """The last fit again, with a rival or nothing for the effect so far from the loop's end."""
        loop = final.fit.loop
        at = len(loop.effects) - from_end
        gone = loop.effects[at]
        instead = () if rival is None else rival.fit.loop.effects[-1:]
        with_what = "" if rival is None else f", with {effect_on(rival.name, rival.joint)}"
        say(
            f"again without {effect_on(gone.effect_name(), getattr(gone, 'joint', None))}"
            f"{with_what}"
        )
        less = loop.with_effects((*loop.effects[:at], *instead, *loop.effects[at + 1 :]))
        return fit(of_one_sign(less), self.recordings, self.whitened_method(final.diagnosis))

    def alternating(self) -> SeparablePEM:
        """The method with noise filters estimated along with the parameters."""
        method = self.given()
        return SeparablePEM(method, criterion="bic", highest=30, white=None, rounds=3)

    def given(self) -> OEM:
        """The output error to refit with, from where the loop is."""
        return dataclasses.replace(quiet(self.method), start="given")

    def whitened_method(self, diagnosis: Diagnosis) -> SeparablePEM:
        """The method with the noise filters of a diagnosis: efficient where noise is coloured."""
        method = self.given()
        return SeparablePEM(method, filters=diagnosis.noise)

    def criterion(self, found: Fit, diagnosis: Diagnosis) -> float:
        """Whitened squared error on fitted and held-out recordings, and BIC's price.

        Less is better; a difference of ten is decisive. Infinite where the fit runs away. Noise is
        what the diagnosis takes for it.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            value = fitted_criterion(found, diagnosis) + self.unseen_error(found, diagnosis)
        return value if np.isfinite(value) else np.inf

    def unseen_error(self, found: Fit, diagnosis: Diagnosis) -> float:
        """Whitened squared error on held-out recordings; infinite where the loop runs away."""
        if self.held_out is None:
            return 0.0
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                error = _whitened_error(compare(found, self.held_out).residuals, diagnosis.noise)
        except (ArithmeticError, ValueError, RuntimeError):
            return np.inf
        return error if np.isfinite(error) else np.inf


def _contender(key: tuple[str, int | None], fit: Fit, criterion: float) -> Contender:
    return Contender(name=key[0], joint=key[1], fit=fit, criterion=criterion)


def quiet(method: OEM) -> OEM:
    return dataclasses.replace(method, progress=False)


def by_criterion(contender: Contender) -> float:
    return contender.criterion


def fitted_criterion(found: Fit, diagnosis: Diagnosis) -> float:
    """Whitened squared error on fitted recordings, and BIC's price."""
    count = sum(r.size for r in found.residuals)
    return fitted_error(found, diagnosis) + len(found.names) * float(np.log(count))


def fitted_error(found: Fit, diagnosis: Diagnosis) -> float:
    """Whitened squared error on fitted recordings."""
    return _whitened_error(found.residuals, diagnosis.noise, diagnosis.data.level)


def _whitened_error(
    residuals: Sequence[Float[np.ndarray, "_samples joints"]],
    noise: Sequence[ARFilter],
    level: Float[np.ndarray, "recordings joints"] | None = None,
) -> float:
    """Squared error in units of the noise's innovations, of each recording's own if known."""
    total = 0.0
    for k, r in enumerate(residuals):
        white = whitened(r[None], noise, np.ones((1, len(r)), bool))
        total += float(np.sum((white if level is None else white / level[k]) ** 2))
    return total


def _bic(found: Fit) -> float:
    """Likelihood of a fit with noise filters of its own, and the price of what it estimates."""
    joints = found.residuals[0].shape[1]
    count = sum(len(r) for r in found.residuals)
    filters = [
        fit_ar([r[:, j] for r in found.residuals], highest=30, criterion="bic")
        for j in range(joints)
    ]
    spread = sum(count * np.log(max(f.variance, 1e-300)) for f in filters)
    free = len(found.names) + sum(f.order for f in filters)
    return float(spread + free * np.log(count * joints))


def held_shapes(loop: ClosedLoop) -> tuple[str, ...]:
    """Names of the last effect's parameters that no fit estimates unless told to."""
    last = ("effects", len(loop.effects) - 1)
    return tuple(
        p.name
        for p in loop.parameters
        if p.where.steps[:2] == last and not p.declaration.free  # type: ignore[attr-defined]
    )


def with_released(loop: ClosedLoop, names: Sequence[str]) -> list[ClosedLoop]:
    """The loop with these values free: from where they are, and from half and twice each."""
    if not names:
        return []
    given = {p.name: np.asarray(p.where(loop)) for p in loop.parameters if p.name in names}
    changes = [{}, *({name: f * given[name]} for name in names for f in (0.5, 2.0))]
    return [loop.with_values(**change).free(*names) for change in changes]


def _as_predicted(refitted: Fit, last: Step, verdict: Verdict, factor: float = 2.0) -> bool:
    """Whether a refit gains about what the effect's signature had promised."""
    with np.errstate(over="ignore", invalid="ignore"):
        before, after = (fitted_criterion(f, last.diagnosis) for f in (last.fit, refitted))
    return verdict.evidence / factor < before - after < verdict.evidence * factor


def _is_there(refitted: Fit, before: Fit) -> bool:
    """Whether anything of the effect that a refit has added shows in the recordings."""
    new = [k for k, name in enumerate(refitted.names) if name not in before.names]
    return not new or bool(np.isfinite(refitted.std[new]).any())


def of_one_sign(loop: ClosedLoop) -> ClosedLoop:
    """The loop with one smoothed sign a joint, where that of its Coulomb friction is estimated.

    Effects are added with the sharpness it had then, which may come out another beside them.
    """
    estimated, held = {}, []
    for p in loop.parameters:
        place = p.where.steps  # type: ignore[attr-defined]
        if place[0] != "effects" or place[2:] != ("gamma",):
            continue
        effect = loop.effects[place[1]]
        if isinstance(effect, Coulomb) and p.name in loop.names:
            estimated[effect.joint] = float(effect.gamma)
        elif p.name not in loop.names:
            held.append((p.name, getattr(effect, "joint", None)))
    return loop.with_values(**{name: estimated[j] for name, j in held if j in estimated})


def _inside(effect: AbstractEffect) -> AbstractEffect:
    """The effect with parameters that are on their bounds or beyond moved just inside."""
    chosen = [p for p in list_parameters(effect) if p.declaration.free]
    if not chosen:
        return effect
    values = Bounds.of(chosen).moved_inside(read_values(effect, chosen))
    return write_values(effect, chosen, values)
