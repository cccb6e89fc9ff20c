"""Which passwords are good enough: length, and nothing that is guessed first.

As NIST SP 800-63B asks: a least length, a list of what is known to be chosen, and no rules about kinds of characters,
which make passwords worse. Its eight characters are the least there; few guesses are allowed here and each is slow, but
who steals the table may guess on.
"""

import re
import unicodedata
from typing import Final

LEAST: Final = 12
MOST: Final = 256
_DIFFERENT: Final = 5
"""Fewer different characters are one pattern, repeated."""
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
"""What leaked lists are full of, without the digits and signs that people put around it; and this product's name."""
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
    """The same text in one of the ways in which it can be written: keyboards differ in how they make an ``é``."""
    return unicodedata.normalize("NFKC", password)


def weakness(password: str, *, name: str) -> str:
    """What is wrong with a password that somebody wants to have, as a sentence; empty: nothing.

    Args:
        password: In its normal form.
        name: Of the account.
    """
    if len(password) < LEAST:
        return f"A password has at least {LEAST} characters; a sentence of a few words is a good one."
    if len(password) > MOST:
        return f"A password has at most {MOST} characters."
    lower = password.casefold()
    if len(set(lower)) < _DIFFERENT:
        return f"A password has at least {_DIFFERENT} different characters."
    straight = lower.replace(" ", "")
    if any(straight in row * 2 or straight[::-1] in row * 2 for row in _ROWS):
        return "This password is one row of keys, which is guessed first."
    for text in (lower, lower.translate(_AS_LETTERS)):
        words = {_once(word) for word in _LETTERS.findall(text)}
        if words and words <= _COMMON | {normalize(name).casefold()}:
            return "This password is made of words that are guessed first. Choose others, or add some."
    return ""


def _once(word: str) -> str:
    """A word without its repetitions."""
    again = (word + word).find(word, 1)
    return word[:again]
