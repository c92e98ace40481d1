"""Equations as MathML, which browsers draw without a script."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Replaces what arithmatex has marked; called by mkdocs for every page."""

    def drawn(display: str):
        return lambda found: convert(html.unescape(found.group(1)).strip(), display=display)

    return BLOCK.sub(drawn("block"), INLINE.sub(drawn("inline"), content))
