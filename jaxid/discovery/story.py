"""The result of a discovery: its steps, its verdict, and its display."""

import dataclasses
import html
import os
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..display.shown import AbstractShown
from ..effects import AbstractEffect, Curve
from ..errors import ModelError
from ..estimate import Fit
from ..estimate.oem import oem_of
from ..estimate.result import joint_columns
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..storage.saved import save
from .comparison import Comparison
from .diagnosis import Diagnosis, over_recordings
from .effect_curves import EffectCurve, effect_curve
from .floor import SPOKEN
from .hypotheses import effect_on, on_recordings
from .landscape import form
from .models import Model, models_table, named, picked
from .text import WIDTH, errors_table, models_lines, wrapped
from .verdict import Outcome
from .verify import Refits

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


# Models that a notebook shows.
_SHOWN = 8


class Step(eqx.Module):
    """The model with one more of the added effects.

    `diagnosis` exists if the search continued from this model, and for the first and last step.
    `added` is the effect that this step adds to the previous one; `probability` is the weight of
    all models with it; `alike` are effects that these recordings cannot distinguish from it.
    """

    label: str
    fit: Fit
    held_out: Comparison | None
    diagnosis: Diagnosis | None
    added: AbstractEffect | None = None
    alike: tuple[tuple[str, int | None], ...] = ()
    probability: float = 1.0


class Discovery(AbstractShown):
    """The story of a search: the effects that the model lacked, step by step, and the verdict.

    - `verdict`: `"adequate"`, `"explained"`, `"outside_catalogue"` or `"undetermined"`.
    - `steps`: the first is the starting model.
    - `reason`: why it is undetermined, and what to do; empty for the other verdicts.
    - `considered`: the examined models, best first.
    - `removed`: effects that were added, and removed later because they were not needed.
    - `unfinished`: whether the limit `most` stopped the search before all effects were added.
    - `interrupted`: whether the search was interrupted; the last step is the best model until then.
    """

    verdict: Outcome = eqx.field(static=True)
    steps: tuple[Step, ...]
    reason: str = eqx.field(static=True, default="")
    considered: tuple[Model, ...] = ()
    removed: tuple[tuple[str, int | None], ...] = ()
    notes: tuple[str, ...] = eqx.field(static=True, default=())
    seconds: float = eqx.field(static=True, default=0.0)
    unfinished: bool = eqx.field(static=True, default=False)
    interrupted: bool = eqx.field(static=True, default=False)

    @property
    def fit(self) -> Fit:
        """The last fit."""
        return self.steps[-1].fit

    @property
    def loop(self) -> ClosedLoop:
        """The model at the end."""
        return self.fit.loop

    @property
    def diagnosis(self) -> Diagnosis:
        """The diagnosis of the model at the end; of an interrupted search, the last diagnosis."""
        return [step.diagnosis for step in self.steps if step.diagnosis is not None][-1]

    @property
    def first_diagnosis(self) -> Diagnosis:
        """The diagnosis of the starting model."""
        found = self.steps[0].diagnosis
        assert found is not None
        return found

    @property
    def sentence(self) -> str:
        """The verdict in a sentence for a colleague."""
        return self._said(_spoken(self.steps))

    @property
    def headline(self) -> str:
        """The verdict in a sentence, without the probabilities of the added effects."""
        return self._said(_spoken(self.steps, sure=False))

    def _said(self, effects: Sequence[str]) -> str:
        added = _joined(effects)
        if self.interrupted:
            so_far = f"adds {added}" if added else "is the starting model"
            return f"The search was interrupted: the best model until then {so_far}."
        if self.verdict == "undetermined":
            best = f"the best model adds {added}, but " if added else ""
            return (
                f"These recordings do not tell what the model of {self.loop.name} lacks: "
                f"{best}{self.reason}."
            )
        if self.unfinished and not added:
            return f"The model of {self.loop.name} lacks an effect, but none was to be added."
        if self.verdict == "adequate":
            return (
                f"The model of {self.loop.name} describes these recordings down to their noise: "
                f"nothing is missing{self._sure()}."
            )
        if self.unfinished:
            return (
                f"The model lacked {added}, and is still incomplete: the search was told to stop "
                "there."
            )
        if self.verdict == "explained":
            return f"The model lacked {added}; with that, nothing is left to explain."
        lacked = f"The model lacked {added}; " if added else ""
        if not self.diagnosis.depends_on():
            return _upper(f"{lacked}no effect of the catalogue explains what is left.")
        hypothesis = self.diagnosis.where[0].hypothesis
        curve = hypothesis.effect
        assert isinstance(curve, Curve)
        on = "time" if curve.coordinate == "t" else f"the {curve.spoken_coordinate}"
        how = " and on the direction of motion" if curve.signed else ""
        return _upper(
            f"{lacked}no effect of the catalogue explains how the residual torque of joint "
            f"{hypothesis.joint} depends on {on}{how}."
        )

    def _sure(self) -> str:
        """The probability of the starting model, as part of a sentence."""
        start = next((m for m in self.considered if not m.effects and m.curve is None), None)
        return "" if start is None else f" (probability {odds(start.weight)})"

    def table(self) -> "pd.DataFrame":
        """Error by step and joint, on fitted and held-out recordings, %."""
        import pandas as pd

        rows = []
        for step in self.steps:
            row: dict[str, Any] = {"step": step.label}
            for j, x in enumerate(_rms(step.fit.error_percent), start=1):
                row[f"fit, joint {j}"] = x
            if step.held_out is not None:
                for j, x in enumerate(_rms(step.held_out.error_percent), start=1):
                    row[f"held out, joint {j}"] = x
            rows.append(row)
        return pd.DataFrame(rows).set_index("step")

    @property
    def models(self) -> "pd.DataFrame":
        """The examined models, best first, in the form of ArviZ's `compare`.

        Score and weight depend on the fitted recordings only. Errors are in %. Errors on held-out
        recordings exist for fully fitted models that are a step of the story or have a weight of at
        least a hundredth.
        """
        return models_table(self.considered)

    def contenders(self, step: int) -> tuple[Model, ...]:
        """Fully fitted models in which another effect replaces that of a step, best first.

        **Arguments:**

        - `step`: place in `steps`, from 1.
        """
        before = sorted(
            (named(s.added) for s in self.steps[1:step] if s.added is not None), key=str
        )
        return tuple(
            m
            for m in self.considered
            if m.fit is not None
            and len(m.effects) == step
            and sorted(m.names[:-1], key=str) == before
        )

    def curve(
        self,
        effect: str | AbstractEffect,
        joint: int | None = None,
        recordings: Recording | Recordings | Iterable[Recording] | None = None,
    ) -> EffectCurve:
        """Torque of an effect of the last model over its coordinate, and the residual without it.

        **Arguments:**

        - `effect`: its name as in tables, or the effect itself, one of `loop.effects`.
        - `joint`: joint of the effect, from 1; for an effect on all joints, the one to show.
        - `recordings`: by default the fitted ones.

        **Raises:** the errors of `effect_curve`.
        """
        return effect_curve(self.fit, effect, joint, recordings)

    def choose(self, model: int | str) -> Fit:
        """Another model of the table `models`, fitted in full.

        **Arguments:**

        - `model`: its row, from 0, or its name.

        **Raises:** `ModelError` if there is no such model.
        """
        chosen = picked(self.considered, model)
        if chosen.fit is not None:
            return chosen.fit
        # The model may have an effect twice.
        there = Counter(map(form, chosen.effects))
        parts = [
            m
            for m in self.considered
            if m.fit is not None and m.curve is None and Counter(map(form, m.effects)) <= there
        ]
        before = max(parts, key=lambda m: len(m.effects))
        assert before.fit is not None
        had, more = Counter(map(form, before.effects)), []
        for effect in chosen.effects:
            had[form(effect)] -= 1
            if had[form(effect)] < 0:
                more.append(effect)
        if chosen.curve is not None:
            more.append(chosen.curve)
        refits = Refits(before.fit.recordings, oem_of(before.fit))
        return refits.with_effects(before.fit, more, chosen.noise)

    def plot(self) -> "go.Figure":
        """The error falling, step by step, with the noise floor."""
        from ..display import figures

        series = {"fitted": np.stack([_rms(s.fit.error_percent) for s in self.steps])}
        if all(s.held_out is not None for s in self.steps):
            series["held out"] = np.stack(
                [_rms(s.held_out.error_percent) for s in self.steps if s.held_out is not None]
            )
        labels = [step.label for step in self.steps]
        return figures.error_falling(labels, series, self.noise_floor_percent())

    def noise_floor_percent(self) -> Float[np.ndarray, " joints"]:
        """Relative error that a perfect model would leave on the fitted recordings, %."""
        return self.diagnosis.floor_percent()

    def _floor_sources(self) -> list[str]:
        """Sources of the noise floor, with its interval if it was measured."""
        joints = joint_columns(self.loop.joints)
        measured = self.diagnosis.measured
        by_source: dict[str, list[str]] = {}
        for j, (label, sources) in enumerate(
            zip(joints, self.diagnosis.floor_sources(), strict=True)
        ):
            said = " and ".join(SPOKEN[s] for s in sources)
            if measured is not None and np.isfinite(measured.percent[:, j]).all():
                low, high = (over_recordings(x)[j] for x in (measured.low, measured.high))
                label = f"{label} ({low:.3g} to {high:.3g} %)"
            by_source.setdefault(said, []).append(label)
        return [f"noise floor {s}: {', '.join(labels)}" for s, labels in by_source.items()]

    def suggestion(self) -> Curve:
        """The free-form curve that explains most of the residual, ready to be added.

        **Raises:** `ModelError` if the residual is not significant.
        """
        if not self.diagnosis.depends_on():
            raise ModelError("nothing significant is left, so there is no curve to suggest")
        curve = self.diagnosis.predicted(self.diagnosis.where[0])
        assert isinstance(curve, Curve)
        return curve

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the story to one file, which `jaxid.load` reads.

        **Arguments:**

        - `path`: by convention with the ending `.jaxid`; an existing file is replaced.

        **Raises:** `SaveError` if it cannot be written.
        """
        return save(self.stored(), path)

    def stored(self) -> "Discovery":
        """The same for a file: all that it shows, without the signatures and states behind it.

        `jaxid.diagnose` and `jaxid.compare` make these again.
        """

        def light(given: Any) -> Any:
            return None if given is None else given.stored()

        steps = [
            dataclasses.replace(s, held_out=light(s.held_out), diagnosis=light(s.diagnosis))
            for s in self.steps
        ]
        rows = [dataclasses.replace(m, held_out=light(m.held_out)) for m in self.considered]
        return dataclasses.replace(self, steps=tuple(steps), considered=tuple(rows))

    def to_dict(self) -> dict[str, Any]:
        """The story as plain JSON, the format of `jaxid discover --json`."""
        first, last = self.steps[0], self.steps[-1]
        outside = self.verdict == "outside_catalogue"
        return {
            "robot": self.loop.name,
            "verdict": self.verdict,
            "reason": self.reason,
            "unfinished": self.unfinished,
            "interrupted": self.interrupted,
            "ranking": self.first_diagnosis.to_dict()["ranking"],
            "added": [
                {
                    "effect": step.added.effect_name(),
                    "joint": getattr(step.added, "joint", None),
                    "recordings": list(getattr(step.added, "recordings", ())),
                    "parameters": _found_parameters(self.steps, k),
                    "probability": step.probability,
                    "indistinguishable": [{"effect": n, "joint": j} for n, j in step.alike],
                }
                for k, step in enumerate(s for s in self.steps if s.added is not None)
                if step.added is not None
            ],
            "depends_on": self.diagnosis.depends_on() if outside else [],
            "error_percent": {"before": _errors(first), "after": _errors(last)},
            "noise_floor_percent": self.noise_floor_percent().tolist(),
            "noise_floor_source": [list(s) for s in self.diagnosis.floor_sources()],
            "sentence": self.sentence,
            "removed": [{"effect": n, "joint": j} for n, j in self.removed],
            "models": [m.to_dict(self.considered[0].score) for m in self.considered],
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    def __repr__(self) -> str:
        steps = [
            (s.label, _rms(s.fit.error_percent).tolist(), None)
            if s.held_out is None
            else (s.label, *(_rms(x.error_percent).tolist() for x in (s.fit, s.held_out)))
            for s in self.steps
        ]
        lines = [
            *textwrap.wrap(f"{self.verdict}: {self.sentence}", WIDTH, break_on_hyphens=False),
            "",
            *errors_table(steps, self.noise_floor_percent().tolist()),
            *(x for line in self._floor_sources() for x in wrapped(line)),
        ]
        found = self._found()
        lines += ["", *(x for line in found for x in wrapped(line))] if found else []
        if len(self.considered) > 1:
            final = tuple(s.added for s in self.steps if s.added is not None)
            lines += ["", *models_lines(self.considered, final)]
        return "\n".join([*lines, *(x for note in self.notes for x in wrapped(note))])

    def _found(self) -> list[str]:
        """Each added effect with its probability, values, and indistinguishable alternatives."""
        lines = []
        for k, step in enumerate(s for s in self.steps if s.added is not None):
            values = _found_parameters(self.steps, k)
            shown = ", ".join(
                f"{n} {p['value']:.4g}"
                + (f" ± {p['std']:.2g}" if p["std"] is not None else "")
                + f" {p['unit']}"
                for n, p in values.items()
            )
            sure = f" (probability {odds(step.probability)})"
            lines.append(f"{step_name(step)}{sure}: {shown}")
            if step.alike:
                others = ", ".join(effect_on(n, j) for n, j in step.alike)
                lines.append(f"these recordings cannot distinguish {step_name(step)} from {others}")
        return lines

    def _repr_html_(self) -> str:
        errors = self.table().rename(columns=lambda name: f"{name}, %")
        floor = ", ".join(f"{x:.3f} %" for x in self.noise_floor_percent())
        found = (*self._found(), *self.notes)
        lines = "".join(f"<li>{html.escape(line)}</li>" for line in found)
        models = self.models.head(_SHOWN).to_html(float_format="%.3g")
        return (
            f"<p><b>{html.escape(self.sentence)}</b></p><p>relative error by step</p>"
            f"{errors.to_html(float_format='%.3f')}<p>noise floor by joint: {floor}</p>"
            f"<ul>{lines}</ul><p>models, best first</p>{models}"
        )


def odds(share: float) -> str:
    """A probability in words with few digits, such as `> 0.999`."""
    if share < 0.001:
        return "< 0.001"
    return "> 0.999" if share > 0.999 else f"{share:.3g}"


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _joined(words: Sequence[str]) -> str:
    """A list in a sentence: `a, b and c`."""
    return " and ".join(x for x in (", ".join(words[:-1]), *words[-1:]) if x)


def _spoken(steps: Sequence[Step], sure: bool = True) -> list[str]:
    """Added effects in words, with their probabilities if `sure`; repeated ones are named once."""
    added = [(step.added, step.probability) for step in steps if step.added is not None]
    counted = Counter(_placed(e.spoken(), e) for e, _ in added)
    shares = {_placed(e.spoken(), e): odds(share) for e, share in added}
    often = {1: "", 2: " twice"}
    return [
        f"{name}{often.get(n, f' {n} times')}{f' (probability {shares[name]})' * sure}"
        for name, n in counted.items()
    ]


def step_name(step: Step) -> str:
    """The effect of a step by name and joint, with its recordings if it is not on all."""
    assert step.added is not None
    return _placed(step.added.effect_name(), step.added)


def _placed(name: str, effect: AbstractEffect) -> str:
    return effect_on(name, getattr(effect, "joint", None)) + on_recordings(effect)


def _rms(table: "pd.DataFrame") -> Float[np.ndarray, " joints"]:
    return over_recordings(table.to_numpy())


def _errors(step: Step) -> dict[str, list[float]]:
    errors = {"fit": _rms(step.fit.error_percent).tolist()}
    if step.held_out is not None:
        errors["validate"] = _rms(step.held_out.error_percent).tolist()
    return errors


def _found_parameters(steps: Sequence[Step], added: int) -> dict[str, dict[str, Any]]:
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
        steps = p.where.steps  # type: ignore[attr-defined]
        if steps[:2] == ("effects", position):
            for k in range(p.size):
                name = steps[-1] if not p.several else f"{steps[-1]}[{k + 1}]"
                found.append((place + k, str(name), loop.unit(p)))
        place += p.size
    return found
