"""Equations of the pages as MathML, made while the site is built: no script, no network."""

import html
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

# What latex2mathml leaves to browsers, and they get wrong: bars that grow on one side, room around
# bars and strokes, a dot far above its letter.
BAR = re.compile(r"<mo(?: stretchy=\"false\")?>(&#x0007C;|&#x02016;|&#x0002F;)</mo>")
DOT = re.compile(r"<mover>(<mi>[^<]*</mi><mo>&#x002D9;</mo></mover>)")
# What pymdownx.arithmatex leaves of $…$ and of $$…$$.
FOUND = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, page: Any, **_: Any) -> str:
    """MkDocs calls this with the HTML of each page."""

    def mathml(found: re.Match[str]) -> str:
        latex = html.unescape(found[2]).strip()
        display = "block" if found[1] == "div" else "inline"
        made = convert(latex, display=display)
        if "\\" in made:  # a command unknown to latex2mathml comes out as it went in
            raise PluginError(f"{page.file.src_uri}: no MathML for {latex}: {made}")
        made = BAR.sub(r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>', made)
        made = DOT.sub(r'<mover accent="true">\1', made)
        return f'<div class="equation">{made}</div>' if display == "block" else made

    return FOUND.sub(mathml, content)
