"""Text for terminals whose encoding lacks Greek letters and signs of mathematics."""

from __future__ import annotations

import codecs
import io
import sys
import unicodedata

PLAIN = {
    **{"▷": ">", "→": "->", "≤": "<=", "≥": ">=", "±": "+-", "×": "x", "·": "*", "√": "sqrt "},
    **{"–": "-", "−": "-", "…": "...", "°": " deg", "²": "^2", "³": "^3", "ε": "eps", "µ": "u"},
    **{"φ": "phi", "σ": "sigma", "Δ": "d", "■": "*", "●": "*", "′": "'"},
    **dict.fromkeys("─━", "-") | dict.fromkeys("│┃", "|") | dict.fromkeys("╭╮╰╯┌┐└┘├┤", "+"),
}


def _plain(error: UnicodeError) -> tuple[str, int]:
    """What stands for characters that an encoding lacks: words, letters without accents, or ?."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = ""
    for sign in error.object[error.start : error.end]:
        bare = unicodedata.normalize("NFKD", sign).encode("ascii", "ignore").decode()
        text += PLAIN.get(sign, bare or "?")
    return text, error.end


def speak_plainly() -> None:
    """Let what this process prints be readable whatever its terminal can show."""
    codecs.register_error("hqp_grasp.plain", _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="hqp_grasp.plain")
