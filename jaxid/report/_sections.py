"""The sections of the page in reading order."""

from collections.abc import Sequence

from ..discovery import Discovery
from ._again import settings
from ._beside import Beside
from ._effects import effects
from ._errors import errors, rest
from ._head import head, notes
from ._html import Markup, anchor, join, link, tag
from ._models import models
from ._next import ahead
from ._parameters import parameters
from ._signals import signals


def body(story: Discovery) -> Markup:
    """The verdict, the main figure, and then the supporting sections."""
    beside = Beside.of(story)
    first = signals(beside)
    after = [
        notes(story),
        effects(story),
        errors(beside),
        models(story),
        parameters(story),
        rest(beside),
        ahead(story),
        settings(story),
    ]
    sections = [section for section in after if section is not None]
    return join(head(story), first, _contents([first, *sections]), *sections)


def _contents(sections: Sequence[Markup]) -> Markup:
    titles = [piece.split("<h2>")[1].split("</h2>")[0] for piece in sections]
    return tag("nav", *(link(Markup(t), anchor(t)) for t in titles), aria_label="sections")
