"""Transmissions that may explain a motion although their signatures do not."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..effects import AbstractEffect, AbstractTransmission, ActuatorLag, TimeDelay
from .asked import Asked
from .diagnosis import Diagnosis


def suspected(diagnosis: Diagnosis) -> tuple[AbstractEffect, ...]:
    """Transmissions on the joints where one is significant, each at its best setting.

    A wide gap or a soft joint changes the motion so much that signatures, which are simulated with
    small gaps and compliances, resemble the residual only a little. They are significant, but
    explain too little to be fitted.
    """
    transmissions = [
        v for v in diagnosis.forms if isinstance(v.hypothesis.effect, AbstractTransmission)
    ]
    loose = {
        v.hypothesis.joint
        for v in diagnosis.ranking
        if isinstance(v.hypothesis.effect, AbstractTransmission)
        and v.p_value < diagnosis.significance
    }
    return tuple(v.hypothesis.effect for v in transmissions if v.hypothesis.joint in loose)


def similar_ones(
    effects: Sequence[AbstractEffect], asked: Asked, screened: Sequence[AbstractEffect]
) -> Iterator[tuple[AbstractEffect, AbstractEffect]]:
    """The fitted effects that may only resemble a transmission, each with that transmission.

    An elasticity resembles a gap as wide as its twist under load. A soft joint, beyond what
    screening simulates, first resembles a late drive.

    **Arguments:**

    - `screened`: screened effects at their best settings.
    """
    for effect in effects:
        if isinstance(effect, (ActuatorLag, TimeDelay)):
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
