"""Visemes: mouth shapes over time, from the letters of a text and its duration.

The names are the common viseme set: ``sil``, ``PP``, ``FF``, ``TH``, ``DD``, ``kk``, ``CH``, ``SS``,
``nn``, ``RR``, ``aa``, ``E``, ``ih``, ``oh``, ``ou``. Letters approximate the sounds.
"""

import re
import unicodedata
from collections.abc import Collection

REST = "sil"
_SOUNDS = {
    "aa": "a",
    "E": "e",
    "ih": "i y j",
    "oh": "o",
    "ou": "u w",
    "PP": "p b m",
    "FF": "f v",
    "TH": "th",
    "DD": "t d",
    "kk": "k g q x h",
    "CH": "sh ch",
    "SS": "s z c",
    "nn": "n l",
    "RR": "r",
}
_BY_LETTERS = {letters: shape for shape, sounds in _SOUNDS.items() for letters in sounds.split()}
_NEAREST = {
    "E": ("ih", "aa"),
    "ih": ("E", "aa"),
    "oh": ("ou", "aa"),
    "ou": ("oh", "aa"),
    "aa": ("E", "oh"),
    "TH": ("DD", "nn", "SS", "ih"),
    "DD": ("nn", "TH", "ih"),
    "kk": ("DD", "ih", "aa"),
    "CH": ("SS", "ou", "ih"),
    "SS": ("CH", "ih"),
    "nn": ("DD", "ih"),
    "RR": ("ou", "E", "ih"),
    "FF": ("PP", "sil"),
    "PP": ("sil", "FF"),
}
"""Substitutes for a shape that a robot lacks, the best first."""
VOWELS = frozenset({"aa", "E", "ih", "oh", "ou"})
_LONG, _SHORT, _PAUSE = 1.6, 1.0, 2.5
"""Relative durations of a vowel, a consonant and a pause."""
_TOKENS = re.compile(r"th|sh|ch|[a-z]|[.,;:!?]|\s")
CHARACTERS_PER_S = 14.0
"""Rate of a calm speaker; used without synthesized audio [1/s]."""
_SHORTEST_S = 0.4


def estimate_duration_s(text: str) -> float:
    """Estimated speaking time of a text without audio [s]."""
    return max(_SHORTEST_S, len(text) / CHARACTERS_PER_S)


def visemes_of(text: str, duration_s: float, available: Collection[str]) -> list[tuple[float, str]]:
    """Times from the start [s] and names of the available visemes, in order of time."""
    plain = unicodedata.normalize("NFD", text.lower())
    parts: list[tuple[str, float]] = []
    for token in _TOKENS.findall(plain):
        shape = _BY_LETTERS.get(token)
        if shape is None:
            weight = _SHORT / 2 if token.isspace() else _PAUSE
            parts.append((REST, weight))
        else:
            parts.append((shape, _LONG if shape in VOWELS else _SHORT))
    total = sum(weight for _, weight in parts)
    visemes, start = [], 0.0
    for shape, weight in parts:
        substitute = next((name for name in (shape, *_NEAREST.get(shape, ())) if name in available), None)
        if substitute is not None:
            visemes.append(((start + weight / 2) / total * duration_s, substitute))
        start += weight
    return visemes
