"""What a reader of a discovery should know beside its verdict."""

from collections.abc import Sequence

from ..effects import ActuatorLag, TimeDelay
from ..estimate import Fit
from ..simulation.loop import ClosedLoop
from .story import Step


def remarks(steps: Sequence[Step], given: ClosedLoop) -> tuple[str, ...]:
    """Fits that did not converge, values released, a law that looks sampled and was not said to be.

    **Arguments:**

    - `given`: the loop that the discovery began with.
    """
    bad = [s.label for s in steps if not s.fit.succeeded]
    said = [f"the fit of {', '.join(bad)} did not converge: read its values with care"]
    last = steps[-1].fit
    return (*(said if bad else ()), *_estimated(last, given), *looks_sampled(last))


def _estimated(fit: Fit, given: ClosedLoop) -> list[str]:
    """What to say of values that the model held by default and the search estimated."""
    places = {p.place for p in given.free_parameters}
    held = {p.place: p for p in given.parameters if p.place not in places}
    found = []
    for p in fit.loop.free_parameters:
        if p.place in held:
            before, row = float(held[p.place].where(given)), fit.table().loc[p.name]
            unit = "" if row["unit"] == "1" else f" {row['unit']}"
            found.append(
                f"{p.name} was estimated, {row['value']:.3g} ± {row['std']:.2g}{unit}: the "
                f"{before:.3g} that the model held by default does not suit these recordings"
            )
    before, after = (getattr(x.controller, "delay", 0.0) for x in (given, fit.loop))
    if after != before and fit.loop.controller.imposes:
        way = "later" if after > 0 else "earlier"
        found.append(
            f"the recorded torque acts {1e3 * abs(after):.3g} ms {way} than it was recorded, as "
            "estimated; a law that ticks and is held is half a period late"
        )
    return found


# Shares of a sample by which the torque of a law is late that is computed as often as it is
# recorded, and held.
_HELD = 0.25, 0.8


def looks_sampled(fit: Fit) -> list[str]:
    """What to say of a drive that is late as one is whose law was taken for continuous."""
    if fit.loop.controller.period is not None:
        return []
    period, found = fit.recordings.common_period(), []
    for effect in fit.loop.effects:
        late = {ActuatorLag: "time_constant", TimeDelay: "delay"}.get(type(effect))
        value = 0.0 if late is None else float(getattr(effect, late))
        if _HELD[0] * period < value < _HELD[1] * period:
            found.append(
                f"joint {getattr(effect, 'joint', '')} is late by {1e3 * value:.3g} ms, about half "
                "a sample, as a law is that ticks with the recordings and is held: say so with "
                f"jaxid.control.Sampled(law, every={period:.4g}), or where the law is unknown with "
                f"jaxid.control.Tracking(delay={period / 2:.4g})"
            )
    return found
