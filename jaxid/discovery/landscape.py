"""All hypotheses compared with the residual of a set of effects in the linear system."""

from collections import Counter
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects import AbstractEffect, AbstractTransmission, Curve
from .bounded import bounded_amplitudes
from .data import Data
from .diagnosis import Diagnosis
from .hypotheses import Hypothesis, sized
from .predict import Prediction, Predictor
from .ranking import Screened
from .score import Gram, Whitened, by_width, explained_by, spanned, strong_directions


class Entry(eqx.Module):
    """A hypothesis in addition to a set of effects: what it would explain, minus its price."""

    hypothesis: Hypothesis
    evidence: float
    effect: AbstractEffect


class Landscape(eqx.Module):
    """The whitened table of signatures, with its linear system."""

    predictor: Predictor
    data: Data
    hypotheses: tuple[Hypothesis, ...]
    white: Whitened
    gram: Gram

    @classmethod
    def of(cls, screened: Screened, diagnosis: Diagnosis) -> "Landscape":
        """The landscape of a fit, from its signatures and its diagnosis with all their products."""
        data, noise = diagnosis.data, diagnosis.noise
        predictor = Predictor.of(screened.system, noise, data.level)
        white = Whitened.of(data, noise)
        return cls(predictor, data, screened.hypotheses, white, diagnosis.gram)

    @property
    def forms(self) -> int:
        """Number of effects to choose from."""
        return forms_of(self.hypotheses)

    def beside(self, set_: Prediction | None, most: int = 12, curves: bool = False) -> list[Entry]:
        """The best setting of each form of effect in addition to a set, best first.

        **Arguments:**

        - `most`: number of forms. `curves`: free-form curves instead of effects.
        """
        return self._entries(*self._left(set_), most, curves)

    def pairs(self, set_: Prediction | None, firsts: Sequence[Entry]) -> list[tuple[Entry, Entry]]:
        """For each given entry, the entry that explains most in addition to it and the set."""
        residual, taken = self._left(set_)
        made = []
        for first in firsts:
            own = self.white.columns(first.hypothesis.columns)
            own = strong_directions(own - taken @ (taken.T @ own))
            basis = np.concatenate([taken, own], axis=1)
            rest = residual - basis @ (basis.T @ residual)
            others = [
                e
                for e in self._entries(rest, basis, 2, False)
                if form(e.effect)[:2] != form(first.effect)[:2]
            ]
            if others:
                made.append((first, others[0]))
        return sorted(made, key=lambda pair: -(pair[0].evidence + pair[1].evidence))

    def _left(self, set_: Prediction | None) -> tuple[np.ndarray, np.ndarray]:
        """The whitened residual of a set, and directions that the set can absorb."""
        if set_ is None or not set_.effects:
            return self.white.residual, np.zeros((len(self.white.residual), 0))
        return set_.residual, spanned(set_.slopes)

    def _entries(
        self, residual: np.ndarray, taken: np.ndarray, most: int, curves: bool
    ) -> list[Entry]:
        score = self.white.products(residual[:, None])[0]
        across = self.white.products(taken)
        explained, price = np.zeros((2, len(self.hypotheses)))
        inner: dict[int, np.ndarray] = {}
        for places, columns in by_width([h.columns for h in self.hypotheses]):
            part = across[:, columns]
            gram = self.gram.gram[columns[:, :, None], columns[:, None, :]]
            gram = gram - np.einsum("kbi,kbj->bij", part, part)
            value, freedom = explained_by(gram, score[columns][..., None])
            explained[places] = value[:, 0]
            price[places] = np.where(freedom > 0, freedom * np.log(self.gram.count), np.inf)
            inner |= dict(zip(places.tolist(), gram, strict=True))
        price += 2 * np.log([h.tests for h in self.hypotheses])
        found: dict[tuple, Entry] = {}
        for place in np.argsort(price - explained).tolist():
            hypothesis = self.hypotheses[place]
            if isinstance(hypothesis.effect, Curve) != curves or not np.isfinite(price[place]):
                continue
            name = form(hypothesis.effect)
            if name not in found and len(found) == most:
                continue
            # Bounds of the amplitudes only reduce the evidence.
            least = found[name].evidence if name in found else -np.inf
            if explained[place] - price[place] > least:
                own = score[list(hypothesis.columns)]
                size = self.gram.size[list(hypothesis.columns)]
                entry = _entry(hypothesis, inner[place], own, size, float(price[place]))
                if entry is not None and entry.evidence > least:
                    found[name] = entry
        return sorted(found.values(), key=lambda e: -e.evidence)


# Not a method: equinox traverses a module, here thousands of hypotheses, for each call of a method.
def _entry(
    hypothesis: Hypothesis,
    gram: Float[np.ndarray, "columns columns"],
    score: Float[np.ndarray, " columns"],
    size: Float[np.ndarray, " columns"],
    price: float,
) -> Entry | None:
    """A hypothesis with amplitudes inside their bounds; None if all of them are at a bound."""
    limits = hypothesis.lower, hypothesis.upper
    amplitude, explained = bounded_amplitudes(gram, score, size, limits)
    if not explained > 0.0:
        return None
    effect = sized(hypothesis.effect, amplitude)
    return Entry(hypothesis, float(explained - price), effect)


def forms_of(hypotheses: Sequence[Hypothesis]) -> int:
    """Number of effects to choose from; forms and joints count separately."""
    return len({form(h.effect) for h in hypotheses})


def form(effect: AbstractEffect) -> tuple:
    """The identity of a hypothesis without its setting."""
    joint, kind = getattr(effect, "joint", None), type(effect).__name__
    if isinstance(effect, Curve):
        return effect.effect_name(), joint, (effect.label, effect.signed)
    return effect.effect_name(), joint, (kind, tuple(getattr(effect, "recordings", ())))


def shares_a_joint(effects: Sequence[AbstractEffect]) -> bool:
    """Whether two transmissions are on one joint, which can have only one."""
    joints = [e.joint for e in effects if isinstance(e, AbstractTransmission)]
    return len(joints) != len(set(joints))


def crowded(effects: Sequence[AbstractEffect], own: Sequence[AbstractEffect]) -> bool:
    """Whether a joint would have more of a kind of effect than it can have.

    A joint may have more than one effect of some kinds, such as end stops at both ends of the
    travel or harmonics of a ripple. More of them only approximate another effect.

    **Arguments:**

    - `effects`: additional effects. `own`: those that the model has.
    """
    counts = Counter(form(e)[:2] for e in (*own, *effects))
    return any(counts[form(e)[:2]] > e.several for e in effects)
