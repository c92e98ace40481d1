"""A model said in a simulator's terms, and the error that each thing they do not say leaves."""

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
    """What to type into a simulator for each joint, and what that leaves out.

    - `joints`: by the names of recordings whose drives were told the same, the terms of each joint.
    - `loops`: by choice: the model as it was identified, without each effect that there is no term
      for, without all of them, and without them with the rest fitted again, to which `joints` then
      belong.
    - `reasons`: why there is no term, by the choice that leaves it out.
    - `errors`: mean over the recordings of the relative error of what the model is judged by, by
      choice and joint, %.
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
        """The error that each choice leaves, and why what it leaves out cannot be said."""
        return self.errors.assign(reason=[self.reasons.get(c, "") for c in self.errors.index])

    def __repr__(self) -> str:
        terms = self.table().to_string(float_format=lambda x: f"{x:.4g}")
        choices = self.choices().to_string(float_format=lambda x: f"{x:.4g}")
        return f"{terms}\n\nrelative error in % of what can be chosen:\n{choices}"


def simulator_terms(
    model: Fit | ClosedLoop,
    recordings: Recording | Recordings | Iterable[Recording] | None = None,
    *,
    refit: bool = True,
    method: OEM | None = None,
) -> SimulatorTerms:
    """Says a model as armature, damping, frictionloss, kp, kd, forcerange and delay.

    These are MuJoCo's terms, which Isaac and most trainers of legged robots took over. A motor's
    back-EMF is damping that no limit cuts off, and the limit of its voltage is one of torque.

    **Arguments:**

    - `model`: a fit or a loop.
    - `recordings`: on which errors are compared; those of the fit where None.
    - `refit`: whether what can be said is fitted again without the rest, and the terms are those
      that are found then.
    - `method`: of that fit; that of the fit, or the default.

    **Raises:** `FitError` for a loop without recordings.
    """
    loop = model.loop if isinstance(model, Fit) else model
    if recordings is None:
        if not isinstance(model, Fit):
            raise FitError("a loop has no recordings to compare choices on: give some")
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
    """The loop as it is, without each effect that cannot be said, and without all of them."""
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
    """The terms by the recordings whose drives were told the same, in the middle of each."""
    groups: dict[Any, tuple[list[str], dict[str, np.ndarray]]] = {}
    for r in recordings:
        told = {name: np.median(getattr(r, name), axis=0) for name in r.held_names}
        key = tuple((name, tuple(x)) for name, x in told.items() if name in ("kp", "kd"))
        groups.setdefault(key, ([], told))[0].append(r.name)
    return {tuple(names): joint_terms(loop, told) for names, told in groups.values()}


def _errors(loops: dict[str, ClosedLoop], recordings: Recordings) -> "pd.DataFrame":
    import pandas as pd

    rows = {}
    for label, loop in loops.items():
        try:
            rows[label] = compare(loop, recordings).error_percent.mean()
        except FitError:
            # Without a part that holds it, a loop may run away.
            rows[label] = np.inf * compare(loops["as identified"], recordings).error_percent.mean()
    return pd.DataFrame(rows).T.rename_axis("choice")


def _shown(value: float | None) -> float:
    return np.nan if value is None else value
