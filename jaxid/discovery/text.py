"""A story as text for a terminal of 80 columns: errors, added effects, models."""

import textwrap
from collections.abc import Sequence

import numpy as np

from ..effects import AbstractEffect
from .models import Model

WIDTH = 80
# Joints per table; characters of a number; number of listed models.
_JOINTS, _NUMBER, _MODELS = 6, 9, 8


def joined(words: Sequence[str]) -> str:
    """A list in a sentence: `a, b and c`."""
    return " and ".join(x for x in (", ".join(words[:-1]), *words[-1:]) if x)


def in_brackets(words: str) -> str:
    """The words in brackets after a space; empty if there are none."""
    return f" ({words})" if words else ""


def capitalised(words: str) -> str:
    """The words with a capital first letter; the others are unchanged."""
    return f"{words[:1].upper()}{words[1:]}"


def wrapped(text: str) -> list[str]:
    """A paragraph in lines; all lines except the first are indented."""
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def errors_table(
    steps: Sequence[tuple[str, Sequence[float], Sequence[float] | None]], floor: Sequence[float]
) -> list[str]:
    """Relative errors by step and joint, with the noise floor; more joints in further tables.

    **Arguments:**

    - `steps`: label, errors on fitted recordings and on held-out ones by joint, %.
    - `floor`: noise floor by joint, %.
    """
    lines = []
    for first in range(0, len(floor), _JOINTS):
        some = slice(first, first + _JOINTS)
        joints = [f"joint {j}" for j in range(1, len(floor) + 1)][some]
        left = WIDTH - _NUMBER * _JOINTS

        def row(name: str, cells: Sequence[str], left: int = left) -> list[str]:
            *above, last = textwrap.wrap(name, left - 1, subsequent_indent="  ")
            return [*above, f"{last:<{left}}" + "".join(f"{c:>{_NUMBER}}" for c in cells)]

        lines += row("relative error, %", joints)
        for label, fitted, held_out in steps:
            lines += textwrap.wrap(label, WIDTH, subsequent_indent="  ")
            lines += row("  fitted", [_percent(x) for x in fitted[some]])
            if held_out is not None:
                lines += row("  held out", [_percent(x) for x in held_out[some]])
        lines += row("noise floor", [_percent(x) for x in floor[some]])
    return lines


def models_lines(models: Sequence[Model], final: Sequence[AbstractEffect] = ()) -> list[str]:
    """The best models by their row in the table of models, with the starting model.

    Errors are those of the worst joint; `~` marks predictions.

    **Arguments:**

    - `final`: the effects of the final model, which are named together if there are several.
    """
    numbered = list(enumerate(models))
    shown = [(k, m) for k, m in numbered if k < _MODELS or m.label == "start"]
    widths = (11, 8, 10, 10)
    left = WIDTH - sum(widths) - 4
    heads = ("difference", "weight", "fitted,%", "held out")
    lines = [f"{'row':<4}{'model':<{left}}" + _cells(heads, widths)]
    for k, m in shown:
        # A joint's number stays with its word.
        label = m.label_beside(final).replace("joint ", "joint\u00a0")
        *above, last = textwrap.wrap(label, left - 1, subsequent_indent="  ")
        mark = "" if m.fit is not None else "~"
        cells = (
            f"{m.score - models[0].score:.1f}",
            f"{m.weight:.3f}",
            mark + _worst(m.left),
            _worst(m.unseen_percent),
        )
        numbers = [str(k), *("" for _ in above)]
        names = [f"{no:<4}{name}" for no, name in zip(numbers, (*above, last), strict=True)]
        numbers_of = f"{names[-1]:<{left + 4}}" + _cells(cells, widths)
        lines += [line.replace("\u00a0", " ").rstrip() for line in (*names[:-1], numbers_of)]
    legend = ["difference: of the score from the best model; a difference of ten is decisive"]
    legend += ["errors of the worst joint; ~ predicted, story.choose(row) fits it in full"]
    if any("final" in m.label_beside(final).split() for _, m in shown):
        legend += ["final: the model with all added effects"]
    curves = [m.curve for _, m in shown if m.curve is not None]
    if curves:
        said = "; ".join(dict.fromkeys(f"{c.label}: {c.spoken_coordinate}" for c in curves))
        legend += wrapped(f"curve of ...: free-form function of a coordinate; {said}")
    return [*lines, *legend]


def _cells(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


def _percent(x: float) -> str:
    return f"{x:.3f}" if x < 1000 else f"{x:.3g}"


def _worst(percent: np.ndarray | None) -> str:
    return "" if percent is None else _percent(float(np.max(percent)))
