"""What a reader of a discovery should know beside its verdict."""

from collections.abc import Sequence

from ..effects import ActuatorLag, TimeDelay
from ..estimate import Fit
from .story import Step


def remarks(steps: Sequence[Step]) -> tuple[str, ...]:
    """Fits that did not converge, and a law that looks sampled and was not said to be."""
    bad = [s.label for s in steps if not s.fit.succeeded]
    said = [f"the fit of {', '.join(bad)} did not converge: read its values with care"]
    return (*(said if bad else ()), *looks_sampled(steps[-1].fit))


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
