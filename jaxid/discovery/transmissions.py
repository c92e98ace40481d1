"""Transmissions that may explain a motion although their signatures do not."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..effects import AbstractEffect, AbstractTransmission
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
    effects: Sequence[AbstractEffect], asked: Asked
) -> Iterator[tuple[AbstractTransmission, AbstractTransmission]]:
    """The fitted transmissions, each with those of the catalogue that it may only resemble.

    An elasticity resembles a gap as wide as its twist under load.
    """
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
