"""Contacts that may explain a motion although their signatures do not."""

from ..effects import AbstractEffect, AbstractTransmission
from .diagnosis import Diagnosis


def suspected(diagnosis: Diagnosis) -> tuple[AbstractEffect, ...]:
    """Contacts on the joints of which a transmission is significant, at their best settings.

    A wide gap changes the motion so much that signatures of contacts, which are simulated with
    small gaps, resemble the residual only a little. They are significant, but explain too little
    to be fitted.
    """
    loose = {
        v.hypothesis.joint
        for v in diagnosis.ranking
        if isinstance(v.hypothesis.effect, AbstractTransmission)
        and v.p_value < diagnosis.significance
    }
    return tuple(
        v.hypothesis.effect
        for v in diagnosis.forms
        if v.hypothesis.effect.contact and v.hypothesis.joint in loose
    )
