"""Password rules: a minimum length, and no common passwords.

Follows NIST SP 800-63B: a minimum length and a list of common passwords, without rules about character classes. The
minimum is higher than eight characters because a stolen table can be searched offline.
"""

import re
import unicodedata
from typing import Final

LEAST: Final = 12
MOST: Final = 256
_DIFFERENT: Final = 5
"""Fewer different characters indicate a repeated pattern."""
_COMMON: Final = frozenset(
    {
        "password",
        "passwort",
        "passphrase",
        "heslo",
        "changeme",
        "letmein",
        "welcome",
        "iloveyou",
        "administrator",
        "admin",
    }
    | {"default", "secret", "qwerty", "qwertyuiop", "qwertz", "asdfghjkl", "trustno", "football", "baseball", "monkey"}
    | {"dragon", "sunshine", "princess", "superman", "batman", "master", "login", "robot", "robots", "telescope"}
)
"""Words of leaked password lists without digits and symbols, and the name of this product."""
_ROWS: Final = (
    "abcdefghijklmnopqrstuvwxyz",
    "01234567890123456789",
    "qwertyuiopasdfghjklzxcvbnm",
    "qwertzuiopasdfghjklyxcvbnm",
    "1qaz2wsx3edc4rfv5tgb6yhn7ujm",
    "1q2w3e4r5t6y7u8i9o0p",
)
_LETTERS: Final = re.compile(r"[^\W\d_]+")
_AS_LETTERS: Final = str.maketrans("0134578@$!", "oleastbasi")


def normalize(password: str) -> str:
    """The password in Unicode normal form NFKC: keyboards encode letters such as ``é`` differently."""
    return unicodedata.normalize("NFKC", password)


def weakness(password: str, *, name: str) -> str:
    """Why a password, in normal form, is too weak for the account ``name``, as a sentence; empty: it is accepted."""
    if len(password) < LEAST:
        return f"A password has at least {LEAST} characters; use a sentence of several words."
    if len(password) > MOST:
        return f"A password has at most {MOST} characters."
    lower = password.casefold()
    if len(set(lower)) < _DIFFERENT:
        return f"A password has at least {_DIFFERENT} different characters."
    straight = lower.replace(" ", "")
    if any(straight in row * 2 or straight[::-1] in row * 2 for row in _ROWS):
        return "This password is a row of keys or letters, which is easy to guess. Choose another."
    for text in (lower, lower.translate(_AS_LETTERS)):
        words = {_shortest_unit(word) for word in _LETTERS.findall(text)}
        if words and words <= _COMMON | {normalize(name).casefold()}:
            return "This password consists of common words. Choose other words, or add some."
    return ""


def _shortest_unit(word: str) -> str:
    """The part whose repetitions form the word."""
    period = (word + word).find(word, 1)
    return word[:period]
