"""Values that a model holds by default, in doubt: a smoothing, the delay of recorded torque."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import Coulomb
from ..parameters import Parameter
from ..simulation.dynamics import imposed
from ..simulation.integration import SIGNALS
from ..simulation.loop import ClosedLoop
from ..simulation.runs import simulate_batch
from .predict import Predictor

# A value above zero is tried so many times larger and smaller.
_FACTOR = 5.0
# Samples by which torque may be late as the commands of a sampled law are; more is a mistake in the
# recordings. Changes of less than this share of a sample are not worth a fit.
_LATE, _NOTHING = 2.0, 0.02


class Release(eqx.Module):
    """A loop with values estimated that it held, and what is said of them.

    - `gain`: of the squared error that is predicted.
    - `freedom`: values that were estimated and are not among the loop's parameters.
    """

    loop: ClosedLoop
    said: str
    gain: float
    freedom: int = 0


def released(predictor: Predictor, price: float) -> Release | None:
    """The model of a linear system with held values free that explain more than they cost.

    **Arguments:**

    - `predictor`: the linear system of the fitted model through its noise filters.
    - `price`: what one estimated value costs of the squared error.
    """
    loop = predictor.system.loop
    nominal = _signal(predictor, loop)
    found = _shapes(predictor, nominal, price)
    if found:
        values = {name: value for name, (value, _) in found.items()}
        free = loop.with_values(**values).free(*values)
        gain = max(gain for _, gain in found.values())
        return Release(free, f"{' and '.join(values)} estimated", gain)
    late, gain = _lateness(predictor, nominal, price)
    if late == 0:
        return None
    delay = loop.controller.delay + late  # type: ignore[reportAttributeAccessIssue]
    law = dataclasses.replace(loop.controller, delay=delay)
    moved = dataclasses.replace(loop, controller=law)
    return Release(moved, f"a delay of the torque of {1e3 * delay:.3g} ms", gain, freedom=1)


def _shapes(
    predictor: Predictor, nominal: np.ndarray, price: float
) -> dict[str, tuple[float, float]]:
    """Held shapes that explain more elsewhere than they cost: where each explains most, and what.

    Each is moved on its own and simulated; what that changes is held against the residual as an
    effect's signature is. The program is that of the fitted model, so nothing is compiled.
    """
    loop = predictor.system.loop
    found = {}
    for p in doubtful(loop):
        gains = {}
        for value in _elsewhere(p, loop):
            change = _signal(predictor, loop.with_values(**{p.name: value})) - nominal
            if np.isfinite(change).all():
                along, gain = _held_against(predictor, change)
                gains[value] = gain if along > 0 else 0.0
        best = max(gains, key=lambda value: gains[value], default=None)
        if best is not None and gains[best] > price:
            found[p.name] = best, gains[best]
    return found


def _lateness(predictor: Predictor, nominal: np.ndarray, price: float) -> tuple[float, float]:
    """How much later than recorded the torque acts, s, where no law is simulated; else nil.

    And what that explains.
    """
    system = predictor.system
    if not imposed(system.loop) or nominal.shape[1] < 3:
        return 0.0, 0.0
    time = np.asarray(system.batch.time)
    step = float(np.median(np.diff(time[0])))
    late, gain = _held_against(predictor, np.gradient(nominal, step, axis=1))
    delay = late + getattr(system.loop.controller, "delay", 0.0)
    small = abs(late) < _NOTHING * step
    return (0.0 if gain < price or small or abs(delay) > _LATE * step else late), gain


def _signal(predictor: Predictor, loop: ClosedLoop) -> Float[np.ndarray, "recordings samples n"]:
    """What is compared of a simulation along the recordings, before any filter."""
    system = predictor.system
    return np.asarray(getattr(simulate_batch(loop, system.batch), SIGNALS[system.row]))


def _held_against(predictor: Predictor, change: np.ndarray) -> tuple[float, float]:
    """How much of a change is in the residual beside the base, and what that explains."""
    batch = predictor.system.batch
    seen = np.asarray(batch.compared(change * np.asarray(batch.mask)[..., None]))
    shown, residual = (_white(predictor, x) for x in (seen, predictor.data.residual))
    along, size = float(residual @ shown), max(float(shown @ shown), 1e-300)
    return along / size, along**2 / size


def doubtful(loop: ClosedLoop) -> list[Parameter]:
    """Shapes of the model's effects that are held by declaration, not because a user held them.

    The smoothing of an effect follows that of the joint's Coulomb friction, and is none of them.
    """
    free = {p.place for p in loop.free_parameters}

    def follows(p: Parameter) -> bool:
        effect = loop.effects[int(p.place[1])]
        return p.place[2:] == ("smoothing",) and not isinstance(effect, Coulomb)

    return [
        p
        for p in loop.parameters
        if p.place[0] == "effects"
        and p.size == 1
        and not (p.declaration.free or p.declaration.linear)
        and p.place not in free | loop.held
        and not follows(p)
    ]


def _elsewhere(p: Parameter, loop: ClosedLoop) -> list[float]:
    """Other values worth trying, within bounds."""
    value = float(np.asarray(p.where(loop)))
    low, high = p.declaration.lower, p.declaration.upper
    tried = (value / _FACTOR, value * _FACTOR) if value > 0 else (p.declaration.scale,)
    return [x for x in tried if low <= x <= high]


def _white(
    predictor: Predictor, rows: Float[np.ndarray, "recordings samples outputs"]
) -> Float[np.ndarray, " rows"]:
    """Rows through the noise filters, less what the base absorbs."""
    white = predictor.data.white(rows, predictor.noise).reshape(-1)
    return white - predictor.basis @ (predictor.basis.T @ white)
