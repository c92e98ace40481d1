"""Optional parts of added effects that explain less than their price, left out of the final fit."""

import dataclasses

from ..estimate import Fit
from ..parameters import Parameter
from ..simulation.loop import ClosedLoop
from .fits import Fits
from .likelihood import price_of_value, score_of
from .models import LIKELY, Model
from .verify import wald


def without_parts(fits: Fits, at: Model) -> Fit:
    """The fit of the final model without the parts of its effects that explain too little.

    A search adds an effect as a whole. A part that the recordings hardly need, such as the second
    harmonic of a wave, then only makes the other values uncertain. The least significant part is
    held at zero (Wald 1943) unless the score is then higher by odds of 20 to 1, the rule by which
    a search removes effects. An effect keeps at least one amplitude.

    **Returns:** the fit of the model itself if each part is worth its price.
    """
    assert at.fit is not None
    fit, left_out = at.fit, []
    while (group := _least(fit, len(at.effects))) is not None:
        names = [p.name for p in group]
        loop = fit.loop.with_values(**dict.fromkeys(names, 0.0)).hold(*names)
        again = fits.without_parts(at.effects, loop, at.noise)
        if not (again.succeeded and score_of(again).value < score_of(fit).value + LIKELY):
            break
        fit, left_out = again, [*left_out, *names]
    if not left_out:
        return fit
    said = f"held at zero, because they explain less than a parameter costs: {', '.join(left_out)}"
    return dataclasses.replace(fit, notes=(*fit.notes, said))


def _least(fit: Fit, added: int) -> list[Parameter] | None:
    """The optional part that explains least per value, if less than the price of each value."""
    price = price_of_value(fit)
    found: tuple[float, list[Parameter]] | None = None
    for group in _optional(fit.loop, added):
        explained = wald(fit, [fit.names.index(p.name) for p in group]) / len(group)
        if explained < (price if found is None else found[0]):
            found = explained, group
    return None if found is None else found[1]


def _optional(loop: ClosedLoop, added: int) -> list[list[Parameter]]:
    """Estimated optional parts of the last effects, of effects with other estimated amplitudes."""
    groups = []
    for place in range(len(loop.effects) - added, len(loop.effects)):
        own = [p for p in loop.free_parameters if p.place[:2] == ("effects", place)]
        amplitudes = [p for p in own if p.declaration.linear]
        for fields in loop.effects[place].optional:
            group = [p for p in amplitudes if p.place[-1] in fields]
            if 0 < len(group) < len(amplitudes):
                groups.append(group)
    return groups
