"""The steps of a story: one more effect each, its errors, values and name in words."""

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect
from ..errors import ModelError
from ..estimate import Fit
from ..estimate.result import joint_columns
from ..simulation.loop import ClosedLoop
from .comparison import Comparison
from .diagnosis import Diagnosis, over_recordings
from .hypotheses import effect_on, on_recordings
from .text import in_brackets

if TYPE_CHECKING:
    import pandas as pd


# What an added effect does to the errors of the joints on held-out recordings; mixed: it lowers
# those of some joints and raises those of others.
OnUnseen = Literal["lowers", "raises", "mixed", "unchanged"]


class Step(eqx.Module):
    """The model with one more of the added effects.

    `diagnosis` exists if the search continued from this model, and for the first and last step.
    `added` is the effect that this step adds to the previous one; `probability` is the weight of
    all models with it, None if none of them passes the tests of the verdict; `alike` are effects
    that these recordings cannot distinguish from it; `unseen` tells what it does to the error on
    held-out recordings, None without such recordings.
    """

    label: str
    fit: Fit
    held_out: Comparison | None
    diagnosis: Diagnosis | None
    added: AbstractEffect | None = None
    alike: tuple[tuple[str, int | None], ...] = ()
    probability: float | None = 1.0
    unseen: OnUnseen | None = eqx.field(static=True, default=None)

    def belief(self, tested: bool = True) -> str:
        """How far the effect can be believed, in words; empty if nothing is known.

        The probability depends on the fitted recordings only, and on the assumption that one of
        the examined models is right. It is not given for an effect that held-out recordings refute.

        **Arguments:**

        - `tested`: also tell if held-out recordings confirm the effect.
        """
        if self.unseen == "raises":
            return "refuted: raises the error on held-out recordings"
        said = [] if self.probability is None else [f"probability {odds(self.probability)}"]
        held_out = {
            "lowers": "confirmed by held-out recordings",
            "mixed": "lowers the error of some joints on held-out recordings and raises others",
        }
        if tested and self.unseen in held_out:
            said.append(held_out[self.unseen])
        return ", ".join(said)


def odds(share: float) -> str:
    """A probability in words with few digits, such as `> 0.999`."""
    if share < 0.001:
        return "< 0.001"
    return "> 0.999" if share > 0.999 else f"{share:.3g}"


def added_in_words(steps: Sequence[Step], sure: bool = True) -> list[str]:
    """Added effects in words, if `sure` with how far to believe them; repeated ones once."""
    added = [(step.added, step.belief(False)) for step in steps if step.added is not None]
    counted = Counter(_placed(e.spoken(), e) for e, _ in added)
    beliefs = {_placed(e.spoken(), e): said for e, said in added}
    often = {1: "", 2: " twice"}
    return [
        f"{name}{often.get(n, f' {n} times')}{in_brackets(beliefs[name]) * sure}"
        for name, n in counted.items()
    ]


def step_name(step: Step) -> str:
    """The effect of a step by name and joint, with its recordings if it is not on all."""
    assert step.added is not None
    return _placed(step.added.effect_name(), step.added)


def _placed(name: str, effect: AbstractEffect) -> str:
    return effect_on(name, getattr(effect, "joint", None)) + on_recordings(effect)


def joint_errors(table: "pd.DataFrame") -> Float[np.ndarray, " joints"]:
    """Errors by joint, %, over the recordings of a table of errors."""
    return over_recordings(table.to_numpy())


def gained(steps: Sequence[Step]) -> str:
    """Where added effects lower the error on held-out recordings by half or more, in words.

    It names the joint on which they lower it most; empty if there is none, or no such recording.
    """
    first, last = steps[0].held_out, steps[-1].held_out
    if first is None or last is None:
        return ""
    before, after = joint_errors(first.error_percent), joint_errors(last.error_percent)
    j = int(np.argmax(np.where(after < before / 2, before - after, 0.0)))
    if not after[j] < before[j] / 2:
        return ""
    return (
        f"lowers the error of {joint_columns(len(before))[j]} on held-out recordings from "
        f"{before[j]:.3g} to {after[j]:.3g} %"
    )


def errors_of(step: Step) -> dict[str, list[float]]:
    """Errors by joint, %, on fitted (`fit`) and held-out recordings (`validate`)."""
    errors = {"fit": joint_errors(step.fit.error_percent).tolist()}
    if step.held_out is not None:
        errors["validate"] = joint_errors(step.held_out.error_percent).tolist()
    return errors


def found_parameters(steps: Sequence[Step], added: int) -> dict[str, dict[str, Any]]:
    """Values of one of the added effects in the last fit; these are the loop's last effects."""
    fit = steps[-1].fit
    total = sum(step.added is not None for step in steps)
    effect = fit.loop.effects[len(fit.loop.effects) - total + added]
    std = fit.std
    return {
        name: {
            "value": float(fit.theta[place]),
            "std": float(std[place]) if np.isfinite(std[place]) else None,
            "unit": unit,
        }
        for place, name, unit in effect_parameters(fit.loop, effect)
    }


def effect_parameters(loop: ClosedLoop, effect: AbstractEffect) -> list[tuple[int, str, str]]:
    """Places of an effect's free values in `loop.theta`, with name in the effect and unit.

    **Raises:** `ModelError` if the loop does not have the effect.
    """
    position = next((k for k, e in enumerate(loop.effects) if e is effect), None)
    if position is None:
        raise ModelError(f"{effect.effect_name()} is not one of the loop's effects: add it first")
    found, place = [], 0
    for p in loop.free_parameters:
        steps = p.place
        if steps[:2] == ("effects", position):
            # Values with names of their own, such as those of a carried body, keep them.
            numbered = [f"{steps[-1]}[{k + 1}]" if p.several else steps[-1] for k in range(p.size)]
            names = p.labels or numbered
            units = loop.units(p)
            found += [(place + k, str(name), units[k]) for k, name in enumerate(names)]
        place += p.size
    return found
