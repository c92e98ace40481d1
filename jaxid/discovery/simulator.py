"""A model in a simulator's parameters, and the error due to effects that these cannot express."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from ..errors import FitError
from ..estimate import Fit
from ..estimate import fit as fitted
from ..estimate.oem import OEM, oem_of
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..simulation.terms import JointTerms, joint_terms, unsaid
from .comparison import compare
from .hypotheses import effect_on

if TYPE_CHECKING:
    import pandas as pd


class SimulatorTerms(eqx.Module):
    """A simulator's parameters for each joint, and the effects that are left out.

    - `joints`: the terms of each joint, by the names of recordings with the same drive settings.
    - `loops`: models by choice: as identified, without each effect that has no term, without all
      such effects, and the latter fitted again; `joints` belong to the last one.
    - `reasons`: why an effect has no term, by the choice that leaves it out.
    - `errors`: relative error of the judged signal, mean over the recordings, by choice and joint,
      %.
    """

    joints: dict[tuple[str, ...], tuple[JointTerms, ...]]
    loops: dict[str, ClosedLoop]
    reasons: dict[str, str] = eqx.field(static=True)
    errors: "pd.DataFrame"

    def table(self) -> "pd.DataFrame":
        """The terms, one row for each joint and each setting of the drives."""
        import pandas as pd

        rows = {}
        for names, joints in self.joints.items():
            for j, terms in enumerate(joints, start=1):
                fields = vars(terms)
                rows[", ".join(names), f"joint {j}"] = {n: _shown(x) for n, x in fields.items()}
        return pd.DataFrame(rows).T.rename_axis(["recordings", "joint"])

    def choices(self) -> "pd.DataFrame":
        """The error of each choice, and the reason why its effect cannot be expressed."""
        return self.errors.assign(reason=[self.reasons.get(c, "") for c in self.errors.index])

    def __repr__(self) -> str:
        terms = self.table().to_string(float_format=lambda x: f"{x:.4g}")
        choices = self.choices().to_string(float_format=lambda x: f"{x:.4g}")
        return f"{terms}\n\nrelative error in % by choice:\n{choices}"


def simulator_terms(
    model: Fit | ClosedLoop,
    recordings: Recording | Recordings | Iterable[Recording] | None = None,
    *,
    refit: bool = True,
    method: OEM | None = None,
) -> SimulatorTerms:
    """Expresses a model by armature, damping, frictionloss, kp, kd, forcerange and delay.

    These are MuJoCo's parameters, which Isaac and most training environments for legged robots also
    use. A motor's back-EMF is damping outside the torque limit; the limit of its voltage is a limit
    of torque.

    **Arguments:**

    - `model`: a fit or a loop.
    - `recordings`: for the comparison of errors; those of the fit if None.
    - `refit`: whether the model without the other effects is fitted again; the terms are then those
      of this fit.
    - `method`: method of that fit; by default that of the fit, or `OEM()`.

    **Raises:** `FitError` for a loop without recordings.
    """
    loop = model.loop if isinstance(model, Fit) else model
    if recordings is None:
        if not isinstance(model, Fit):
            raise FitError("a loop has no recordings for the comparison of choices: give some")
        recordings = model.recordings
    recordings = Recordings.of(recordings)
    method = method or oem_of(model)
    loops, reasons = _choices(loop)
    if len(loops) > 1 and refit:
        loops["in these terms, fitted again"] = fitted(loops[_PLAIN], recordings, method).loop
    last = list(loops.values())[-1]
    return SimulatorTerms(_told(last, recordings), loops, reasons, _errors(loops, recordings))


_PLAIN = "in these terms"


def _choices(loop: ClosedLoop) -> tuple[dict[str, ClosedLoop], dict[str, str]]:
    """The unchanged loop, without each effect that cannot be expressed, and without all of them."""
    loops, reasons = {"as identified": loop}, {}
    why = unsaid(loop)
    if -1 in why:
        reasons["as identified"] = why[-1]
    places = [k for k in why if k >= 0]
    for k in places:
        effect = loop.effects[k]
        label = f"without {effect_on(effect.effect_name(), getattr(effect, 'joint', None))}"
        others = [e for i, e in enumerate(loop.effects) if i != k]
        loops[label], reasons[label] = loop.with_effects(others), why[k]
    if places:
        kept = [e for i, e in enumerate(loop.effects) if i not in places]
        loops[_PLAIN] = loop.with_effects(kept)
    return loops, reasons


def _told(
    loop: ClosedLoop, recordings: Recordings
) -> dict[tuple[str, ...], tuple[JointTerms, ...]]:
    """The terms by recordings with the same drive settings, at the medians of these."""
    groups: dict[Any, list[Recording]] = {}
    for r in recordings:
        own = [(name, np.median(getattr(r, name), axis=0)) for name in r.held_names]
        key = tuple((name, tuple(x)) for name, x in own if name in ("kp", "kd"))
        groups.setdefault(key, []).append(r)
    return {
        tuple(r.name for r in group): joint_terms(
            loop,
            {
                name: np.median(np.concatenate([getattr(r, name) for r in group]), axis=0)
                for name in group[0].held_names
            },
        )
        for group in groups.values()
    }


def _errors(loops: dict[str, ClosedLoop], recordings: Recordings) -> "pd.DataFrame":
    import pandas as pd

    rows = {}
    for label, loop in loops.items():
        try:
            rows[label] = compare(loop, recordings).error_percent.mean()
        except FitError:
            # A loop may diverge without an effect that stabilises it.
            rows[label] = np.inf * compare(loops["as identified"], recordings).error_percent.mean()
    return pd.DataFrame(rows).T.rename_axis("choice")


def _shown(value: float | None) -> float:
    return np.nan if value is None else value
