"""Equations of the pages as MathML, made while the site is built: no script, no network."""

import html
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

# latex2mathml lets bars grow with what follows them, on one side only.
BAR = re.compile(r"<mo>(&#x0007C;|&#x02016;)</mo>")
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
        made = BAR.sub(r'<mo stretchy="false">\1</mo>', made)
        return f'<div class="equation">{made}</div>' if display == "block" else made

    return FOUND.sub(mathml, content)
