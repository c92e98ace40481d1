"""Transmissions and limits that may explain a motion although their signatures do not."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..effects import AbstractEffect, AbstractTransmission, ActuatorLag, TimeDelay, TorqueSaturation
from .asked import Asked
from .diagnosis import Diagnosis

# Ratio of the limit that is fitted to the screened one.
_LOWER = 0.8


def suspected(diagnosis: Diagnosis) -> tuple[AbstractEffect, ...]:
    """Transmissions and limits on the joints where one of them is significant, at a good setting.

    A wide gap, a soft joint or a limit that acts for long changes the motion so much that
    signatures, which are simulated with small gaps, small compliances and high limits, resemble the
    residual only a little. They are significant, but explain too little to be fitted.
    """
    found = []
    for kind in (AbstractTransmission, TorqueSaturation):
        loose = {
            v.hypothesis.joint
            for v in diagnosis.ranking
            if isinstance(v.hypothesis.effect, kind) and v.p_value < diagnosis.significance
        }
        effects = [v.hypothesis.effect for v in diagnosis.forms]
        found += [e for e in effects if isinstance(e, kind) and e.joint in loose]
    return tuple(_acting(e) if isinstance(e, TorqueSaturation) else e for e in found)


def _acting(effect: TorqueSaturation) -> TorqueSaturation:
    """A lower limit. One that hardly acts has a slope of almost zero, and its fit ends there."""
    return dataclasses.replace(effect, limit=_LOWER * effect.limit)


def similar_ones(
    effects: Sequence[AbstractEffect], asked: Asked, screened: Sequence[AbstractEffect]
) -> Iterator[tuple[AbstractEffect, AbstractEffect]]:
    """The fitted effects that may only resemble a transmission, each with that transmission.

    An elasticity resembles a gap as wide as its twist under load, and a gap that is narrower than
    the twist an elasticity. A soft joint, beyond what screening simulates, first resembles a late
    drive. A drive that is late by less than a sample is like a law that is sampled and held.

    **Arguments:**

    - `screened`: screened effects at their best settings.
    """
    period = asked.recordings.common_period()
    for effect in effects:
        if isinstance(effect, (ActuatorLag, TimeDelay)) and effect.late > period:
            for other in screened:
                if isinstance(other, AbstractTransmission) and other.joint == effect.joint:
                    yield effect, other
    load = np.sqrt(np.mean(np.concatenate([r.tau for r in asked.recordings]) ** 2, axis=0))
    kinds: list[Any] = [
        c for c in asked.catalogue if isinstance(c, type) and issubclass(c, AbstractTransmission)
    ]
    for effect in effects:
        if isinstance(effect, AbstractTransmission):
            for kind in kinds:
                joint = effect.joint
                similar = kind(joint=joint).after(effect, float(load[joint - 1]))
                if similar is not None:
                    yield effect, similar
