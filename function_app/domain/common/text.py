"""Characters of names and labels that people enter and other people read."""

import unicodedata
from typing import Final

_REJECTED: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Control, format (zero-width, bidirectional), surrogate, private and unassigned characters, and line separators."""


def label_error(text: str) -> str:
    """Why ``text`` is not valid as a label, as the end of a sentence; empty: it is valid."""
    for character in text:
        if unicodedata.category(character) in _REJECTED:
            return f"contains the control or invisible character U+{ord(character):04X}; remove it"
    return ""


def require_label(text: str, field: str) -> None:
    """Raise ``ValueError`` if ``text`` is not valid as a label; ``field`` is its name in the request."""
    error = label_error(text)
    if error:
        raise ValueError(f"{field} {error}")


def clean_label(text: str) -> str:
    """``text`` with a space for each character that a label must not contain; for text that must not be rejected."""
    return "".join(" " if unicodedata.category(each) in _REJECTED else each for each in text)
