"""Which shape a mouth has when, from the letters of a text and the time it takes to say them.

The names are those that talking heads agree on: ``sil``, ``PP``, ``FF``, ``TH``, ``DD``, ``kk``, ``CH``, ``SS``,
``nn``, ``RR``, ``aa``, ``E``, ``ih``, ``oh``, ``ou``. Letters are no sounds, but near enough for a mouth.
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
_BY_LETTERS = {letters: shape for shape, listed in _SOUNDS.items() for letters in listed.split()}
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
"""What does for a shape that a robot lacks, the best first."""
VOWELS = frozenset({"aa", "E", "ih", "oh", "ou"})
_LONG, _SHORT, _PAUSE = 1.6, 1.0, 2.5
"""How long a vowel, a consonant and a pause last, by each other."""
_TOKENS = re.compile(r"th|sh|ch|[a-z]|[.,;:!?]|\s")
CHARACTERS_PER_S = 14.0
"""About what a calm speaker says; where no voice has said how long it takes."""
_SHORTEST_S = 0.4


def estimate_duration_s(text: str) -> float:
    """How long a text takes to say where there is no sound [s]."""
    return max(_SHORTEST_S, len(text) / CHARACTERS_PER_S)


def visemes_of(text: str, duration_s: float, there: Collection[str]) -> list[tuple[float, str]]:
    """When the mouth is to have which shape: time from the beginning [s] and the name of a viseme, times rising.

    Args:
        text: What is said.
        duration_s: How long that takes.
        there: The visemes that the robot has. Sounds for which it has none are left out.
    """
    plain = unicodedata.normalize("NFD", text.lower())
    parts: list[tuple[str, float]] = []
    for token in _TOKENS.findall(plain):
        wanted = _BY_LETTERS.get(token)
        if wanted is None:
            weight = _SHORT / 2 if token.isspace() else _PAUSE
            parts.append((REST, weight))
        else:
            parts.append((wanted, _LONG if wanted in VOWELS else _SHORT))
    whole = sum(weight for _, weight in parts)
    found, begun = [], 0.0
    for wanted, weight in parts:
        shape = next((one for one in (wanted, *_NEAREST.get(wanted, ())) if one in there), None)
        if shape is not None:
            found.append(((begun + weight / 2) / whole * duration_s, shape))
        begun += weight
    return found
