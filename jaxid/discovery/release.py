"""Release of values held by default: shapes of effects and a lead of friction."""

import math
from collections.abc import Callable, Iterator, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..parameters import Parameter
from ..simulation.dynamics import imposed
from ..simulation.integration import SIGNALS
from ..simulation.loop import ClosedLoop
from ..simulation.runs import simulate_batch
from ..simulation.steps import set_substeps
from ..simulation.widening import LEAD, SIGN
from .predict import Predictor
from .score import spanned
from .signs import JUMPS, OF_SIGN, follows

# A positive value is also tried multiplied and divided by this factor.
_FACTOR = 5.0


class Release(eqx.Module):
    """A loop in which held values are free.

    - `said`: the released values in words.
    - `gain`: predicted decrease of the score.
    - `again`: whether all values were free before, so that only their start values are new.
    """

    loop: ClosedLoop
    said: str
    gain: float
    again: bool = False


def released(predictor: Predictor, price: float) -> Release | None:
    """The model with those held values free that explain more than their price; None if none does.

    **Arguments:**

    - `predictor`: the linear system of the fitted model, with its noise filters.
    - `price`: smallest decrease of the whitened squared error for one estimated value.
    """
    loop = predictor.system.loop
    nominal = _signal(predictor, loop)
    values = _shapes(predictor, nominal, price)
    if not values:
        return None
    leads = {p.name for p in loop.parameters if p.place[-1] == LEAD} & values.keys()
    # A lead also explains a part of a sign of the wrong shape, which is released first.
    if len(leads) < len(values):
        values = {name: value for name, value in values.items() if name not in leads}
    held = [p.name for p in doubtful(loop) if p.name in values]
    free = loop.with_values(**values).free(*held)
    if held:
        change = _signal(predictor, loop.with_values(**values)) - nominal
        gain = _fall(predictor, _beside(predictor)(_compared(predictor, change)))
        return Release(free, f"{' and '.join(held)} estimated", gain)
    start = ", ".join(f"{name} {value:.3g}" for name, value in values.items())
    least = _fall(predictor, price)
    return Release(free, f"estimates that begin at {start}", least, again=True)


def _shapes(predictor: Predictor, nominal: np.ndarray, price: float) -> dict[str, float]:
    """Start values of the shapes whose change explains more than its price, by name.

    Smoothing and form of one sign are changed together, because a fit can replace one by the other.
    The change of the signal by each setting is compared with the residual like the signature of an
    effect.
    """
    loop = predictor.system.loop
    names = {p.place: p.name for p in loop.parameters}
    found: dict[str, float] = {}
    tried: set[tuple] = set()
    beside = _beside(predictor)
    for p in (*doubtful(loop), *_estimated_signs(loop)):
        together = [names[(*p.place[:2], what)] for what in SIGN if p.place[2:] in OF_SIGN]
        free = p.place in {q.place for q in loop.free_parameters}
        # A smoothing and a form that are both held, or both free, have the same settings.
        setting = (tuple(together) or p.name), free
        if p.name in found or setting in tried:
            continue
        tried.add(setting)
        gain = _instead(predictor, p) if free else beside
        best: dict[str, float] = {}
        most = price
        settings = _settings(p, together, loop)
        for values, change in zip(settings, _changes(predictor, p, settings, nominal), strict=True):
            if np.isfinite(change).all() and (explained := gain(change)) > most:
                best, most = values, explained
        found |= best
    return found


def _changes(
    predictor: Predictor, p: Parameter, settings: Sequence[dict[str, float]], nominal: np.ndarray
) -> Iterator[Float[np.ndarray, "recordings rows outputs"]]:
    """Changes of the compared signal by settings of the effect of a parameter.

    Along an imposed motion an effect adds its own torque. Otherwise each setting is simulated by
    the compiled program of the fitted model.
    """
    loop = predictor.system.loop
    if not imposed(loop):
        for values in settings:
            yield _compared(predictor, _signal(predictor, loop.with_values(**values)) - nominal)
        return
    place = int(p.place[1])
    own = [loop.with_values(**values).effects[place] for values in ({}, *settings)]
    shown = predictor.shown_together(own)
    for k in range(1, len(own)):
        yield shown[..., k] - shown[..., 0]


def _estimated_signs(loop: ClosedLoop) -> list[Parameter]:
    """Free smoothings and forms along an imposed motion.

    Their values may belong to a local minimum of a model that lacked an effect.
    """
    if not imposed(loop):
        return []
    return [p for p in loop.free_parameters if p.place[2:] in OF_SIGN and not follows(p, loop)]


def _instead(predictor: Predictor, sign: Parameter) -> Callable[[np.ndarray], float]:
    """The function for what a change of a free sign explains.

    The derivatives of the sign are removed from the base first, because they absorb the change.
    """
    data, noise = predictor.data, predictor.noise
    free = predictor.system.loop.free_parameters
    owner = [p.place[:2] == sign.place[:2] and p.place[2:] in OF_SIGN for p in free]
    gone = np.repeat(owner, [p.size for p in free])
    kept = np.flatnonzero(np.concatenate([~gone, np.ones(data.base.shape[-1] - len(gone), bool)]))
    basis = spanned(data.white_columns(data.base[..., kept], noise, kept.tolist()))
    now = _white(predictor, data.residual)

    def gain(change: np.ndarray) -> float:
        rest = data.white_residual(data.residual - change, noise)
        rest = rest - basis @ (basis.T @ rest)
        return float(now @ now - rest @ rest)

    return gain


def _settings(p: Parameter, together: list[str], loop: ClosedLoop) -> list[dict[str, float]]:
    """Other values to try, of a parameter or of a sign's smoothing and form."""
    if not together:
        return [{p.name: value} for value in _elsewhere(p, loop)]
    smoothing, form = together
    signs = [q for q in loop.parameters if q.place[2:] in OF_SIGN]
    named = {q.name: float(np.asarray(q.where(loop))) for q in signs}
    # Multiplication does not change a value at the bound zero.
    scale = next(q.declaration.scale for q in signs if q.name == smoothing)
    centre = named[smoothing] if named[smoothing] > JUMPS * scale else scale
    # Along an imposed motion a setting costs almost nothing.
    fine = imposed(loop)
    factors = (0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 5.0) if fine else (0.2, 1.0, 5.0)
    forms = (0.0, 0.3, 0.6, 1.0, 1.5) if fine else (0.0, 1.0)
    held = {q.name for q in (*doubtful(loop), *loop.free_parameters)}
    chosen = [
        {smoothing: centre * factor, form: value}
        for factor in factors
        for value in (forms if form in held else (named[form],))
        if smoothing in held or form in held
    ]
    now = {smoothing: named[smoothing], form: named[form]}
    return [values for values in chosen if values != now]


def _signal(predictor: Predictor, loop: ClosedLoop) -> Float[np.ndarray, "recordings samples n"]:
    """The compared signal of a simulation along the recordings, before the band filter."""
    system = predictor.system
    run = simulate_batch(_finer(loop, system.loop), system.batch)
    return np.asarray(getattr(run, SIGNALS[system.row]))


def _finer(loop: ClosedLoop, before: ClosedLoop) -> ClosedLoop:
    """The loop with as many more steps as one of its signs is sharper than before."""
    now = loop.stepping.substeps
    if now is None:
        return loop
    was, new = (
        [float(p.where(x)) for p in x.parameters if p.place[-1] == "smoothing"]
        for x in (before, loop)
    )
    sharper = [a / max(b, 1e-300) for a, b in zip(was, new, strict=True)]
    factor = min(max([1.0, *sharper]), _FACTOR)
    return set_substeps(loop, math.ceil(now * factor), settled=loop.stepping.settled)


def _fall(predictor: Predictor, gain: float) -> float:
    """Decrease of the score if that much of the squared error is explained."""
    left = float(np.sum(_white(predictor, predictor.data.residual) ** 2))
    rows = int(predictor.data.compared.sum())
    return rows * float(np.log(left / max(left - gain, 1e-9 * left)))


def _beside(predictor: Predictor) -> Callable[[np.ndarray], float]:
    """The function for what a change explains, at its own or the best size, beside the base."""
    residual = _white(predictor, predictor.data.residual)

    def gain(change: np.ndarray) -> float:
        shown = _white(predictor, change)
        along, size = float(residual @ shown), max(float(shown @ shown), 1e-300)
        return max(2 * along - size, along**2 / size if along > 0 else 0.0)

    return gain


def _compared(predictor: Predictor, change: np.ndarray) -> np.ndarray:
    """A change of the simulated signal, filtered to the compared band."""
    batch = predictor.system.batch
    return np.asarray(batch.compared(change * np.asarray(batch.mask)[..., None]))


def doubtful(loop: ClosedLoop) -> list[Parameter]:
    """Shapes of the model's effects that are held by declaration, not by the user.

    Shapes of signs that follow those of the joint's Coulomb friction are left out, and leads unless
    the motion is imposed.
    """
    free = {p.place for p in loop.free_parameters}
    leads = imposed(loop)
    return [
        p
        for p in loop.parameters
        if p.place[0] == "effects"
        and p.size == 1
        and not (p.declaration.free or p.declaration.linear)
        and p.place not in free | loop.held
        and (leads or p.place[-1] != LEAD)
        and not follows(p, loop)
    ]


def _elsewhere(p: Parameter, loop: ClosedLoop) -> list[float]:
    """Other values to try, within bounds; near ones as well, for shapes such as an exponent."""
    value = float(np.asarray(p.where(loop)))
    low, high = p.declaration.lower, p.declaration.upper
    if value > 0:
        tried = [value * x for x in (1 / _FACTOR, 0.5, 2.0, _FACTOR)]
    else:
        # A small and a large value: the effect of a change on the residual is not linear.
        tried = [p.declaration.scale / _FACTOR, p.declaration.scale]
    inside = dict.fromkeys(min(max(x, low), high) for x in tried)
    return [x for x in inside if x != value]


def _white(
    predictor: Predictor, rows: Float[np.ndarray, "recordings samples outputs"]
) -> Float[np.ndarray, " rows"]:
    """Whitened rows minus what the base absorbs."""
    white = predictor.data.white_residual(rows, predictor.noise)
    return white - predictor.basis @ (predictor.basis.T @ white)
