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
from jaxtyping import Bool, Float

from ..display.shown import AbstractShown
from ..effects import AbstractEffect, Curve
from ..errors import ModelError
from ..estimate import Fit
from ..estimate.oem import oem_of
from ..estimate.result import joint_columns
from ..recording import Recording, Recordings
from ..simulation.loop import ClosedLoop
from ..storage.saved import save
from .diagnosis import Diagnosis, over_recordings
from .effect_curves import EffectCurve, effect_curve
from .floor import SPOKEN
from .hypotheses import effect_on
from .landscape import form
from .models import Model, models_table, named, picked
from .step import (
    Step,
    added_in_words,
    errors_of,
    found_parameters,
    gained,
    joint_errors,
    odds,
    step_name,
)
from .text import WIDTH, capitalised, errors_table, in_brackets, joined, models_lines, wrapped
from .undecided import probability_of_start
from .verdict import Outcome
from .verify import Refits

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go


# Models that a notebook shows.
_SHOWN = 8


class Discovery(AbstractShown):
    """The story of a search: the effects that the model lacked, step by step, and the verdict.

    - `verdict`: `"adequate"` (no candidate improves the score of the starting model, which passes
      the tests), `"explained"` (effects were added, no further candidate improves the score, and
      the model passes the tests), `"outside_catalogue"` (a curve of one coordinate describes the
      residual better than effects of the catalogue do) or `"undetermined"` (the model fails a test,
      the recordings do not decide, or the search stopped at `most` or was interrupted).
    - `steps`: the first is the starting model.
    - `reason`: why it is undetermined, and what to do; empty for the other verdicts.
    - `considered`: the examined models, best first.
    - `removed`: effects that were added, and removed later because they were not needed.
    - `unfinished`: whether the limit `most` stopped the search although another effect would
      improve the score. The verdict is then `"undetermined"`.
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
        return self._said(added_in_words(self.steps))

    @property
    def headline(self) -> str:
        """The verdict in a sentence, without the probabilities of the added effects."""
        return self._said(added_in_words(self.steps, sure=False))

    def _said(self, effects: Sequence[str]) -> str:
        added = joined(effects)
        if self.interrupted:
            so_far = f"adds {added}" if added else "is the starting model"
            return f"The search was interrupted: the best model until then {so_far}."
        if self.unfinished and not added:
            return f"The model of {self.loop.name} lacks an effect, but none was to be added."
        if self.verdict == "undetermined":
            doing = " and ".join(x for x in (f"adds {added}", gained(self.steps)) if x)
            best = f"the best model {doing}, but " if added else ""
            return (
                f"These recordings do not tell what the model of {self.loop.name} lacks: "
                f"{best}{self.reason}."
            )
        if self.verdict == "adequate":
            measured = self.diagnosis.measured
            coloured = measured is not None and measured.coloured.any()
            rest = "what does not depend on the motion" if coloured else "their noise"
            return (
                f"The model of {self.loop.name} describes these recordings down to {rest}: "
                f"nothing is missing{self._sure()}."
            )
        if self.verdict == "explained":
            return f"The model lacked {added}; with that, nothing is left to explain."
        lacked = f"The model lacked {added}; " if added else ""
        if not self.diagnosis.depends_on():
            return capitalised(f"{lacked}none of the examined effects explains what is left.")
        hypothesis = self.diagnosis.where[0].hypothesis
        curve = hypothesis.effect
        assert isinstance(curve, Curve)
        on = "time" if curve.coordinate == "t" else f"the {curve.spoken_coordinate}"
        how = " and on the direction of motion" if curve.signed else ""
        cause = (
            " A torque constant that varies with the current, or a drive that limits its torque, "
            "has this effect."
        )
        by_torque = curve.coordinate == "tau" and curve.of == hypothesis.joint
        return capitalised(
            f"{lacked}none of the examined effects explains how the residual torque of joint "
            f"{hypothesis.joint} depends on {on}{how}.{cause * by_torque}"
        )

    def _sure(self) -> str:
        """The probability of the starting model, as part of a sentence."""
        there = any(not m.effects and m.curve is None for m in self.considered)
        return f" (probability {odds(probability_of_start(self.considered))})" if there else ""

    def table(self) -> "pd.DataFrame":
        """Error by step and joint, on fitted and held-out recordings, %."""
        import pandas as pd

        rows = []
        for step in self.steps:
            row: dict[str, Any] = {"step": step.label}
            for j, x in enumerate(joint_errors(step.fit.error_percent), start=1):
                row[f"fit, joint {j}"] = x
            if step.held_out is not None:
                for j, x in enumerate(joint_errors(step.held_out.error_percent), start=1):
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

        series = {"fitted": np.stack([joint_errors(s.fit.error_percent) for s in self.steps])}
        unseen = [s.held_out for s in self.steps if s.held_out is not None]
        if len(unseen) == len(self.steps):
            series["held out"] = np.stack([joint_errors(x.error_percent) for x in unseen])
        labels = [step.label for step in self.steps]
        return figures.error_falling(labels, series, self.noise_floor_percent())

    def noise_floor_percent(self) -> Float[np.ndarray, " joints"]:
        """Relative error that a perfect model would leave on the fitted recordings, %."""
        return self.diagnosis.floor_percent()

    def floor_in_doubt(self) -> Bool[np.ndarray, " joints"]:
        """For which joints the noise floor is too high if an effect is missing.

        It is estimated by a model there, and no examined model passes the tests.
        """
        measured = self.diagnosis.measured
        if self.verdict not in ("outside_catalogue", "undetermined"):
            return np.zeros(self.loop.joints, bool)
        if measured is None:
            return np.ones(self.loop.joints, bool)
        return np.asarray(~np.isfinite(measured.percent).all(axis=0))

    def _floor_sources(self) -> list[str]:
        """Sources of the noise floor, with its interval if it was measured."""
        joints = joint_columns(self.loop.joints)
        measured = self.diagnosis.measured
        by_source: dict[str, list[str]] = {}
        doubtful = self.floor_in_doubt()
        for j, (label, sources) in enumerate(
            zip(joints, self.diagnosis.floor_sources(), strict=True)
        ):
            said = " and ".join(SPOKEN[s] for s in sources)
            if measured is not None and np.isfinite(measured.percent[:, j]).all():
                low, high = (over_recordings(x)[j] for x in (measured.low, measured.high))
                label = f"{label} ({low:.3g} to {high:.3g} %)"
            elif doubtful[j]:
                said += ", too high if an effect is missing"
            by_source.setdefault(said, []).append(label)
        return [f"noise floor {s}: {', '.join(labels)}" for s, labels in by_source.items()]

    def suggestion(self) -> Curve:
        """The free-form curve that explains most of the residual, with its predicted values.

        It is an effect, so `jaxid.fit(story.loop.add(story.suggestion()), recordings)` fits the
        model with it.

        **Raises:** `ModelError` if no curve explains a significant part of the residual.
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
                    "parameters": found_parameters(self.steps, k),
                    "probability": None if step.unseen == "raises" else step.probability,
                    "held_out": step.unseen,
                    "indistinguishable": [{"effect": n, "joint": j} for n, j in step.alike],
                }
                for k, step in enumerate(s for s in self.steps if s.added is not None)
                if step.added is not None
            ],
            "depends_on": self.diagnosis.depends_on() if outside else [],
            "error_percent": {"before": errors_of(first), "after": errors_of(last)},
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
            (s.label, joint_errors(s.fit.error_percent).tolist(), None)
            if s.held_out is None
            else (s.label, *(joint_errors(x.error_percent).tolist() for x in (s.fit, s.held_out)))
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
            values = found_parameters(self.steps, k)
            shown = ", ".join(
                f"{n} {p['value']:.4g}"
                + (f" ± {p['std']:.2g}" if p["std"] is not None else "")
                + ("" if p["unit"] == "1" else f" {p['unit']}")
                for n, p in values.items()
            )
            lines.append(f"{step_name(step)}{in_brackets(step.belief())}: {shown}")
            if step.alike:
                others = ", ".join(effect_on(n, j) for n, j in step.alike)
                lines.append(f"these recordings cannot distinguish {step_name(step)} from {others}")
        if any(step.probability is None for step in self.steps):
            lines.append("no probabilities are given, because no examined model passes the tests")
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
