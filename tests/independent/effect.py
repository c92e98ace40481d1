"""What every effect of the simulator is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Effect:
    """Base of all effects: what it is called, where it acts, which fields scale it."""

    name = ""
    place = ""
    amplitudes = ()
    largest = math.inf  # physical cap of the amplitudes, in their unit

    def scaled(self, factor: float) -> Effect:
        """The same effect with its amplitudes times `factor`, capped where physics does."""
        old = [getattr(self, f) for f in self.amplitudes]
        top = max((abs(x) for x in old), default=0.0)
        if top * abs(factor) > self.largest:
            factor = math.copysign(self.largest / top, factor)
        return replace(self, **{f: x * factor for f, x in zip(self.amplitudes, old, strict=True)})
